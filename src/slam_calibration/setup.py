# SPDX-License-Identifier: Apache-2.0
"""Build of slam_calibration (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "slam_calibration"

setup(
    name=PACKAGE,
    version="0.2.0",
    packages=find_packages(),
    package_data={"": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=[
        "setuptools",
        "slam_core",
        "matplotlib",
        "numpy",
        "opencv-python-headless",
        "PyYAML",
    ],
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="Calibration of cameras, stereo pairs and the ToF camera, with uncertainties.",
    license="Apache-2.0",
)
