# SPDX-License-Identifier: Apache-2.0
"""Build of stereo_frontend (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "stereo_frontend"

setup(
    name=PACKAGE,
    version="0.2.0",
    packages=find_packages(),
    package_data={"": ["py.typed", "*.cl"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=[
        "setuptools",
        "slam_core",
        "numba",
        "numpy",
        "opencv-python-headless",
        "scipy",
    ],
    extras_require={"gpu": ["pyopencl"]},
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="Stereo camera driver, feature extraction, stereo matching and depth fusion.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "stereo_driver = stereo_frontend.driver_node:main",
            "feature_extractor = stereo_frontend.node:main",
        ]
    },
)
