# SPDX-License-Identifier: Apache-2.0
"""Checks that left and right see the same on the same rows, the right one from the right, and are sharp enough."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from slam_bringup.doctor.evidence import BURST, Evidence
from slam_bringup.doctor.finding import Finding
from slam_core.geometry import FloatArray
from slam_core.types import AnyArray
from stereo_frontend.stereo.rectify import StereoRectifier

_PAIRS_PER_BURST = 3
_MOST_PIXELS = 160_000
"""Larger images are halved: rows differ by 0.12 instead of 0.07 px there, and are told from 1.5 px on."""
_FEWEST_MATCHES, _FEWEST_KEYPOINTS = 40, 100
_UPSIDE_DOWN_SHARE = 0.15
_SWAPPED_SHARE, _ROWS_APART_PX, _SEEN_BY_BOTH = 0.8, 1.5, 0.04
_DARK, _BRIGHT, _FLICKER, _EXPOSED_APART, _FROZEN = 6.0, 249.0, 0.12, 0.4, 0.25


@dataclass(frozen=True, eq=False)
class PixelMatches:
    """Matches of some pairs: rectified pixels (n, 2) left and right, stamp of each left image, keypoints in all."""

    left: FloatArray
    right: FloatArray
    stamps_ns: AnyArray
    keypoints: int


def check_stereo_images(evidence: Evidence) -> Iterator[Finding]:
    """Each camera's exposure and life, then what both see."""
    for role in ("left", "right"):
        yield from _exposure(evidence, role)
    pairs = evidence.pairs()
    if not pairs:
        return
    if all(left.shape == right.shape and np.array_equal(left, right) for _, left, right in pairs):
        yield Finding("one camera twice", "left and right are the same image", "is one camera on both topics?", True)
        return
    yield from _exposed_apart(pairs)
    matches = match_pairs(evidence)
    if matches is not None:
        yield from _geometry(matches)


def match_pairs(evidence: Evidence) -> PixelMatches | None:
    """SIFT matches of some rectified pairs; None without a usable calibration."""
    left, right = (evidence.rectified_info(role) for role in ("left", "right"))
    if left is None or right is None:
        return None
    try:
        rectifier = StereoRectifier(left, right)
        chosen = evidence.pairs()[:: BURST // _PAIRS_PER_BURST]
        images = [rectifier(stamp, first, second) for stamp, first, second in chosen]
    except ValueError:
        return None
    found = [_match(pair.left, pair.right) for pair in images]
    stamps = np.repeat(np.array([stamp for stamp, *_ in chosen], dtype=np.int64), [len(a) for a, _, _ in found])
    a, b = (np.concatenate([f[i] for f in found]) if found else np.empty((0, 2)) for i in (0, 1))
    return PixelMatches(a, b, stamps, sum(n for _, _, n in found))


def _match(left: AnyArray, right: AnyArray) -> tuple[FloatArray, FloatArray, int]:
    sift, scale = cv2.SIFT_create(400), 1  # type: ignore[attr-defined]
    while left.size // scale**2 > _MOST_PIXELS:
        scale *= 2
    size = (left.shape[1] // scale, left.shape[0] // scale)
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) if scale > 1 else image for image in (left, right)]
    (kl, dl), (kr, dr) = (sift.detectAndCompute(image, None) for image in small)
    none = np.empty((0, 2))
    if dl is None or dr is None or len(kr) < 2:
        return none, none, len(kl)
    ratio = [m for m, n in cv2.BFMatcher().knnMatch(dl, dr, k=2) if m.distance < 0.7 * n.distance]
    points = ([kl[m.queryIdx].pt for m in ratio], [kr[m.trainIdx].pt for m in ratio])
    a, b = (scale * (np.array(p, dtype=np.float64).reshape(-1, 2) + 0.5) - 0.5 for p in points)
    return a, b, len(kl)


def _geometry(matches: PixelMatches) -> Iterator[Finding]:
    if matches.keypoints < _FEWEST_KEYPOINTS:
        return
    if len(matches.left) < max(_SEEN_BY_BOTH * matches.keypoints, 1):
        yield Finding(
            "nothing in common",
            f"only {len(matches.left)} of {matches.keypoints} features of the left images are found in the right ones",
            "do the cameras look the same way, is one upside down or mirrored?",
        )
        return
    if len(matches.left) < _FEWEST_MATCHES:
        return
    d = matches.left - matches.right
    rows = float(np.median(np.abs(d[:, 1])))
    if rows > _UPSIDE_DOWN_SHARE * np.ptp(matches.left[:, 1]):
        yield Finding(
            "nothing in common",
            f"the same features lie {rows:.0f} px higher or lower in the other camera",
            "do the cameras look the same way, is one upside down or mirrored?",
        )
        return
    on_row = np.abs(d[:, 1]) < max(2.0, 2 * rows)
    if np.mean(d[on_row, 0] < -1.0) > _SWAPPED_SHARE:
        yield Finding(
            "left and right swapped",
            f"{np.mean(d[on_row, 0] < -1.0):.0%} of the features lie further right in the right image",
            "exchange the two image topics (--topic left=... --topic right=...)",
            True,
        )
    elif rows > _ROWS_APART_PX:
        yield Finding(
            "not rectified",
            f"left and right differ by {rows:.1f} px in their rows (median of {len(d)} features)",
            "calibrate the pair; images called rect must be rectified",
        )


def _exposure(evidence: Evidence, role: str) -> Iterator[Finding]:
    images = [image for _, image in sorted(evidence.images.get(role, {}).items())]
    if len(images) < 4:
        return
    topic, mean = evidence.name(role), np.array([image.mean() for image in images])
    if np.median(mean) < _DARK:
        yield Finding("dark", f"{topic} is black (mean {np.median(mean):.0f} of 255)", "lens cap, light or exposure?")
        return
    if np.median([np.mean(image > _BRIGHT) for image in images]) > 0.5:
        yield Finding("overexposed", f"more than half of {topic} is white", "lower exposure or gain")
    same = [np.array_equal(a, b) for a, b in pairwise(images)]
    if np.mean(same) > _FROZEN:
        yield Finding(
            "frozen camera",
            f"{np.mean(same):.0%} of the images of {topic} are exact copies of the one before",
            "does the driver repeat frames? lower its rate to the camera's",
        )
    second = np.abs(mean[2:] - 2 * mean[1:-1] + mean[:-2]) / np.maximum(mean[1:-1], 1.0) / 2.0
    if np.median(second) > _FLICKER:
        yield Finding(
            "flicker",
            f"the brightness of {topic} changes to and fro by {np.median(second):.0%} a frame",
            "fix the exposure, a multiple of the lamps' period; switch the IR projector off",
        )


def _exposed_apart(pairs: list[tuple[int, AnyArray, AnyArray]]) -> Iterator[Finding]:
    ratio = float(np.median([max(left.mean(), 1.0) / max(right.mean(), 1.0) for _, left, right in pairs]))
    if abs(np.log(ratio)) > _EXPOSED_APART:
        yield Finding(
            "exposed apart",
            f"the left images are {ratio:.2f} times as bright as the right ones",
            "let both cameras share exposure and gain",
        )
