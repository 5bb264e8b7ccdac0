# SPDX-License-Identifier: Apache-2.0
"""Calibrate from rendered pictures and compare with the cameras that took them.

    python benchmarks/calibration/rendered.py [--views 16]

Boards are photographed by simulated cameras through their lenses (nine rays per pixel, blur, shot noise), found, and
calibrated as real pictures would be. Unlike the Monte-Carlo runs this includes every bias of corner detection.
"""

from __future__ import annotations

import argparse

import cv2
import numpy as np

from slam_calibration.board import AprilGrid, Board, parse_board
from slam_calibration.bundle import LensState
from slam_calibration.detection import find_corners
from slam_calibration.rig import calibrate
from slam_core.geometry import FloatArray, boxminus
from slam_core.types import ByteArray
from slam_simulation.calibration.board_pictures import draw_board
from slam_simulation.calibration.board_views import beside, example_camera, random_view

SCALE = 3000.0
SUPERSAMPLING = 3
BOARDS = ("chessboard:9x7:0.045", "aprilgrid:6x5:0.055:0.3", "charuco:9x7:0.05:0.037")


class Photographer:
    """Takes pictures of one board through one camera."""

    def __init__(self, board: Board, state: LensState) -> None:
        self.texture, self.corners = draw_board(board, SCALE)
        self.points, self.state = board.points, state
        n = SUPERSAMPLING
        offset = (np.arange(n) + 0.5) / n - 0.5
        v = (np.arange(state.height)[:, None] + offset).ravel()
        u = (np.arange(state.width)[:, None] + offset).ravel()
        pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        self.rays = np.column_stack([state.camera.normalised_from_pixels(pixels), np.ones(len(pixels))])
        # Board metres to texture pixels, from the corners themselves: right for boards drawn in either direction.
        A = np.column_stack([self.points[:, :2], np.ones(len(self.points))])
        self.to_texture = np.linalg.lstsq(A, self.corners, rcond=None)[0]

    def take(self, T_camera_board: FloatArray, rng: np.random.Generator) -> ByteArray:
        """A picture, uint8."""
        R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
        depth = (R[:, 2] @ t) / (self.rays @ R[:, 2])
        on_board = (self.rays * depth[:, None] - t) @ R[:, :2]
        at = np.column_stack([on_board, np.ones(len(on_board))]) @ self.to_texture
        n, s = SUPERSAMPLING, self.state
        shape = n * s.height, n * s.width
        maps = (at[:, 0].reshape(shape).astype(np.float32), at[:, 1].reshape(shape).astype(np.float32))
        fine = cv2.remap(self.texture, *maps, cv2.INTER_LINEAR, borderValue=160).astype(np.float32)
        picture = cv2.GaussianBlur(fine, (0, 0), 0.5 * n).reshape(s.height, n, s.width, n).mean(axis=(1, 3))
        light = 20.0 + 0.75 * picture
        noisy = light + 0.15 * np.sqrt(light) * rng.normal(size=light.shape)
        return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=16)
    count = parser.parse_args().views
    truth = [example_camera("plumb_bob"), example_camera("plumb_bob", beside(0.12, 0.0, (0.01, -0.02, 0.005)))]
    print(f"{'board':26s} {'rms':>6s} {'f error':>8s} {'baseline':>9s} {'< 3 sigma':>10s} {'std':>5s} {'corners':>8s}")
    for text in BOARDS:
        board, rng = parse_board(text), np.random.default_rng(3)
        middle = 0.5 * (board.points.min(axis=0) + board.points.max(axis=0))
        cameras = [Photographer(board, state) for state in truth]
        views = []
        for _ in range(count):
            T = random_view(rng)
            if isinstance(board, AprilGrid):  # its y axis points up: half a turn about x shows the printed side
                T[:3, :3] = T[:3, :3] @ np.diag([1.0, -1.0, -1.0])
            T[:3, 3] -= T[:3, :3] @ middle
            views.append([find_corners(board, camera.take(camera.state.T @ T, rng)) for camera in cameras])
        result = calibrate(board.points, views, [(640, 480)] * 2, ["plumb_bob"] * 2)
        errors = [s.parameters - t.parameters for s, t in zip(result.rig.cameras, truth, strict=True)]
        q = np.concatenate([*errors, boxminus(result.rig.cameras[1].T, truth[1].T)]) / np.sqrt(
            np.diag(result.covariance)
        )
        baseline = np.linalg.norm(result.rig.cameras[1].T[:3, 3]) / np.linalg.norm(truth[1].T[:3, 3]) - 1.0
        found = sum(len(corners) for view in views for corners in view) / (2 * count * len(board.points))
        print(
            f"{text:26s} {result.rms:6.3f} {errors[0][0] / truth[0].parameters[0]:8.3%} {baseline:9.3%} "
            f"{np.mean(np.abs(q) < 3.0):10.1%} {np.std(q):5.2f} {found:8.1%}"
        )


if __name__ == "__main__":
    main()
