# SPDX-License-Identifier: Apache-2.0
"""All checks of a recording, in the order in which their faults would hide each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from slam_bags.reading.sensor_topics import BagNames
from slam_bringup.doctor.calibration import check_calibration
from slam_bringup.doctor.cameras import cameras_text, check_rig, rigs_in
from slam_bringup.doctor.depth_images import check_depth_images
from slam_bringup.doctor.evidence import Evidence, gather
from slam_bringup.doctor.finding import Finding
from slam_bringup.doctor.frames import check_frames
from slam_bringup.doctor.imu import check_imu
from slam_bringup.doctor.odometry import check_odometry
from slam_bringup.doctor.positions import check_positions
from slam_bringup.doctor.pressure import check_pressure
from slam_bringup.doctor.stamps import check_stamps
from slam_bringup.doctor.stereo_images import check_stereo_images
from slam_bringup.doctor.topics import check_topics

CHECKS: tuple[Callable[[Evidence], Iterator[Finding]], ...] = (
    check_topics, check_stamps, check_frames, check_calibration, check_stereo_images, check_depth_images, check_imu,
    check_odometry, check_positions, check_pressure,
)  # fmt: skip
GROUPS = tuple(check.__name__.removeprefix("check_").replace("_", " ") for check in CHECKS)
"""Names of the checks, in their order."""
_FIRST_MESSAGES = 120


def examine(path: Path, names: BagNames | None = None) -> list[Finding]:
    """Everything that is wrong with a bag, agent by agent; empty if nothing is.

    Raises
    ------
    ValueError
        If there is no bag with images to look at.
    """
    return examined(path, names)[0]


def examined(path: Path, names: BagNames | None = None) -> tuple[list[Finding], str]:
    """Everything that is wrong with a bag, and the names of the cameras of a rig that has several, or "".

    Raises
    ------
    ValueError
        If there is no bag with images to look at.
    """
    evidences = gather(path, names)
    rigs = rigs_in(evidences)
    found = [finding for evidence in evidences for check in CHECKS for finding in _named(evidence, check)]
    return [*found, *(finding for cameras in rigs.values() for finding in check_rig(cameras))], cameras_text(rigs)


def require_stereo(path: Path, names: BagNames | None = None) -> None:
    """Refuse a bag whose first images show that stereo can never work: swapped, no baseline, one camera twice.

    Raises
    ------
    ValueError
        With what is wrong and what to do.
    """
    for evidence in gather(path, names, messages=_FIRST_MESSAGES):
        for check in (check_calibration, check_stereo_images):
            for finding in check(evidence):
                if finding.prevents_mapping:
                    raise ValueError(str(finding))


def _named(evidence: Evidence, check: Callable[[Evidence], Iterator[Finding]]) -> Iterator[Finding]:
    for finding in check(evidence):
        who = f"camera {evidence.camera}" if evidence.camera else f"agent {evidence.agent}"
        yield replace(finding, what=f"{who}: {finding.what}") if evidence.agent else finding
