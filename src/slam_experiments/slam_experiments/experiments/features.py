# SPDX-License-Identifier: Apache-2.0
"""Chapter 3: SURF against SIFT and others on stereo pictures, and features on the laser camera's pictures."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from slam_core.geometry import FloatArray, invert_transform, transform_points
from slam_core.types import ByteArray, DepthImage
from slam_experiments import thesis
from slam_experiments.experiments.feature_figures import (
    derivative_figure,
    keypoint_figure,
    match_figure,
    matched_pair,
    tof_figure,
)
from slam_experiments.findings import Comparison, Experiment, Findings, Picture, Table
from slam_experiments.job import RENDERING, Job, JobResult, Kept
from slam_experiments.simulated.true_frames import TrueFrame, simulated_frames, spread, transfer
from stereo_frontend.depth.depth_lookup import sample_depth
from stereo_frontend.depth.tof_features import CLIP, GAMMA, normalised_picture
from stereo_frontend.detection.features import DETECTORS, FeatureConfig, FeatureExtractor
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.surf.surf import SurfConfig
from stereo_frontend.surf.surf_device import best_opencl_device

MODULE = "slam_experiments.experiments.features"
_PACKAGES = (*RENDERING, "stereo_frontend", "tof_driver", "slam_experiments.simulated.true_frames")
_SIZES = ((320, 240), (640, 480), (1024, 768))
_DETECTORS = {name: FeatureConfig(detector=name) for name in DETECTORS} | {
    "surf-64": FeatureConfig(surf=SurfConfig(extended=False))
}
_GPU_SURF = "gpu-surf"
_NOT_BUILT = {
    "star": "not in opencv-python-headless; as censure, with two squares for an octagon",
    "susure": "not built: sparse sampling of censure's responses saved no time (docs/history/tried.md)",
}
"""Rows of detectors that are only told of."""
_NO_OPENCL = {_GPU_SURF: "not measured: needs pyopencl and an OpenCL device"}
_KINDS = ("amplitude", "range", "intensity")
_SAME_PX = 2.0
"""Two keypoints this near show the same point."""


def compare_detectors(folder: Path, before: list[Path], frames: int, repeats: int) -> Kept:
    """Table 3.1: time and features of every detector; what of it is found again, three frames later."""
    cv2.setNumThreads(1)
    views = list(simulated_frames("small_room", frames, 3))
    values: dict[str, dict[str, object]] = {}
    for name, config in (_DETECTORS | _gpu_surf()).items():
        extractor = FeatureExtractor(replace(config, target=600))
        found = [extractor(view.images.left) for view in views]
        values[name] = {"times": _times(config, views[0].images.left, repeats), **_found_again(views, found)}
    images = views[0].images
    return values, {"left": images.left, "right": images.right, "matches": matched_pair(images)}


def _gpu_surf() -> dict[str, FeatureConfig]:
    """SURF on a GPU, else on another OpenCL device, with that in the name; none where there is no OpenCL."""
    best = best_opencl_device()
    if best is None:
        return {}
    name, is_gpu = best
    return {f"{_GPU_SURF}{'' if is_gpu else ' without a GPU'}, wall time on {name}": FeatureConfig(device=name)}


def _times(config: FeatureConfig, picture: ByteArray, repeats: int) -> list[tuple[float, int]]:
    """Median milliseconds of one thread, or on the wall, and number of features of each picture size, 500 asked for."""
    rows, clock = [], time.thread_time if config.device == "cpu" else time.perf_counter
    for size in _SIZES:
        scaled = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        extractor = FeatureExtractor(replace(config, target=500))
        count, elapsed = 0, []
        for _ in range(repeats + 3):  # the first ones compile, and settle the threshold
            began = clock()
            count = len(extractor(scaled))
            elapsed.append(1e3 * (clock() - began))
        rows.append((float(np.median(elapsed[3:])), count))
    return rows


def _found_again(views: Sequence[TrueFrame], found: Sequence[Keypoints]) -> dict[str, float]:
    """Repeatability, precision of mutual best matches and their spread, px, between consecutive views."""
    repeated, matched, right, errors = [], 0, 0, []
    for k in range(len(views) - 1):
        moved = transfer(views[k], views[k + 1], found[k].uv)
        visible = np.isfinite(moved[:, 0])
        distance = np.linalg.norm(moved[visible, None] - found[k + 1].uv[None], axis=2)
        repeated.append((distance.min(axis=1) < _SAME_PX).mean())
        i, j = mutual_matches(found[k], found[k + 1])
        i, j = i[visible[i]], j[visible[i]]
        error = found[k + 1].uv[j] - moved[i]
        good = np.linalg.norm(error, axis=1) < _SAME_PX
        errors.append(error[good])
        matched, right = matched + len(i), right + int(good.sum())
    pairs = len(views) - 1
    return {
        "repeatability": float(np.mean(repeated)),
        "right": right / pairs,
        "precision": right / max(matched, 1),
        "spread_px": spread(np.concatenate(errors)),
    }


def mutual_matches(first: Keypoints, second: Keypoints) -> tuple[np.ndarray, np.ndarray]:
    """Indices (k,), (k,) of keypoints whose descriptors are each other's best."""
    similarity = first.descriptors @ second.descriptors.T
    best = similarity.argmax(axis=1)
    mutual = similarity.argmax(axis=0)[best] == np.arange(len(best))
    return np.flatnonzero(mutual), best[mutual]


