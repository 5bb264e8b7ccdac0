# SPDX-License-Identifier: Apache-2.0
"""Build of slam_viewer (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "slam_viewer"

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
        "dense_mapping",
        "sjsam_node",
        "slam_bags",
        "slam_core",
        "slam_radio",
        "stereo_frontend",
        "Jinja2",
        "matplotlib",
        "numpy",
        "opencv-python-headless",
        "PyYAML",
        "rich",
        "scipy",
        "trimesh",
        "viser",
    ],
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="Results of a run, report, result bag, and the live page in the browser.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "viewer = slam_viewer.viewer_node:main",
        ]
    },
)
