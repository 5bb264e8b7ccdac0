# SPDX-License-Identifier: Apache-2.0
"""Is the estimate of another body frame than ground truth: a constant rotation and offset between the two.

A data set gives the poses of its IMU or of a marker, an estimate those of the camera. Then ``truth = W estimate X``
with one X for all poses, which no alignment W of the worlds can undo. From the motions between poses X follows as in
hand-eye calibration (``A X = X B``; Tsai and Lenz 1989): the axes of the turns give its rotation, the lever arm that
the turns swing gives its translation.
"""

from __future__ import annotations

import numpy as np

from slam_core.geometry import FloatArray, boxminus, invert_transform, make_transform, so3_log

_PARTS = 20
"""Motions are taken over this part of the run, long enough to turn."""
_LEAST_TURN = np.radians(3.0)
_LEAST_AXES = 0.1
"""Turns about other axes than the main one, relative to it: below it, X cannot be told."""
_WORTH_NAMING = 3.0
"""Times by which X must bring the poses nearer before it counts as a difference of frames."""
_LEAST_DIFFERENCE = (0.01, np.radians(2.0))
"""Offset (m) or rotation (rad) that a difference of frames has at least."""


def body_offset(estimate: FloatArray, truth: FloatArray) -> FloatArray | None:
    """``X`` = T_estimate_truth (4, 4) between the body frames of poses (n, 4, 4), or None where these are the same.

    None as well where the run turns too little, or about one axis alone, to tell.
    """
    step = max(1, len(estimate) // _PARTS)
    A = invert_transform(estimate[:-step]) @ estimate[step:]
    B = invert_transform(truth[:-step]) @ truth[step:]
    turns = so3_log(A[:, :3, :3]), so3_log(B[:, :3, :3])
    turning = np.linalg.norm(turns[0], axis=1) > _LEAST_TURN
    if turning.sum() < 3:
        return None
    U, sizes, Vt = np.linalg.svd(turns[0][turning].T @ turns[1][turning])
    if sizes[1] < _LEAST_AXES**2 * sizes[0]:
        return None
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    lever = (A[turning][:, :3, :3] - np.eye(3)).reshape(-1, 3)
    swing = (B[turning][:, :3, 3] @ R.T - A[turning][:, :3, 3]).ravel()
    X = make_transform(R, np.linalg.lstsq(lever, swing, rcond=None)[0])
    return X if _is_worth_naming(X, A, B) else None


def _is_worth_naming(X: FloatArray, A: FloatArray, B: FloatArray) -> bool:
    offset, rotation = np.linalg.norm(X[:3, 3]), np.linalg.norm(so3_log(X[:3, :3]))
    if offset < _LEAST_DIFFERENCE[0] and rotation < _LEAST_DIFFERENCE[1]:
        return False
    before = np.linalg.norm(boxminus(B, A), axis=1).mean()
    after = np.linalg.norm(boxminus(B, invert_transform(X) @ A @ X), axis=1).mean()
    return bool(before > _WORTH_NAMING * after)


def describe(X: FloatArray) -> str:
    """A difference of body frames in words."""
    x, y, z = X[:3, 3]
    turn = np.degrees(np.linalg.norm(so3_log(X[:3, :3])))
    return f"{turn:.1f} deg and ({x:.3f}, {y:.3f}, {z:.3f}) m"
