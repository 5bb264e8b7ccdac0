# SPDX-License-Identifier: Apache-2.0
"""Build of tof_driver (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "tof_driver"

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
        "numba",
        "numpy",
        "opencv-python-headless",
    ],
    extras_require={"librealsense": ["pyrealsense2"]},
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="Time-of-flight camera driver: range images to rectified depth with per-pixel uncertainty.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "tof_driver = tof_driver.node:main",
        ]
    },
)
