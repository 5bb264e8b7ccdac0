"""Is the ToF driver's sigma honest? (measured - true) / sigma over simulated frames, against the rendered depth.

    python benchmarks/tof/noise.py [SCENARIO ...] [--frames 12]

Per scenario: share of pixels with depth, standard deviation of the normalised error, its robust width (from quartiles), share
beyond 3 sigma (a normal distribution has 0.27 %), share of pixels within 5 px of no edge, and the milliseconds per image.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np

from slam_core.geometry import FloatArray
from slam_core.simulation.raycaster import camera_rays, make_view, trace
from slam_core.simulation.scenario import Scenario
from slam_core.simulation.simulator import Simulator
from slam_core.types import AnyArray
from tof_driver.depth import DepthConfig, DepthProcessor


def compare(name: str, frames: int) -> tuple[FloatArray, AnyArray, AnyArray, DepthProcessor, float]:
    """Normalised errors, whether each pixel is next to an edge, its range, the processor, and ms per image."""
    simulator = Simulator(Scenario.load(name), threads=1)
    processor = DepthProcessor(DepthConfig(), simulator.tof.camera)
    rays = camera_rays(processor.output_camera)
    errors, edges, depths, durations = [], [], [], []
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
        depths.append(image.depth[valid])
    return np.concatenate(errors), np.concatenate(edges), np.concatenate(depths), processor, 1e3 * np.median(durations)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenarios", nargs="*", default=["tof_turns", "small_room", "demo", "two_rooms"])
    parser.add_argument("--frames", type=int, default=12)
    arguments = parser.parse_args()
    print(
        f"{'scenario':14s} {'pixels':>7s} {'std':>6s} {'robust':>6s} {'>3s %':>6s} {'>5s %':>6s} {'std in':>6s} {'std edge':>8s} {'edge %':>6s} {'ms':>5s}"
    )
    for name in arguments.scenarios:
        q, edge, _, processor, duration = compare(name, arguments.frames)
        counts = processor.counters.counts
        share = counts["output_pixels"] / (counts["images"] * processor.camera.width * processor.camera.height)
        robust = (np.percentile(q, 75) - np.percentile(q, 25)) / 1.349
        beyond = [100.0 * np.mean(np.abs(q) > limit) for limit in (3.0, 5.0)]
        print(
            f"{name:14s} {share:7.1%} {np.std(q):6.2f} {robust:6.2f} {beyond[0]:6.2f} {beyond[1]:6.2f} "
            f"{np.std(q[~edge]):6.2f} {np.std(q[edge]):8.2f} {100 * edge.mean():6.1f} {duration:5.1f}"
        )
        print("   ", {k: v for k, v in counts.items()})


if __name__ == "__main__":
    main()
