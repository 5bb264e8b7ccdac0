# SPDX-License-Identifier: Apache-2.0
"""Time of the whole stereo front end per pair and how it splits; simulated 640x480 pairs, EuRoC and KITTI.

Left and right image are extracted on two threads, disparities refined half on each. The parts are processor time of one
thread, the whole is time on the wall, so it only says something on an idle machine; "on two cores" is what the parts
add up to: the slower image, matching, half of the disparities, and left keypoints with one described. "one core" is
their sum.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TypeVar

import cv2
import numpy as np
from datasets import euroc_pairs, kitti_pairs

from slam_core.types import StereoImages
from slam_experiments.simulated.true_frames import simulated_frames
from stereo_frontend.detection.features import FeatureExtractor
from stereo_frontend.frontend import RIGHT_SURPLUS, Frontend
from stereo_frontend.frontend_config import FrontendConfig
from stereo_frontend.stereo.disparity import refine_disparity
from stereo_frontend.stereo.matching import disparity_bounds, match_stereo

T = TypeVar("T")
WARM_UP = 4


class Watch:
    """Collects the times of named calls."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = {}

    def __call__(self, name: str, function: Callable[..., T], *arguments: object) -> T:
        """Call ``function`` and note the time it took under ``name``."""
        clock = time.perf_counter if name == "wall" else time.thread_time
        start = clock()
        result = function(*arguments)
        self.times.setdefault(name, []).append(1e3 * (clock() - start))
        return result

    def medians(self) -> dict[str, float]:
        """Median of each name, ms, without the first few."""
        return {name: float(np.median(values[WARM_UP:])) for name, values in self.times.items()}


def measure(title: str, pairs: Iterable[StereoImages], config: FrontendConfig) -> None:
    watch, frontend = Watch(), Frontend(config)
    more = replace(config.features, target=int(RIGHT_SURPLUS * config.features.target))
    left, right = (FeatureExtractor(c, for_pairs=True) for c in (config.features, more))
    features = 0
    pairs = list(pairs)
    for images in pairs:
        features += len(watch("wall", frontend.process, images))
        a = watch("left", left, images.left)
        camera = images.stereo.camera
        bounds = disparity_bounds(config.matching, camera.fx * images.stereo.baseline)
        b = watch("right", right, images.right)
        matches = watch("match", match_stereo, a, b, config.matching, bounds)
        uv, u_right = a.uv[matches.left], b.uv[matches.right, 0]
        refined = watch("disparity", refine_disparity, images.left, images.right, uv, u_right, config.disparity)
        watch("describe", left.describe, images.left, a.select(matches.left[refined.valid]))
    height, width = pairs[0].left.shape
    ms = watch.medians()
    ms["one core"] = ms["left"] + ms["right"] + ms["match"] + ms["disparity"] + ms["describe"]
    ms["on two cores"] = max(ms["left"], ms["right"]) + ms["match"] + 0.5 * ms["disparity"] + ms["describe"]
    text = "   ".join(f"{name} {value:.1f}" for name, value in ms.items())
    print(f"{title} {width}x{height}: {features / len(pairs):.0f} features with depth; ms: {text}")


def main() -> None:
    cv2.setNumThreads(1)
    config = FrontendConfig()
    simulated = [f.images for f in simulated_frames("workshop_rig", 14, 3)]
    measure("simulated", simulated, config)
    measure("EuRoC", euroc_pairs(3), config)
    measure("KITTI", kitti_pairs(3), config)


if __name__ == "__main__":
    main()
