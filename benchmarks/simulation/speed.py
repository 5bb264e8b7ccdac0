# SPDX-License-Identifier: Apache-2.0
"""Frames per second of the simulation, on one and two threads, and what each stage costs.

python benchmarks/simulation/speed.py [SCENARIO ...]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from statistics import median

import numpy as np

from slam_simulation import Scenario, Simulator
from slam_simulation.rendering.raycaster import make_view, trace
from slam_simulation.rendering.shading import render
from slam_simulation.sensors.stereo_sensor import motion_blur
from slam_simulation.world.surface_table import compile_world

FRAMES = 8


def milliseconds(call: Callable[[], object]) -> float:
    """Median processor time of one call on one thread."""
    times = []
    for _ in range(5):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1e3 * median(times)


def stages(simulator: Simulator) -> str:
    """What the parts of a frame cost on one thread; stereo stages count once per image."""
    T = simulator.path.pose(simulator.path.duration / 3)
    T_camera, rays, rng = T @ simulator.stereo.T_rig_raw[0], simulator.stereo.rays[0], np.random.default_rng(0)
    view = make_view(simulator.world, T_camera, rays.bounds)
    hits = trace(view, rays)
    image = render(simulator.world, view, rays, hits, T_camera)
    shift = np.array([0.003, 0.0, 0.0, 0.0, 0.003, 0.0])
    parts = {
        "view": lambda: make_view(simulator.world, T_camera, rays.bounds),
        "trace": lambda: trace(view, rays),
        "shade": lambda: render(simulator.world, view, rays, hits, T_camera),
        "blur": lambda: motion_blur(image, hits.depth, rays, shift),
        "tof": lambda: simulator.tof.capture(simulator.world, T, rng, None),
    }
    return ", ".join(f"{name} {milliseconds(part):.0f} ms" for name, part in parts.items())


def main() -> None:
    for name in sys.argv[1:] or ("small_room", "workshop_rig", "five_rooms", "fifty_rooms"):
        scenario = Scenario.load(name)
        start = time.perf_counter()
        world = compile_world(scenario.world())
        built = time.perf_counter() - start
        line = f"{name:16s} {len(world.origin):6d} surfaces, built in {built:5.1f} s"
        for threads in (1, 2):
            simulator = Simulator(scenario, world=world, threads=threads)
            stamps = []
            for _ in simulator.run(FRAMES):
                stamps.append(time.perf_counter())
            line += f", {threads} threads {1.0 / median(np.diff(stamps)):.1f} frames/s"
        print(line)
        print(f"{'':16s} processor time: {stages(Simulator(scenario, world=world, threads=1))}", flush=True)


if __name__ == "__main__":
    main()
