# SPDX-License-Identifier: Apache-2.0
"""Table 3.1 of the thesis again: time and number of features per detector and resolution, then how well they match.

Times: processor time of one thread, median of repeats, all detectors in turn in one process. Matching: mutual best
scalar product over the whole image of a real rectified pair, before any epipolar band; a match is right if it lies
within 2 px of the row and has a positive disparity. Repeatability: share of visible keypoints of a simulated frame that
are found again within 2 px, three frames later.
"""

from __future__ import annotations

import time
from collections.abc import Iterable

import cv2
import numpy as np
from datasets import euroc_pairs, kitti_pairs

from slam_bringup.experiments.true_frames import TrueFrame, simulated_frames, spread, transfer
from slam_core.types import StereoImages
from stereo_frontend.features import DETECTORS, FeatureConfig, FeatureExtractor
from stereo_frontend.keypoints import Keypoints

SIZES = ((320, 240), (640, 480), (1024, 768))
REPEATS = 11


def available() -> list[str]:
    names = []
    for name in DETECTORS:
        try:
            FeatureExtractor(FeatureConfig(detector=name))
            names.append(name)
        except ValueError as error:
            print(f"  {name}: {error}")
    return names


def time_table(image: np.ndarray, names: list[str], target: int = 500) -> None:
    print(f"\nTable 3.1: ms per image and features (target {target}), one thread")
    print(f"{'':10s}" + "".join(f"{w}x{h}".rjust(20) for w, h in SIZES) + "   of SIFT at 640x480")
    rows = {name: [] for name in names}
    for size in SIZES:
        scaled = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        extractors = {name: FeatureExtractor(FeatureConfig(detector=name, target=target)) for name in names}
        for _ in range(4):
            counts = {name: len(extractor(scaled)) for name, extractor in extractors.items()}
        times: dict[str, list[float]] = {name: [] for name in names}
        for _ in range(REPEATS):
            for name, extractor in extractors.items():
                start = time.thread_time()
                extractor(scaled)
                times[name].append(1e3 * (time.thread_time() - start))
        for name in names:
            rows[name].append((float(np.median(times[name])), counts[name]))
    for name in names:
        cells = "".join(f"{ms:12.1f} ms {count:4d}" for ms, count in rows[name])
        print(f"{name:10s}{cells}   {rows[name][1][0] / rows['sift'][1][0]:.2f}")


def mutual_matches(left: Keypoints, right: Keypoints) -> tuple[np.ndarray, np.ndarray]:
    similarity = left.descriptors @ right.descriptors.T
    best = similarity.argmax(axis=1)
    mutual = similarity.argmax(axis=0)[best] == np.arange(len(best))
    return np.flatnonzero(mutual), best[mutual]


def precision_table(title: str, pairs: Iterable[StereoImages], names: list[str]) -> None:
    pairs = list(pairs)
    print(f"\n{title}: {len(pairs)} pairs, before the epipolar band")
    print(f"{'':10s} keypoints  mutual  right  precision  spread of rows")
    for name in names:
        left, right = (FeatureExtractor(FeatureConfig(detector=name, target=600)) for _ in range(2))
        rows, correct, count, found = [], 0, 0, 0
        for pair in pairs:
            a, b = left(pair.left), right(pair.right)
            i, j = mutual_matches(a, b)
            difference = a.uv[i] - b.uv[j]
            good = (np.abs(difference[:, 1]) < 2.0) & (difference[:, 0] > 0.0)
            rows.append(difference[good, 1])
            correct, count, found = correct + good.sum(), count + len(i), found + len(a)
        n = len(pairs)
        print(
            f"{name:10s}{found / n:10.0f}{count / n:8.0f}{correct / n:7.0f}{correct / count:11.3f}"
            f"{spread(np.concatenate(rows)):13.2f} px"
        )


def repeatability_table(frames: list[TrueFrame], names: list[str]) -> None:
    print(f"\nSimulated room, {len(frames) - 1} pairs of frames 0.3 s apart, against the true motion")
    print(f"{'':10s} repeated  matched right  precision  error (spread)")
    for name in names:
        extractor = FeatureExtractor(FeatureConfig(detector=name, target=600))
        sets = [extractor(f.images.left) for f in frames]
        repeated, matched, right, total, errors = [], 0, 0, 0, []
        for k in range(len(frames) - 1):
            moved = transfer(frames[k], frames[k + 1], sets[k].uv)
            visible = np.isfinite(moved[:, 0])
            distance = np.linalg.norm(moved[visible, None] - sets[k + 1].uv[None], axis=2)
            repeated.append((distance.min(axis=1) < 2.0).mean())
            i, j = mutual_matches(sets[k], sets[k + 1])
            i, j = i[visible[i]], j[visible[i]]
            error = sets[k + 1].uv[j] - moved[i]
            good = np.linalg.norm(error, axis=1) < 2.0
            errors.append(error[good])
            matched, right, total = matched + len(i), right + good.sum(), total + visible.sum()
        print(
            f"{name:10s}{np.mean(repeated):9.3f}{right / (len(frames) - 1):15.0f}{right / matched:11.3f}"
            f"{spread(np.concatenate(errors)):13.2f} px"
        )


def main() -> None:
    cv2.setNumThreads(1)
    names = available()
    euroc = list(euroc_pairs(5))
    time_table(euroc[2].left, names)
    precision_table("EuRoC V1_01", euroc, names)
    precision_table("KITTI", kitti_pairs(5), names)
    repeatability_table(list(simulated_frames("small_room", 12, 3)), names)


if __name__ == "__main__":
    main()
