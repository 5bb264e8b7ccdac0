# SPDX-License-Identifier: Apache-2.0
"""Build of ndt_registration (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "ndt_registration"

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
        "plyfile",
        "scipy",
        "PyYAML",
    ],
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="NDT and ICP registration of point clouds, and scan odometry.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "ndt_odometry = ndt_registration.node:main",
        ]
    },
)
