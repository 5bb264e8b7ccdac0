# SPDX-License-Identifier: Apache-2.0
"""Sample frames of every scenario in one picture.

python benchmarks/simulation/contact_sheet.py docs/images/scenarios.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from slam_core.types import ByteArray
from slam_simulation import Scenario, SimulatedFrame, Simulator
from slam_simulation.world.surface_table import compile_world

WIDTH, HEIGHT, COLUMNS = 208, 156, 4
SHARES = (0.05, 0.35, 0.6, 0.85)
SCENARIOS = (
    "workshop_rig", "workshop_handheld", "fireman_10hz", "sweep", "conference", "two_rooms", "figure_eight",
    "five_rooms", "firemen_3", "small_room", "tof_grid", "tof_turns",
)  # fmt: skip
"""fireman_5hz and firemen_2 show the same places; fifty_rooms takes long to build."""


def picture(frame: SimulatedFrame) -> ByteArray:
    """The left image, or the ToF amplitude where there is no stereo, at the size of the sheet."""
    if frame.left is not None:
        return np.asarray(cv2.resize(frame.left, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    assert frame.tof is not None
    amplitude = np.clip(frame.tof.amplitude / np.percentile(frame.tof.amplitude, 99), 0, 1) ** 0.6 * 255
    square = cv2.resize(amplitude.astype(np.uint8), (HEIGHT, HEIGHT), interpolation=cv2.INTER_AREA)
    side = (WIDTH - HEIGHT) // 2
    return np.asarray(np.pad(square, ((0, 0), (side, side))), dtype=np.uint8)


def row(name: str) -> ByteArray:
    """Frames of one scenario, its name in the first."""
    scenario = Scenario.load(name)
    world = compile_world(scenario.world())
    pictures = []
    for share in SHARES:
        k = int(share * scenario.frames)
        frame = next(Simulator(scenario, world=world).run(first=k))
        pictures.append(picture(frame))
    cv2.putText(pictures[0], name, (4, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, 255, 1)
    return np.hstack(pictures)


def main() -> None:
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "scenarios.png")
    rows = [row(name) for name in SCENARIOS]
    half = len(rows) // 2
    sheet = np.hstack([np.vstack(rows[:half]), np.vstack(rows[half:])])
    # Steps of four grey levels, below the noise, make a PNG of half the size.
    cv2.imwrite(str(target), sheet // 4 * 4, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{target}: {target.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main()