def compare_tof_pictures(folder: Path, before: list[Path], frames: int) -> Kept:
    """Section 3.3: repeatability of features of amplitude, range and intensity pictures."""
    views = [view for view in simulated_frames("small_room", frames, 3) if view.depth is not None]
    values = {kind: _tof_found_again(views, kind) for kind in _KINDS}
    depth = views[0].depth
    assert depth is not None
    return values, {kind: tof_picture(depth, kind) for kind in _KINDS}


def tof_picture(image: DepthImage, kind: str) -> ByteArray:
    """One of the laser camera's pictures as features are looked for in it, uint8."""
    if kind == "range":
        return normalised_picture(image.depth, CLIP, 1.0)
    values = image.amplitude if kind == "amplitude" else image.intensity
    assert values is not None
    return normalised_picture(values, CLIP, GAMMA)


def _tof_found_again(views: Sequence[TrueFrame], kind: str) -> dict[str, float]:
    extractor = FeatureExtractor(FeatureConfig(target=300))
    found = [_with_depth(extractor, view.depth, kind) for view in views if view.depth is not None]
    repeated, right, matched = [], 0, 0
    for k in range(len(views) - 1):
        (a, depth), (b, _) = found[k], found[k + 1]
        moved = _place_in_next(views[k], views[k + 1], a, depth)
        visible = np.isfinite(moved[:, 0])
        distance = np.linalg.norm(moved[:, None] - b.uv[None], axis=2)
        repeated.append((distance[visible].min(axis=1) < _SAME_PX).mean())
        i, j = mutual_matches(a, b)
        i, j = i[visible[i]], j[visible[i]]
        right, matched = right + int((distance[i, j] < _SAME_PX).sum()), matched + len(i)
    return {
        "features": float(np.mean([len(f[0]) for f in found])),
        "repeatability": float(np.mean(repeated)),
        "right": right / (len(views) - 1),
        "precision": right / max(matched, 1),
    }


def _with_depth(extractor: FeatureExtractor, image: DepthImage, kind: str) -> tuple[Keypoints, FloatArray]:
    """Keypoints that have a depth below them: the others cannot be used."""
    keypoints = extractor(tof_picture(image, kind))
    depth = sample_depth(image, keypoints.uv).depth
    known = np.isfinite(depth)
    return keypoints.select(known), depth[known].astype(np.float64)


