# SPDX-License-Identifier: Apache-2.0
"""Checks that an external odometry comes often enough, does not jump, and says how good it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from ekf_slam_node.odometry.pose_readings import PoseReadings
from slam_bringup.doctor.evidence import Evidence
from slam_bringup.doctor.finding import Finding

_FEWEST = 20
_LEAST_HZ = 5.0
_MOVED = 0.05
_FAULTS = {
    "jumped": "was its driver started anew while recording?",
    "not finite": "mend the driver",
}
"""Rejections that are faults of their own; stamps are looked at elsewhere."""


def check_odometry(evidence: Evidence) -> Iterator[Finding]:
    """Rate, poses that the filter rejects, and covariances that it cannot use."""
    if len(evidence.odometry) < _FEWEST:
        return
    topic, poses = evidence.name("odometry"), evidence.odometry
    seconds = (poses[-1].stamp_ns - poses[0].stamp_ns) * 1e-9
    if seconds > 0.0 and len(poses) / seconds < _LEAST_HZ:
        yield Finding(
            "odometry rate",
            f"{topic} comes {len(poses) / seconds:.1f} times a second",
            f"let its driver publish at {_LEAST_HZ:.0f} Hz or more: poses half a second apart are not used",
        )
    readings, rejected, claims = PoseReadings(), Counter[str](), np.zeros(6)
    for pose in poses:
        if reason := readings.add(pose):
            rejected[reason] += 1
        claims += readings.claimed
    for reason, advice in _FAULTS.items():
        if rejected[reason]:
            yield Finding("odometry poses", f"{rejected[reason]} of {len(poses)} poses on {topic} {reason}", advice)
    moves = max(np.ptp([pose.T[:3, 3] for pose in poses], axis=0)) > _MOVED
    if moves and not claims[[0, 1, 5]].any():
        yield Finding(
            "odometry covariance",
            f"{topic} says nothing of the errors of x, y and yaw: its covariances are zero, huge or do not grow",
            "slam estimates them from the images; better let the driver fill pose.covariance or twist.covariance",
        )
