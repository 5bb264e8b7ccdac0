# SPDX-License-Identifier: Apache-2.0
"""Build of slam_experiments (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "slam_experiments"

setup(
    name=PACKAGE,
    version="0.2.0",
    packages=find_packages(),
    package_data={"": ["py.typed", "*.j2"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=[
        "setuptools",
        "ekf_slam_node",
        "ndt_registration",
        "sjsam_node",
        "slam_bags",
        "slam_bringup",
        "slam_calibration",
        "slam_core",
        "slam_simulation",
        "slam_viewer",
        "stereo_frontend",
        "tof_driver",
        "click",
        "distributed",
        "filterpy",
        "Jinja2",
        "matplotlib",
        "numba",
        "numpy",
        "opencv-python-headless",
        "PyYAML",
        "rich",
        "scipy",
    ],
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="The thesis's experiments, 2D SLAM on logs, text submaps and simulated bags; not for a robot.",
    license="Apache-2.0",
    entry_points={"slam.commands": ["slam_experiments = slam_experiments.command_table:COMMANDS"]},
)
