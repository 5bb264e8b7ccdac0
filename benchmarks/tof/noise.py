# SPDX-License-Identifier: Apache-2.0
"""Is the ToF driver's sigma honest? (measured - true) / sigma over simulated frames, against the rendered depth.

    python benchmarks/tof/noise.py [SCENARIO ...] [--frames 12]

Per scenario: share of pixels with depth, standard deviation of the normalised error, its robust width (from quartiles),
shares beyond 3 and 5 sigma (a normal distribution has 0.27 % and none), standard deviation away from and at edges,
share of pixels at edges, milliseconds per image; then the pixels by reason.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np

from slam_core.geometry import FloatArray
from slam_core.types import AnyArray
from slam_simulation.rendering.raycaster import camera_rays, make_view, trace
from slam_simulation.scenario import Scenario
from slam_simulation.simulator import Simulator
from tof_driver.depth import DepthConfig, DepthProcessor


def compare(name: str, frames: int) -> tuple[FloatArray, AnyArray, DepthProcessor, float]:
    """Normalised errors, whether each pixel is next to an edge, the processor, and ms per image."""
    simulator = Simulator(Scenario.load(name), threads=1)
    processor = DepthProcessor(DepthConfig(), simulator.tof.camera)
    rays = camera_rays(processor.output_camera)
    errors, edges, durations = [], [], []
    for k in np.linspace(0, simulator.frames - 1, frames).astype(int):
        T = simulator.path.pose(k / simulator.scenario.rate)
        images = simulator.tof.capture(simulator.world, T, np.random.default_rng([k, 1]), None)
        start = time.perf_counter()
        image = processor.process(0, images.range, images.amplitude, images.intensity)
        durations.append(time.perf_counter() - start)
        view = make_view(simulator.world, T @ simulator.tof.T_rig_tof, rays.bounds)
        hits = trace(view, rays, None)
        valid = np.isfinite(image.depth) & np.isfinite(hits.depth)
        surface = hits.surface.astype(np.float32)
        kernel = np.ones((3, 3), np.uint8)
        edge = cv2.dilate(surface, kernel) != cv2.erode(surface, kernel)
        errors.append(((image.depth - hits.depth) / image.sigma)[valid])
        edges.append(edge[valid])
    return np.concatenate(errors), np.concatenate(edges), processor, 1e3 * float(np.median(durations))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenarios", nargs="*", default=["tof_turns", "small_room", "demo", "two_rooms"])
    parser.add_argument("--frames", type=int, default=12)
    arguments = parser.parse_args()
    columns = ("pixels", "std", "robust", ">3s %", ">5s %", "std in", "std edge", "edge %", "ms")
    print(f"{'scenario':14s}" + "".join(f"{column:>9s}" for column in columns))
    for name in arguments.scenarios:
        q, edge, processor, duration = compare(name, arguments.frames)
        counts = processor.counters.counts
        share = counts["output_pixels"] / (counts["images"] * processor.camera.width * processor.camera.height)
        robust = (np.percentile(q, 75) - np.percentile(q, 25)) / 1.349
        beyond = [100.0 * np.mean(np.abs(q) > limit) for limit in (3.0, 5.0)]
        values = (np.std(q), robust, *beyond, np.std(q[~edge]), np.std(q[edge]), 100 * edge.mean(), duration)
        print(f"{name:14s}{share:9.1%}" + "".join(f"{value:9.2f}" for value in values))
        print("   ", counts)


if __name__ == "__main__":
    main()
