# SPDX-License-Identifier: Apache-2.0
"""Build of ekf_slam_node (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "ekf_slam_node"

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
        "scipy",
    ],
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="3D visual EKF-SLAM that builds small, locally referenced submaps.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "ekf_slam = ekf_slam_node.node:main",
        ]
    },
)
