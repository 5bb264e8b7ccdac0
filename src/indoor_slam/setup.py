# SPDX-License-Identifier: Apache-2.0
"""Build of indoor_slam (ament_python)."""

from setuptools import find_packages, setup

PACKAGE = "indoor_slam"

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
        "ekf_slam_node",
        "ndt_registration",
        "sjsam_node",
        "slam_bags",
        "slam_bringup",
        "slam_core",
        "stereo_frontend",
        "tof_driver",
        "numpy",
    ],
    zip_safe=False,
    maintainer="Indoor SLAM maintainers",
    maintainer_email="maintainers@indoor-slam.org",
    description="The chain as a library: NumPy arrays in, poses with covariances and maps out.",
    license="Apache-2.0",
)
