# SPDX-License-Identifier: Apache-2.0
"""Frames a second of SURF on an OpenCL device beside the compiled kernels and the thesis's GPU-SURF (3.2: about 85).

    python benchmarks/features/gpu_surf.py [--device NAME] [--frames N]

A frame is upload, detection, choice of 500 keypoints, SURF-128 of them, download: all on the wall, one picture after
the other. Pictures are simulated ones of 640 x 480, the same enlarged, and EuRoC's and KITTI's where these are. The
device is a GPU where there is one; else whatever runs OpenCL, and that says nothing about a GPU's speed. "different":
share of keypoints that only one of both has, and of descriptors with a number that differs by more than 1e-3.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator

import cv2
import numpy as np
from datasets import DATA, euroc_pairs, kitti_pairs

from slam_experiments.simulated.true_frames import simulated_frames
from stereo_frontend.detection.features import FeatureConfig, FeatureExtractor
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.surf.surf_device import best_opencl_device

SIZES = ((640, 480), (1024, 768))
THESIS = 85
WARM_UP = 3


def picture_sets() -> Iterator[tuple[str, list[np.ndarray]]]:
    views = [view.images.left for view in simulated_frames("small_room", 4, 3)]
    for size in SIZES:
        yield "simulated", [cv2.resize(view, size, interpolation=cv2.INTER_CUBIC) for view in views]
    if DATA.is_dir():
        for name, pairs in (("EuRoC", euroc_pairs(10)), ("KITTI", kitti_pairs(5))):
            yield name, [images.left for images in pairs]


def measure(pictures: list[np.ndarray], device: str, frames: int) -> tuple[float, float, list[Keypoints]]:
    """Median milliseconds of a frame, their 95th percentile, and what was found in each picture the first time."""
    extractor = FeatureExtractor(FeatureConfig(target=500, device=device))
    found, elapsed = [], []
    for k in range(WARM_UP + frames):
        began = time.perf_counter()
        keypoints = extractor(pictures[k % len(pictures)])
        elapsed.append(1e3 * (time.perf_counter() - began))
        found.append(keypoints)
    return float(np.median(elapsed[WARM_UP:])), float(np.percentile(elapsed[WARM_UP:], 95)), found


def differences(found: list[Keypoints], expected: list[Keypoints]) -> tuple[float, float]:
    """Shares of keypoints without a twin, and of descriptors of twins that are not the same."""
    alone = wrong = twins = total = 0
    for a, b in zip(found, expected, strict=True):
        places = {tuple(uv): k for k, uv in enumerate(b.uv.round(3).tolist())}
        pairs = [(k, places[uv]) for k, uv in enumerate(map(tuple, a.uv.round(3).tolist())) if uv in places]
        i, j = np.array(pairs, int).reshape(-1, 2).T
        wrong += int((np.abs(a.descriptors[i] - b.descriptors[j]).max(axis=1) > 1e-3).sum())
        twins, alone, total = twins + len(i), alone + len(a) + len(b) - 2 * len(i), total + len(a) + len(b)
    return alone / total, wrong / max(twins, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", help="part of the name of an OpenCL device [a GPU, else any]")
    parser.add_argument("--frames", type=int, default=40)
    arguments = parser.parse_args()
    best = best_opencl_device()
    if best is None:
        sys.exit("no OpenCL device: pip install pyopencl, and pocl-binary-distribution where there is no GPU")
    device = arguments.device or best[0]
    print(f"device: {device}{'' if best[1] else ' (no GPU on this machine)'}; the thesis's GPU-SURF: {THESIS} frames/s")
    print(f"{'pictures':21s}{'device':>10s}{'95 %':>10s}{'frames/s':>10s}{'CPU':>10s}{'frames/s':>10s}   different")
    cv2.setNumThreads(1)
    for name, pictures in picture_sets():
        ms, slow, found = measure(pictures, device, arguments.frames)
        cpu_ms, _, expected = measure(pictures, "cpu", arguments.frames)
        alone, wrong = differences(found, expected)
        print(
            f"{name:10s}{pictures[0].shape[1]:4d} x {pictures[0].shape[0]:4d}{ms:7.1f} ms{slow:7.1f} ms{1e3 / ms:10.0f}"
            f"{cpu_ms:7.1f} ms{1e3 / cpu_ms:10.0f}   {100 * alone:.2f} %, {100 * wrong:.2f} %"
        )


if __name__ == "__main__":
    main()
