# SPDX-License-Identifier: Apache-2.0
"""Tables 10.1 and 10.2 and beyond: 15 scans per motion, one setting, no initial guess.

Share of points, processor time, iterations.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from ndt_registration.registration import RegistrationConfig, register
from slam_core.geometry import boxminus
from slam_experiments.simulated.tof_scans import (
    HARDER_MOTIONS,
    SCANS,
    THESIS_MOTIONS,
    TofRoom,
    rig_motion,
    rig_pose,
    thinned,
)

ROOM = Path(__file__).parent / "room.yaml"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default=str(ROOM), help="name or YAML file")
    parser.add_argument(
        "--start", type=float, nargs=3, default=(0.7, 1.9, 0.0), help="x y yaw of the target scan (m, deg)"
    )
    parser.add_argument(
        "--share", type=float, nargs="+", default=[0.2], help="shares of the points; the thesis': 1 0.2 0.1 0.05 0.02"
    )
    parser.add_argument("--scans", type=int, default=SCANS)
    parser.add_argument("--method", default="ndt", choices=("ndt", "icp", "icp_plane"))
    arguments = parser.parse_args()
    room, rng = TofRoom(arguments.scenario), np.random.default_rng(1)
    start = rig_pose(arguments.start[0], arguments.start[1], yaw_deg=arguments.start[2])
    config = RegistrationConfig(method=arguments.method)
    target = room.scan(start, rng)
    register(target[:8000], target[8000:], config=config)  # compiles
    print(f"{arguments.method}, {Path(arguments.scenario).stem}")
    print("success: 5 cm and 1 deg; good: 1 cm and 0.3 deg; wrong: claimed, but no success")
    for share in arguments.share:
        print(f"\n{100 * share:g} % of the points")
        print(f"{'motion':24s} success  good  claimed  wrong      mm    deg iterations        ms")
        for name, motion in {**THESIS_MOTIONS, **HARDER_MOTIONS}.items():
            truth, rows = room.motion(motion), []
            for _ in range(arguments.scans):
                source = thinned(room.scan(start @ rig_motion(motion), rng), share, rng)
                reference = thinned(room.scan(start, rng), share, rng)
                began = time.thread_time()
                result = register(source, reference, config=config)
                elapsed = time.thread_time() - began
                d = boxminus(result.T_target_source, truth)
                rows.append(
                    (
                        np.linalg.norm(d[:3]),
                        np.rad2deg(np.linalg.norm(d[3:])),
                        result.converged,
                        result.iterations,
                        elapsed,
                    )
                )
            e, a, claimed, iterations, seconds = np.array(rows, dtype=float).T
            right = (e < 0.05) & (a < 1)
            success, good, wrong = right.sum(), np.sum((e < 0.01) & (a < 0.3)), np.sum(~right & (claimed > 0))
            print(
                f"{name:24s} {success:5d} {good:7d} {int(claimed.sum()):7d} {wrong:7d} {1e3 * np.median(e):7.1f} "
                f"{np.median(a):6.2f} {np.median(iterations):8.0f} {1e3 * np.median(seconds):9.1f}"
            )


if __name__ == "__main__":
    main()
