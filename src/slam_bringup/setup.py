# SPDX-License-Identifier: Apache-2.0
"""Build of slam_bringup (ament_python)."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "slam_bringup"

setup(
    name=PACKAGE,
    version="0.2.0",
    packages=find_packages(),
    package_data={"": ["py.typed", "demo/*.mcap", "demo/*.yaml", "processes/*.json"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", glob("launch/*.launch.py")),
        (f"share/{PACKAGE}/rviz", glob("rviz/*.rviz")),
    ],
    install_requires=[
        "setuptools",
        "dense_mapping",
        "ekf_slam_node",
        "ndt_registration",
        "sjsam_node",
        "slam_bags",
        "slam_calibration",
        "slam_core",
        "slam_radio",
        "slam_viewer",
        "stereo_frontend",
        "tof_driver",
        "click",
        "matplotlib",
        "numba",
        "numpy",
        "opencv-python-headless",
        "PyYAML",
        "rich",
    ],
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="Launch files, configuration, the offline pipeline, the processes of a run and the slam command line.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "slam = slam_bringup.cli:main",
            "slam_composed = slam_bringup.processes.composed_node:main",
        ]
    },
)
