# SPDX-License-Identifier: Apache-2.0
"""Checks that depth is there, in metres, and where the other images say it is."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from slam_bringup.doctor.evidence import Evidence
from slam_bringup.doctor.finding import Finding
from slam_bringup.doctor.stereo_images import match_pairs
from slam_core.camera import MIN_DEPTH, Camera
from slam_core.geometry import FloatArray, transform_points
from slam_core.types import AnyArray
from stereo_frontend.stereo.rectify import stereo_camera_from_infos

_FARTHEST_M, _NEAREST_M, _FEWEST_VALID = 40.0, MIN_DEPTH, 0.02
_FEWEST, _SCALE, _SPREAD = 40, 0.1, 0.045
"""Matches, and limits of the ratio of depths: of its median from one, and between its quartiles."""
_SURE_DISPARITY_PX = 6.0
"""Below it a tenth of a pixel of disparity is more than a hundredth of the depth."""
_REACH_M, _PIXELS = 6.0, 3.0
_FEWEST_EDGES = 300
_SHIFT_PX, _SHIFT_GAIN = 5, 1.25
_SEARCH_PX = 24


def check_depth_images(evidence: Evidence) -> Iterator[Finding]:
    """Units and emptiness, then against stereo, or against the picture of the same camera."""
    role = evidence.depth_role
    images = list(evidence.images.get(role, {}).values()) if role else []
    if not images:
        return
    topic = evidence.name(role)
    valid = np.concatenate([image[np.isfinite(image)] for image in images])
    if len(valid) < _FEWEST_VALID * sum(image.size for image in images):
        yield Finding("no depth", f"less than {_FEWEST_VALID:.0%} of {topic} has a value", "is something in its way?")
        return
    middle = float(np.median(valid))
    if not _NEAREST_M < middle < _FARTHEST_M:
        unit = "millimetres as metres" if middle > 1.0 else "metres as millimetres"
        yield Finding(
            "depth unit",
            f"the median depth of {topic} is {middle:.3g} m: {unit}?",
            "32FC1 is metres, 16UC1 millimetres (REP-118); mend the driver's encoding",
        )
        return
    yield from _against_stereo(evidence)
    if "left" not in evidence.topics:
        yield from _against_picture(evidence)


def _against_stereo(evidence: Evidence) -> Iterator[Finding]:
    ratios = _depth_ratios(evidence)
    if len(ratios) < _FEWEST:
        return
    low, middle, high = np.percentile(ratios, [25, 50, 75])
    topic = evidence.name(evidence.depth_role)
    if high - low > _SPREAD * middle:
        yield Finding(
            "depth elsewhere",
            f"{topic} and stereo disagree from point to point (quartiles of their ratio {low:.2f} and {high:.2f})",
            "check the transform between the cameras and their stamps",
        )
    elif abs(middle - 1.0) > _SCALE:
        yield Finding(
            "depth scale",
            f"{topic} is {middle:.2f} times the depth of stereo",
            "check the baseline and focal length, the depth's unit, and range against depth",
        )


def _depth_ratios(evidence: Evidence) -> FloatArray:
    """Depth of the depth camera over that of stereo, at matches of the pairs that both see within reach."""
    matches, left = match_pairs(evidence), evidence.calibrations.get("left")
    depth = evidence.calibrations[evidence.depth_role]
    infos = [evidence.rectified_info(role) for role in ("left", "right")]
    if matches is None or left is None or depth.info is None or infos[0] is None or infos[1] is None:
        return np.empty(0)
    try:
        T_left_depth = evidence.frames.lookup(left.frame, depth.frame)
    except ValueError:
        return np.empty(0)
    stereo = stereo_camera_from_infos(infos[0], infos[1])
    ratios = [np.empty(0)]
    for stamp, image in evidence.depth_beside_left().items():
        of_pair = matches.stamps_ns == stamp
        if not of_pair.any():
            continue
        pixels, d = matches.left[of_pair], (matches.left - matches.right)[of_pair]
        good = (d[:, 0] > _SURE_DISPARITY_PX) & (np.abs(d[:, 1]) < 2.0)
        z = stereo.depth_from_disparity(d[good, 0])
        points = transform_points(T_left_depth, _points(image, depth.info.camera, evidence.depth_role == "range"))
        ratios.append(_ratios(pixels[good], z, points, stereo.camera))
    return np.concatenate(ratios)


def _points(image: AnyArray, camera: Camera, is_range: bool) -> FloatArray:
    v, u = np.nonzero(np.isfinite(image))
    pixels, value = np.column_stack([u, v]).astype(np.float64), image[v, u].astype(np.float64)
    if is_range:
        rays = camera.normalised_from_pixels(pixels)
        value = value / np.sqrt(1.0 + (rays**2).sum(axis=1))
    points = camera.unproject(pixels, value)
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def _ratios(pixels: FloatArray, z: FloatArray, points: FloatArray, camera: Camera) -> FloatArray:
    ahead = points[points[:, 2] > 0.1]
    near = z < _REACH_M
    if not len(ahead) or not near.any():
        return np.empty(0)
    seen = camera.project(ahead)
    found = []
    for pixel, depth in zip(pixels[near], z[near], strict=True):
        close = np.abs(seen - pixel).max(axis=1) < _PIXELS
        if close.any():
            found.append(np.median(ahead[close, 2]) / depth)
    return np.array(found)


def _against_picture(evidence: Evidence) -> Iterator[Finding]:
    """Edges of depth lie on edges of the picture of the same camera; a shift that fits much better is a fault."""
    pictures, depths = (evidence.images.get(r, {}) for r in ("amplitude", evidence.depth_role))
    common = [(pictures[s], depths[s]) for s in sorted(pictures.keys() & depths.keys())]
    if len(common) < 3 or common[0][0].shape != common[0][1].shape:
        return
    scores = [s for s in (_edge_overlap(picture, depth) for picture, depth in common[::3]) if s is not None]
    if len(scores) < 3:
        return
    score = np.mean(scores, axis=0)
    v, u = np.unravel_index(int(np.argmax(score)), score.shape)
    shift = (int(u) - _SEARCH_PX, int(v) - _SEARCH_PX)
    if max(map(abs, shift)) > _SHIFT_PX and score[v, u] > _SHIFT_GAIN * score[_SEARCH_PX, _SEARCH_PX]:
        yield Finding(
            "not registered",
            f"the edges of depth lie ({shift[0]}, {shift[1]}) px from those of the picture",
            "publish depth registered to the colour camera, or slam convert rgbd, which registers it",
        )


def _edge_overlap(picture: AnyArray, depth: AnyArray) -> FloatArray | None:
    """Mean strength of picture edges at the depth edges, for every shift of the depth; (2 n + 1, 2 n + 1).

    None where depth has hardly an edge.
    """
    grey = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 1.5)
    strength = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    strength = np.minimum(strength, np.percentile(strength, 95))
    z = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
    both = (z > 0) & (cv2.erode((z > 0).astype(np.uint8), np.ones((5, 5))) > 0)
    edges = (np.hypot(cv2.Sobel(z, cv2.CV_32F, 1, 0), cv2.Sobel(z, cv2.CV_32F, 0, 1)) > 0.4 * np.maximum(z, 0.1)) & both
    n = _SEARCH_PX
    inner = edges[n:-n, n:-n].astype(np.float32)
    if inner.sum() < _FEWEST_EDGES:
        return None
    return np.asarray(cv2.matchTemplate(strength, inner, cv2.TM_CCORR) / float(inner.sum())) + 1e-6
