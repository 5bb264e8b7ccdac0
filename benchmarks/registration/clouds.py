"""Public clouds without an initial guess: ETH apartment, PCL pairs, vehicle lidar."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from ndt_registration.cloud_io import read_cloud
from ndt_registration.registration import register
from slam_core.geometry import so3_log

PAIRS = {
    "ETH apartment": (
        "cloud_libpointmatcher/icp_tutorial/cloud_1.vtk",
        "cloud_libpointmatcher/icp_tutorial/cloud_0.vtk",
    ),
    "vehicle lidar": ("cloud_small_gicp/data/source.ply", "cloud_small_gicp/data/target.ply"),
    **{
        f"PCL {k + 1} to {k}": tuple(f"cloud_pcl_pairwise/pairwise/capture000{i}.pcd" for i in (k + 1, k))
        for k in range(1, 5)
    },
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    arguments = parser.parse_args()
    for name, (source, target) in PAIRS.items():
        clouds = read_cloud(arguments.data / source), read_cloud(arguments.data / target)
        began = time.perf_counter()
        result = register(*clouds)
        T = result.T_target_source
        print(
            f"{name:16s} {'converged' if result.converged else 'failed':10s} t {np.round(T[:3, 3], 3)} m, "
            f"{np.rad2deg(np.linalg.norm(so3_log(T[:3, :3]))):.2f} deg, overlap {result.overlap:.2f}, "
            f"{1e3 * (time.perf_counter() - began):.0f} ms {result.reason}"
        )


if __name__ == "__main__":
    main()
