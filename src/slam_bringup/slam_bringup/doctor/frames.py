# SPDX-License-Identifier: Apache-2.0
"""Checks that it is known where every sensor sits, in the axes of REP-103."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from slam_bags.reading.agent_stream import FOLLOWING
from slam_bringup.doctor.evidence import Evidence
from slam_bringup.doctor.finding import Finding
from slam_core.camera import CameraInfo
from slam_core.geometry import FloatArray

_FARTHEST_M = 5.0
_BASELINES_DIFFER = 0.1


def check_frames(evidence: Evidence) -> Iterator[Finding]:
    """Missing transforms, frames that nobody knows, optical frames without their turn, mountings out of reach."""
    roles = [r for r in ("left", evidence.depth_role) if r and r in evidence.calibrations]
    if not evidence.frames.frames:
        yield from _no_transforms(evidence, roles)
        return
    for role in roles:
        yield from _mounting(evidence, role, evidence.calibrations[role].frame)
        yield from _disagreement(evidence, role)
    for role in FOLLOWING:
        if role in evidence.image_frames:
            yield from _mounting(evidence, role, evidence.image_frames[role])
    yield from _right_camera(evidence)


def _no_transforms(evidence: Evidence, roles: list[str]) -> Iterator[Finding]:
    """Sensors that nothing joins to the rig's frame; a camera that is the rig's frame itself needs no transform."""
    frames = [evidence.calibrations[role].frame for role in roles]
    frames += [frame for role, frame in evidence.image_frames.items() if role in FOLLOWING]
    unknown = sorted({frame for frame in frames if frame != evidence.base_frame})
    if not unknown:
        return
    own = f", or map in a camera's own axes: --base-frame {unknown[0]}" if not evidence.base_frame else ""
    yield Finding(
        "missing transforms",
        f"there are no static transforms (/tf_static) to {', '.join(unknown)}",
        f"record /tf_static, publish them with static_transform_publisher{own}",
    )


def _mounting(evidence: Evidence, role: str, frame: str) -> Iterator[Finding]:
    """A camera's frame in base_link; without base_link the camera's own axes are taken, which is said elsewhere."""
    if frame == evidence.base_frame:
        return
    if frame not in evidence.frames:
        known = ", ".join(evidence.frames.frames)
        yield Finding(
            "unknown frame",
            f"'{frame}' of {evidence.name(role)} is not among the static transforms ({known})",
            "publish its transform, or mend frame_id in the driver",
        )
        return
    T = _lookup(evidence, evidence.base_frame, frame) if evidence.base_frame else None
    if T is None:
        if evidence.base_frame:
            yield Finding(
                "missing transforms",
                f"no static transforms join '{frame}' of {evidence.name(role)} to {evidence.base_frame}",
                "record them, or name another frame of the rig: --base-frame",
            )
        return
    if role not in FOLLOWING and np.allclose(T[:3, :3], np.eye(3), atol=1e-3):
        yield Finding(
            "optical frame",
            f"'{frame}' has the axes of {evidence.base_frame}, an optical frame has x right, y down, z forward",
            "turn it by yaw -90, pitch 0, roll -90 deg (REP-103)",
        )
    if np.linalg.norm(T[:3, 3]) > _FARTHEST_M:
        yield Finding(
            "mounting",
            f"'{frame}' sits {np.linalg.norm(T[:3, 3]):.1f} m from {evidence.base_frame}",
            "transforms are in metres",
        )


def _disagreement(evidence: Evidence, role: str) -> Iterator[Finding]:
    image, info = evidence.image_frames.get(role, ""), evidence.calibrations[role].frame
    if image and info and image != info and image not in evidence.frames:
        yield Finding(
            "two frames", f"{evidence.name(role)} is in '{image}', its info in '{info}'", "give both one frame_id"
        )


def _right_camera(evidence: Evidence) -> Iterator[Finding]:
    """The transform between the two cameras must have the length of the baseline."""
    left, right = (evidence.calibrations.get(r) for r in ("left", "right"))
    if left is None or right is None or not isinstance(left.info, CameraInfo) or not isinstance(right.info, CameraInfo):
        return
    T = _lookup(evidence, left.frame, right.frame) if right.frame in evidence.frames else None
    baseline = abs(right.info.baseline - left.info.baseline)
    if T is None or left.frame == right.frame or not baseline:
        return
    distance = float(np.linalg.norm(T[:3, 3]))
    if abs(distance - baseline) > _BASELINES_DIFFER * baseline:
        yield Finding(
            "two baselines",
            f"the transforms put the cameras {distance:.4g} m apart, the infos {baseline:.4g} m",
            "the nodes take the infos; calibrate again if these are wrong",
        )


def _lookup(evidence: Evidence, target: str, source: str) -> FloatArray | None:
    try:
        return evidence.frames.lookup(target, source)
    except ValueError:
        return None
