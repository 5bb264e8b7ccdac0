# SPDX-License-Identifier: Apache-2.0
"""Build of slam_core (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "slam_core"

setup(
    name=PACKAGE,
    version="0.2.0",
    packages=find_packages(),
    package_data={"": ["py.typed", "*.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=[
        "setuptools",
        "cvxopt",
        "numba",
        "numpy",
        "opencv-python-headless",
        "plyfile",
        "PyYAML",
        "scipy",
        "threadpoolctl",
    ],
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="Geometry, data types, least squares, linear algebra, evaluation and messages of the SLAM packages.",
    license="Apache-2.0",
)
