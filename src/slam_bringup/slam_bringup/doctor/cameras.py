# SPDX-License-Identifier: Apache-2.0
"""Checks of a rig with several cameras: whether their images belong together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from slam_bags.reading.rig_cameras import shared_frame
from slam_bringup.doctor.evidence import Evidence
from slam_bringup.doctor.finding import Finding
from slam_core.nodes.synchronizer import PAIRING_TOLERANCE_S

_SHARED = 0.5
"""Share of the slower camera's stamps that a camera has to have in common with the first."""
_GONE_S = 1.0
"""Time for which a camera has no images before that is told."""


def rigs_in(evidences: Sequence[Evidence]) -> dict[str, list[Evidence]]:
    """Evidence of the cameras of each rig with several, by the rig's namespace."""
    rigs: dict[str, list[Evidence]] = {}
    for evidence in evidences:
        if evidence.camera:
            rigs.setdefault(evidence.rig, []).append(evidence)
    return rigs


def cameras_text(rigs: Mapping[str, Sequence[Evidence]]) -> str:
    """A line for each rig with several cameras, which names them and what each is; "" without one."""
    lines = []
    for rig, cameras in rigs.items():
        named = [f"{own.camera} ({' and '.join(_kinds(own))})" for own in cameras]
        lines.append(f"{f'rig {rig}' if rig else 'one rig'} with {len(cameras)} cameras: {', '.join(named)}")
    return "\n".join(lines)


def check_rig(cameras: Sequence[Evidence]) -> Iterator[Finding]:
    """Cameras with one frame or no common trigger, and such as have no images for a part of the recording."""
    frames = {
        own.camera: {c.frame for role, c in own.calibrations.items() if role != "right"} - {""} for own in cameras
    }
    if same := shared_frame(frames):
        what, _, advice = same.partition(": ")
        yield Finding("one frame", what, advice, prevents_mapping=True)
    stamps = {own.camera: np.sort(own.leader.stamps) for own in cameras if len(own.leader.stamps)}
    if not stamps:
        return
    first, *others = stamps
    begin, end = min(s[0] for s in stamps.values()), max(s[-1] for s in stamps.values())
    for name in others:
        shared = _shared(stamps[first], stamps[name])
        if shared < _SHARED * min(len(stamps[first]), len(stamps[name])):
            yield Finding(
                "no common trigger",
                f"camera {name}: {shared} of {len(stamps[name])} images have the stamp of one of camera {first}, "
                f"within {1000 * PAIRING_TOLERANCE_S:g} ms",
                "give the cameras one trigger or clock, at one rate or a multiple; without it only one of them is used",
            )
    for name, own in stamps.items():
        edges = np.concatenate([[begin], own, [end]])
        longest = float(np.diff(edges).max()) * 1e-9
        if longest > _GONE_S:
            yield Finding(
                "camera gone",
                f"camera {name} has no images for {longest:.1f} s",
                "check its cable and driver; the map goes on with the other cameras",
            )


def _shared(a: np.ndarray, b: np.ndarray) -> int:
    """Number of the stamps b (m,) ns, sorted, that have one of a (n,) beside them."""
    at = np.searchsorted(a, b)
    nearest = np.minimum(np.abs(a[np.minimum(at, len(a) - 1)] - b), np.abs(a[np.maximum(at - 1, 0)] - b))
    return int(np.sum(nearest <= PAIRING_TOLERANCE_S * 1e9))


def _kinds(evidence: Evidence) -> list[str]:
    kinds = ["stereo"] * ({"left", "right"} <= evidence.topics.keys()) + ["depth"] * bool(evidence.depth_role)
    return kinds or ["one image of a pair"]
