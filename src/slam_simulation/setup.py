# SPDX-License-Identifier: Apache-2.0
"""Build of slam_simulation (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "slam_simulation"

setup(
    name=PACKAGE,
    version="0.2.0",
    packages=find_packages(),
    package_data={"": ["py.typed", "scenarios/*.yaml", "expected.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=[
        "setuptools",
        "slam_core",
        "slam_calibration",
        "numba",
        "numpy",
        "opencv-python-headless",
        "PyYAML",
        "scipy",
    ],
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="Simulated buildings, cameras, ToF camera and IMU, rendered with ground truth.",
    license="Apache-2.0",
)
