# SPDX-License-Identifier: Apache-2.0
"""Build of slam_radio (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "slam_radio"

setup(
    name=PACKAGE,
    version="0.2.0",
    packages=find_packages(),
    package_data={"": ["py.typed", "*.npy"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=[
        "setuptools",
        "slam_core",
        "constriction",
        "eclipse-zenoh",
        "numba",
        "numpy",
        "opencv-python-headless",
        "scipy",
    ],
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="Submaps for thin radio links: a few kilobytes each, never surer than the submap itself.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "radio_link = slam_radio.radio_link_node:main",
        ]
    },
)
