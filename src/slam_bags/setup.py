# SPDX-License-Identifier: Apache-2.0
"""Build of slam_bags (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "slam_bags"

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
        "ndt_registration",
        "slam_core",
        "stereo_frontend",
        "tof_driver",
        "numpy",
        "opencv-python-headless",
        "PyYAML",
        "rosbags",
        "scipy",
    ],
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="Bags and public data sets: reading, writing, the bag player and the recorder.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "bag_player = slam_bags.nodes.bag_player_node:main",
            "recorder = slam_bags.nodes.recorder_node:main",
        ]
    },
)
