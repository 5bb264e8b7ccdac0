# SPDX-License-Identifier: Apache-2.0
"""Rooms that nobody chose: of random size, style and furniture, with places in them; and two that leave a scan free."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from slam_core.geometry import FloatArray
from slam_experiments.simulated.tof_scans import TofRoom, rig_pose
from slam_simulation.scenario import Scenario
from slam_simulation.world.building import STYLES

KINDS = ("table", "chair", "pillar")
EMPTY = {
    "corridor": ({"name": "corridor", "x": (0.0, 40.0), "y": (0.0, 2.0), "height": 2.5, "clutter": 0.0}, (4.0, 1.0)),
    "single wall": ({"name": "hall", "x": (0.0, 40.0), "y": (0.0, 40.0), "height": 40.0, "clutter": 0.0}, (37.0, 20.0)),
}
"""Room, and where in it a scan is taken towards +x; the hall's at half its height."""


def scenario(room: dict[str, Any], seed: int, objects: tuple[dict[str, Any], ...] = ()) -> Scenario:
    """A scenario of one room."""
    agent = {"motion": "tripod", "stations": ((0.7, 1.9, 0.0),)}
    values = {"seed": seed, "rate": 12.0, "frames": 15, "sensors": ("tof",), "rooms": (room,), "objects": objects}
    return Scenario.from_mapping(str(room["name"]), {**values, "agents": (agent,)})


def random_room(seed: int) -> tuple[TofRoom, Iterator[FloatArray]]:
    """A furnished room and poses (4, 4) T_world_rig on its west side, looking about eastwards, without end."""
    rng = np.random.default_rng([seed, 99])
    x, y = rng.uniform(3.8, 6.0), rng.uniform(3.4, 5.0)
    room = {"name": "room", "x": (0.0, x), "y": (0.0, y), "height": rng.uniform(2.4, 3.0)}
    objects = tuple(_piece(x, y, rng) for _ in range(rng.integers(2, 6)))
    style = sorted(STYLES)[seed % len(STYLES)]

    def places() -> Iterator[FloatArray]:
        while True:
            yield rig_pose(rng.uniform(0.4, 0.3 * x), rng.uniform(0.35 * y, 0.65 * y), yaw_deg=rng.uniform(-25.0, 25.0))

    return TofRoom(scenario({**room, "style": style}, seed + 1000, objects)), places()


def _piece(x: float, y: float, rng: np.random.Generator) -> dict[str, Any]:
    """A piece of furniture in the eastern half of a room of ``x`` by ``y`` m."""
    return {
        "kind": str(rng.choice(KINDS)),
        "at": (rng.uniform(0.45 * x, x - 0.6), rng.uniform(0.6, y - 0.6)),
        "size": (rng.uniform(0.8, 1.4), rng.uniform(0.5, 0.8)),
        "yaw": rng.uniform(0.0, 360.0),
    }


def empty_room(name: str) -> tuple[TofRoom, FloatArray]:
    """One of ``EMPTY`` and T_world_rig of the scan in it."""
    room, (x, y) = EMPTY[name]
    return TofRoom(scenario(room, 7)), rig_pose(x, y, 20.0 if name == "single wall" else 1.1)
