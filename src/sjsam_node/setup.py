# SPDX-License-Identifier: Apache-2.0
"""Build of sjsam_node (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "sjsam_node"

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
    extras_require={"scale": ["distributed"]},
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="Submap Joining Smoothing and Mapping: joins submaps by sparse least squares into one map.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "sjsam = sjsam_node.node:main",
        ]
    },
)
