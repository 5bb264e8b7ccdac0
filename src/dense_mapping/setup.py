# SPDX-License-Identifier: Apache-2.0
"""Build of dense_mapping (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "dense_mapping"

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
        "stereo_frontend",
        "numba",
        "numpy",
        "opencv-python-headless",
        "plyfile",
        "PyYAML",
        "scipy",
        "trimesh",
    ],
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="Dense model and floor plan: stereo and ToF depth fused in a TSDF on the optimised trajectory.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "dense_mapper = dense_mapping.node:main",
        ]
    },
)