def _place_in_next(first: TrueFrame, second: TrueFrame, keypoints: Keypoints, depth: FloatArray) -> FloatArray:
    assert first.depth is not None
    camera = first.depth.camera
    T_first, T_second = (f.T_world_left @ f.T_left_tof for f in (first, second))
    points = transform_points(
        invert_transform(T_second) @ T_first, camera.unproject(keypoints.uv.astype(np.float64), depth)
    )
    pixels = camera.project(points)
    inside = np.all((pixels > 6) & (pixels < [camera.width - 7, camera.height - 7]), axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def _detectors() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        arguments = {"frames": 2 if quick else 12, "repeats": 1 if quick else 11}
        return {"table": Job(f"{MODULE}:compare_detectors", arguments, _PACKAGES)}

    def report(results: Mapping[str, JobResult]) -> Findings:
        values, arrays = results["table"].values, results["table"].arrays
        times = {name: v["times"] for name, v in values.items()}
        ratio = times["surf"][1][0] / times["sift"][1][0]
        gpu_rates = {name: 1e3 / t[1][0] for name, t in times.items() if name.startswith(_GPU_SURF)}
        rows = [
            [
                name,
                *(f"{ms:.1f} ms, {count}" for ms, count in v["times"]),
                f"{v['repeatability']:.2f}",
                f"{v['right']:.0f}",
                f"{v['precision']:.3f}",
                f"{v['spread_px']:.2f}",
            ]
            for name, v in values.items()
        ] + [[name, why, *[""] * 6] for name, why in (_NOT_BUILT | ({} if gpu_rates else _NO_OPENCL)).items()]
        header = ("detector", *(f"{w} x {h}" for w, h in _SIZES), "repeatability", "right matches", "precision",
                  "spread px")  # fmt: skip
        return Findings(
            [
                Comparison(f"{name}, ms a picture at 640 x 480", claim, f"{times[name][1][0]:.0f}")
                for name, claim in (("sift", thesis.SIFT_MS), ("surf", thesis.SURF_MS))
            ]
            + [
                Comparison(f"{name}: frames a second at 640 x 480", thesis.GPU_SURF, f"{rate:.0f}")
                for name, rate in gpu_rates.items()
            ]
            + [Comparison("SURF's time over SIFT's", thesis.SURF_FASTER, f"{ratio:.2f}", "< 1", ratio < 1)],
            [Table("Table 3.1: time of one thread and number of features; matching three frames later", header, rows)],
            [
                Picture(keypoint_figure(arrays["left"]), "3.1, 3.2", "Keypoints of SURF and SIFT."),
                Picture(
                    match_figure(arrays["left"], arrays["right"], arrays["matches"]),
                    "3.3",
                    f"{len(arrays['matches'])} SURF features matched in a stereo pair.",
                ),
            ],
        )

    return Experiment("detectors", "3.2", "SIFT against SURF", jobs, report)


_RANGE_CONTRADICTED = (
    "The thesis calls the range image's features the best, by eye and on real scans. Measured here they are the worst:"
    " {repeatability:.2f} are found again and {right:.0f} a pair of pictures matched right."
)


def _tof_features() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        return {"table": Job(f"{MODULE}:compare_tof_pictures", {"frames": 3 if quick else 20}, _PACKAGES)}

    def report(results: Mapping[str, JobResult]) -> Findings:
        values, arrays = results["table"].values, results["table"].arrays
        verdict = {"amplitude": thesis.AMPLITUDE, "range": thesis.RANGE, "intensity": thesis.INTENSITY}
        formats = {"features": ".0f", "repeatability": ".2f", "right": ".0f", "precision": ".2f"}
        rows = [[kind, *(f"{v[key]:{form}}" for key, form in formats.items())] for kind, v in values.items()]
        return Findings(
            [
                Comparison(f"repeatability on {kind}", verdict[kind], f"{values[kind]['repeatability']:.2f}")
                for kind in _KINDS
            ],
            [
                Table(
                    "Features with a depth below them, three frames later",
                    ("picture", "features", "repeatability", "right matches", "precision"),
                    rows,
                )
            ],
            [
                Picture(tof_figure(arrays), "3.4", "Features in the pictures of the laser camera."),
                Picture(
                    derivative_figure({kind: arrays[kind] for kind in ("amplitude", "intensity")}),
                    "3.5",
                    "Features of amplitude and intensity lie near edges: the pictures differentiated.",
                ),
            ],
            _RANGE_CONTRADICTED.format(**values["range"]),
        )

    return Experiment("tof_features", "3.3", "Features on the laser camera's pictures", jobs, report)


EXPERIMENTS = (_detectors(), _tof_features())
