# SPDX-License-Identifier: Apache-2.0
"""Checks that the camera infos describe cameras, a pair, and these images."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from slam_bringup.doctor.evidence import Evidence
from slam_bringup.doctor.finding import Finding
from stereo_frontend.stereo.rectify import stereo_camera_from_infos

_LARGEST_BASELINE_M, _SMALLEST_BASELINE_M = 3.0, 0.005
_WIDEST_DEG, _NARROWEST_DEG = 175.0, 15.0
_CENTRE = (0.25, 0.75)


def check_calibration(evidence: Evidence) -> Iterator[Finding]:
    """Sizes, angles of view and centres of each camera, then the baseline of the pair."""
    for role in evidence.calibrations:
        yield from _camera(evidence, role)
    yield from _baseline(evidence)


def _camera(evidence: Evidence, role: str) -> Iterator[Finding]:
    info = evidence.rectified_info(role)
    images = evidence.images.get(role, {})
    if info is None or not images:
        return
    camera, shape = info.camera, next(iter(images.values())).shape
    topic = evidence.calibrations[role].topic
    if shape != (camera.height, camera.width):
        yield Finding(
            "image size",
            f"{evidence.name(role)} is {shape[1]} x {shape[0]} px, its info on {topic} says "
            f"{camera.width} x {camera.height}",
            "calibrate at the size that is used, or scale the info",
            True,
        )
    angle = np.degrees(2 * np.arctan(camera.width / 2 / camera.fx))
    if camera.distortion_model != "equidistant" and not _NARROWEST_DEG < angle < _WIDEST_DEG:
        yield Finding("focal length", f"{topic} means an angle of view of {angle:.0f} deg", "focal lengths are in px")
    centre = (camera.cx / camera.width, camera.cy / camera.height)
    if not all(_CENTRE[0] < c < _CENTRE[1] for c in centre):
        yield Finding(
            "image centre",
            f"{topic} has its centre at ({camera.cx:.0f}, {camera.cy:.0f}) of {camera.width} x {camera.height} px",
            "does the info belong to another size, or a crop?",
        )


def _baseline(evidence: Evidence) -> Iterator[Finding]:
    left, right = (evidence.rectified_info(role) for role in ("left", "right"))
    if left is None or right is None:
        return
    try:
        baseline = stereo_camera_from_infos(left, right).baseline
    except ValueError as error:
        yield Finding("baseline", str(error), "calibrate the pair, or exchange its two infos", True)
        return
    if not _SMALLEST_BASELINE_M < baseline < _LARGEST_BASELINE_M:
        unit = "millimetres taken as metres?" if baseline > 1.0 else "metres taken as kilometres?"
        yield Finding("baseline unit", f"the baseline is {baseline:g} m: {unit}", "P[0, 3] is -fx * baseline, px m")
