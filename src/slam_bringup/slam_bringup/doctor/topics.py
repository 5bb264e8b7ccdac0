# SPDX-License-Identifier: Apache-2.0
"""Checks that everything is there, readable, and offered so that it arrives."""

from __future__ import annotations

from collections.abc import Iterator

from slam_bringup.doctor.evidence import Evidence
from slam_bringup.doctor.finding import Finding

_LARGE_BYTES = 500_000
"""Best-effort messages beyond this are lost three times of four with the default transport."""


def check_topics(evidence: Evidence) -> Iterator[Finding]:
    """Missing images, infos and messages, and images offered best effort."""
    yield from _missing(evidence)
    for role, stream in evidence.streams.items():
        if not len(stream.stamps):
            yield Finding("empty topic", f"{stream.topic} has no message", "is the driver running?", role == "left")
        if stream.info.best_effort:
            lost = (
                "messages this large are mostly lost" if stream.largest_bytes > _LARGE_BYTES else "messages may be lost"
            )
            yield Finding(
                "best effort",
                f"{stream.topic} is offered best effort, {lost}",
                "set the driver's QoS to reliable; a node that asks for reliable (input.reliability) hears nothing",
            )
    for topic, reason in evidence.faults.items():
        yield Finding("broken messages", f"{topic}: {reason}", "check the driver's encoding and the recording")


def _missing(evidence: Evidence) -> Iterator[Finding]:
    eyes = [role for role in ("left", "right") if role in evidence.topics]
    if len(eyes) == 1:
        other = {"left": "right", "right": "left"}[eyes[0]]
        yield Finding(
            "missing images",
            f"{evidence.name(eyes[0])} has no {other} partner",
            f"record it, or --topic {other}=/...",
            prevents_mapping=not evidence.depth_role,
        )
    for role, calibration in evidence.calibrations.items():
        if calibration.info is None:
            info = "tof_info" if role in ("depth", "range") else f"{role}_info"
            yield Finding(
                "missing camera info",
                f"{evidence.name(role)} has no usable camera info on {calibration.topic}: {calibration.error}",
                f"record it (slam calibrate makes one), or --topic {info}=/...",
                True,
            )
