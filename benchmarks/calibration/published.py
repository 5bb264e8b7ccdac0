# SPDX-License-Identifier: Apache-2.0
"""Calibration of the public boards against their published results (data: $INDOOR_SLAM_DATA or ../shared/data).

python benchmarks/calibration/published.py
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import yaml

from slam_calibration.board import AprilGrid, Chessboard
from slam_calibration.bundle import BundleResult
from slam_calibration.pictures import find_views, pair_pictures
from slam_calibration.rig import calibrate
from slam_core.geometry import invert_transform

DATA = Path(os.environ.get("INDOOR_SLAM_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def row(name: str, result: BundleResult, values: dict[str, tuple[float, float, float]]) -> None:
    print(f"{name}: {result.rms:.3f} px rms")
    for quantity, (ours, deviation, published) in values.items():
        difference = 100.0 * (ours / published - 1.0)
        print(f"   {quantity:22s} {ours:10.4f} +- {deviation:7.4f}   published {published:9.4f}   {difference:+.2f} %")


def opencv_chessboard() -> None:
    folder, board = DATA / "calib_opencv_left_right", Chessboard(9, 6, 0.025)
    patterns = [str(folder / f"{side}[01][0-9].jpg") for side in ("left", "right")]
    pair = find_views(board, pair_pictures(patterns, 2))
    result = calibrate(board.points, pair.corners, pair.sizes, ["plumb_bob"] * 2)
    focal = result.rig.cameras[0].parameters[0], result.standard_deviation("0.fx"), 535.916
    row("OpenCV chessboard pair", result, {"fx left [px]": focal})
    alone = calibrate(board.points, [[view[0]] for view in pair.corners], pair.sizes[:1], ["plumb_bob"])
    focal = alone.rig.cameras[0].parameters[0], alone.standard_deviation("0.fx"), 535.916
    row("OpenCV chessboard, left alone", alone, {"fx [px]": focal})


def euroc_aprilgrid() -> None:
    folder, board = DATA / "euroc_v101_visnav100" / "euroc_calib", AprilGrid(6, 6, 0.088, 0.3)
    pair = find_views(board, pair_pictures([str(folder / f"*_{c}.jpg") for c in (0, 1)], 2))
    official = [_euroc_sensor(camera) for camera in (0, 1)]
    T_right_left = invert_transform(official[1][1]) @ official[0][1]
    for lens in ("plumb_bob", "plumb_bob4"):
        result = calibrate(board.points, pair.corners, pair.sizes, [lens] * 2)
        values = {
            f"f{axis} {side} [px]": (
                float(result.rig.cameras[c].parameters[i]),
                result.standard_deviation(f"{c}.f{axis}"),
                official[c][0][i],
            )
            for c, side in enumerate(("left", "right"))
            for i, axis in enumerate("xy")
        }
        baseline = float(np.linalg.norm(result.rig.cameras[1].T[:3, 3]))
        values["baseline [m]"] = baseline, result.standard_deviation("1.x"), float(np.linalg.norm(T_right_left[:3, 3]))
        row(f"EuRoC AprilGrid, 52 pairs, {lens}", result, values)


def _euroc_sensor(camera: int) -> tuple[list[float], np.ndarray]:
    path = DATA / f"euroc_v101_micro95/MicroEurocDataset/mav0/cam{camera}/sensor.yaml"
    document = yaml.safe_load(path.read_text().replace("%YAML:1.0", ""))
    return document["intrinsics"], np.array(document["T_BS"]["data"]).reshape(4, 4)


if __name__ == "__main__":
    opencv_chessboard()
    euroc_aprilgrid()
