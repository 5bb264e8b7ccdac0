# SPDX-License-Identifier: Apache-2.0
"""Tracks: points of key frames that are followed from picture to picture by their patches.

Pyramidal Lucas-Kanade from the picture before gives a first guess; the motion of the camera that most guesses agree on
replaces the guesses that do not. Then the patch of the key frame in which a track began is registered onto the new
picture under an affine warp (:mod:`stereo_frontend.tracking.track_alignment`), so that nothing drifts. Tracks without a
match stay for some frames where the motion predicts them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from slam_core.camera import Camera
from slam_core.geometry import FloatArray, transform_points
from slam_core.types import AnyArray, ByteArray, Float32Array
from stereo_frontend.keypoints import Keypoints, spread_over_grid
from stereo_frontend.masks import is_masked
from stereo_frontend.tracking.frame_motion import facing_warp, fit_motion, scaled_motion
from stereo_frontend.tracking.track_alignment import OUTPUTS, align_to_references

IdArray = npt.NDArray[np.int32]
_RADIUS = 7
"""Half width of a track's patch, px."""
_WINDOW, _LEVELS = (11, 11), 2
"""Patch and levels beyond the first of the guess, which is made in pictures of half the size."""
_STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.1)
_MAX_SHIFT = 4.0
"""Most distance of the patch from its guess, px."""
_MIN_CORRELATION = 0.8
_WARP_SIGMA = 0.05
"""Standard deviation of the affine part's prediction from one frame to the next."""
_SIGMA_SCALE, _SIGMA_FLOOR = 1.15, 0.04
"""Factor on the standard deviation from residual and curvature; that of a perfect patch, px."""
_MAX_SIGMA = 0.5
_MAX_STRETCH = 2.0
"""Greatest change of a patch's size since its key frame."""
LONGEST_STEP_S = 0.3
"""Time between pictures beyond which nothing is followed: what little is found again displaces what can be detected."""
_MAX_MISSED = 5
"""Frames for which a track is looked for where the motion predicts it."""
_KEY_FRAME_SHARE = 0.7
"""Share of the wanted tracks, and of those that the last key frame left, below which a frame becomes a key frame."""
_LOST = 0.3
"""Share of the wanted tracks below which all features of a key frame are of use."""
_APART = 8.0
"""Least distance of a new track from the others, px."""
_GRID = (8, 10)
_LARGEST_ID = 2**24
"""Ids begin anew there: a FLOAT32 field of a message holds no larger number exactly."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """n tracks. ids: (n,). references: (n, 17, 17) grey values around their point in the key frame, offset (n, 2) px.

    keypoints: uv (n, 2) px now, size, response, descriptors of the key frame. warp: (n, 4). points: (n, 3) m in the
    optical frame now, NaN without depth. missed: (n,) frames without a match.
    """

    ids: IdArray
    references: ByteArray
    offset: FloatArray
    keypoints: Keypoints
    warp: FloatArray
    points: FloatArray
    missed: npt.NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, index: npt.NDArray[np.generic]) -> Tracks:
        """The tracks at ``index``."""
        return Tracks(*(_selected(getattr(self, f.name), index) for f in dataclasses.fields(self)))

    def extended(self, others: Tracks) -> Tracks:
        """Tracks with the others after them."""
        return Tracks(*(_joined(getattr(self, f.name), getattr(others, f.name)) for f in dataclasses.fields(self)))


@dataclass(frozen=True, eq=False)
class Followed:
    """Tracks ``index`` (k,) found in a picture, with sigma_uv (k, 2) px and their predicted depth (k,) m, or NaN."""

    index: npt.NDArray[np.intp]
    keypoints: Keypoints
    ids: IdArray
    sigma_uv: Float32Array
    depth: FloatArray


class Tracker:
    """Follows at most ``wanted`` tracks through pictures of one camera that are at most ``longest_step_s`` apart."""

    def __init__(self, wanted: int, longest_step_s: float = LONGEST_STEP_S) -> None:
        self._wanted = wanted
        self._longest_step_s = longest_step_s
        self.reset()

    def reset(self) -> None:
        """Begin anew, as if nothing had been seen."""
        self._next_id = 0
        self.forget()

    def forget(self) -> None:
        """Forget all tracks; new ones get ids that none has had."""
        self._tracks: Tracks | None = None
        self._begun = 0
        self._half: ByteArray | None = None
        self._camera: Camera | None = None
        self._motion: tuple[FloatArray, float] | None = None
        self._stamp_ns = 0

    @property
    def motion(self) -> tuple[FloatArray | None, float]:
        """``T_now_before`` (4, 4) of the two newest pictures, None if it is not known, and the time between them, s."""
        return (None, 0.0) if self._motion is None else self._motion

    # ---- one picture, in order
    def follow(
        self, picture: ByteArray, camera: Camera, stamp_ns: int, mask: ByteArray | None = None
    ) -> Followed | None:
        """Tracks found in a picture; None while there are none.

        Those of another camera, and of a picture too long ago, are forgotten; those where ``mask``, of the picture's
        shape, is not zero count as not found.
        """
        dt = 1e-9 * (stamp_ns - self._stamp_ns)
        if camera != self._camera or abs(dt) > self._longest_step_s:
            self.forget()
            self._camera = camera
        before, tracks = self._half, self._tracks
        half = np.asarray(cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        self._half, self._stamp_ns = half, stamp_ns
        if tracks is None or before is None or len(tracks) == 0:
            self._motion = None
            return None
        expected = (
            np.eye(4) if self._motion is None or dt <= 0.0 else scaled_motion(self._motion[0], dt / self._motion[1])
        )
        start, T = _guess(before, half, tracks, camera, expected)
        self._motion = None if T is None or dt <= 0.0 else (T, dt)
        T = expected if T is None else T
        warp = np.where(
            np.isfinite(tracks.points[:, :1]), _composed(facing_warp(T, tracks.points), tracks.warp), tracks.warp
        )
        found = np.full((len(tracks), OUTPUTS), np.nan)
        align_to_references(
            picture, tracks.references, tracks.offset, start, warp, _MAX_SHIFT, 1.0 / _WARP_SIGMA**2, found
        )
        sigma = np.sqrt(_SIGMA_SCALE**2 * found[:, 6:8] + _SIGMA_FLOOR**2)
        good = _is_sound(found) & (sigma.max(axis=1) < _MAX_SIGMA) & ~is_masked(mask, found[:, :2])
        points = transform_points(T, tracks.points)
        uv = np.where(good[:, None], found[:, :2], start)
        tracks = dataclasses.replace(
            tracks,
            keypoints=dataclasses.replace(tracks.keypoints, uv=uv.astype(np.float32)),
            warp=np.where(good[:, None], found[:, 2:6], warp),
            points=np.where(good[:, None], camera.unproject(uv, points[:, 2]), points),
            missed=np.where(good, 0, tracks.missed + 1).astype(np.int32),
        )
        kept = np.flatnonzero(
            (tracks.missed <= _MAX_MISSED) & np.isfinite(uv).all(axis=1) & _in_sight(points, uv, camera)
        )
        self._tracks = tracks.select(kept)
        index = np.flatnonzero(good[kept])
        return Followed(
            index,
            self._tracks.keypoints.select(index),
            self._tracks.ids[index],
            sigma[kept][index].astype(np.float32),
            self._tracks.points[index, 2],
        )

    def measured(self, followed: Followed, depth: FloatArray, camera: Camera) -> None:
        """Take in the depths (k,) m measured of what was followed, NaN where there is none."""
        assert self._tracks is not None
        points = self._tracks.points.copy()
        known = np.isfinite(depth)
        index = followed.index[known]
        points[index] = camera.unproject(followed.keypoints.uv[known].astype(np.float64), depth[known])
        self._tracks = dataclasses.replace(self._tracks, points=points)

    def needs_key_frame(self, measured: int) -> bool:
        """True if so many tracks with depth are too few."""
        return measured < _KEY_FRAME_SHARE * min(self._wanted, self._begun) or measured < 0.5 * self._wanted

    def has_lost_sight(self, measured: int) -> bool:
        """True if so few tracks with depth are left that other means have to find the motion."""
        return measured < _LOST * self._wanted

    def is_free(self, uv: Float32Array) -> npt.NDArray[np.bool_]:
        """Mask (n,) of the pixels (n, 2) that are far enough from all tracks."""
        if self._tracks is None or len(self._tracks) == 0:
            return np.ones(len(uv), bool)
        new, old = uv.astype(np.float64), self._tracks.keypoints.uv.astype(np.float64)
        least = np.min(np.sum(old**2, axis=1) - 2.0 * new @ old.T, axis=1)
        return np.asarray(least + np.sum(new**2, axis=1) > _APART**2)

    def begin(self, picture: ByteArray, keypoints: Keypoints, depth: FloatArray, camera: Camera) -> IdArray:
        """Begin tracks at keypoints of a key frame with depth (n,) m; returns their ids (n,), 0 for those not followed.

        They fill the parts of the picture that have fewest tracks.
        """
        ids = np.zeros(len(keypoints), np.int32)
        corner = np.round(keypoints.uv).astype(np.int64)
        r, (height, width) = _RADIUS + 1, picture.shape
        inside = (corner[:, 0] >= r) & (corner[:, 1] >= r) & (corner[:, 0] < width - r) & (corner[:, 1] < height - r)
        usable = np.flatnonzero(inside & np.isfinite(depth))
        chosen = usable[self._spread(keypoints.select(usable), picture.shape)]
        new = self._new_tracks(picture, keypoints.select(chosen), corner[chosen], depth[chosen], camera)
        ids[chosen] = new.ids
        self._tracks = new if self._tracks is None else self._tracks.extended(new)
        self._begun = int((self._tracks.missed == 0).sum())
        return ids

    # ---- parts
    def _spread(self, keypoints: Keypoints, shape: tuple[int, ...]) -> npt.NDArray[np.intp]:
        """Keypoints to begin tracks at: as many as are wanted, where there are none."""
        tracks = self._tracks
        old = np.zeros((0, 2), np.float32) if tracks is None else tracks.keypoints.uv[tracks.missed == 0]
        uv = np.concatenate([old, keypoints.uv])
        response = np.concatenate([np.full(len(old), np.float32(np.inf)), keypoints.response])
        chosen = spread_over_grid(uv, response, (shape[0], shape[1]), _GRID, max(self._wanted, len(old)))
        return np.sort(chosen[chosen >= len(old)] - len(old))

    def _new_tracks(
        self, picture: ByteArray, keypoints: Keypoints, corner: npt.NDArray[np.int64], depth: FloatArray, camera: Camera
    ) -> Tracks:
        n = len(keypoints)
        ids = 1 + (self._next_id + np.arange(n)) % _LARGEST_ID
        self._next_id += n
        reach = np.arange(-_RADIUS - 1, _RADIUS + 2)
        references = picture[corner[:, 1, None, None] + reach[:, None], corner[:, 0, None, None] + reach]
        uv = keypoints.uv.astype(np.float64)
        return Tracks(
            ids.astype(np.int32),
            references,
            uv - corner,
            keypoints,
            np.tile(np.eye(2).ravel(), (n, 1)),
            camera.unproject(uv, depth),
            np.zeros(n, np.int32),
        )


def _guess(
    before: ByteArray, now: ByteArray, tracks: Tracks, camera: Camera, expected: FloatArray
) -> tuple[FloatArray, FloatArray | None]:
    """Pixels (n, 2) at which the tracks are looked for, and the camera's motion, None if they show none.

    ``before`` and ``now`` are pictures of half the size.
    """
    uv = tracks.keypoints.uv
    predicted = _projected(expected, tracks.points, camera, uv)
    flow, status, _ = cv2.calcOpticalFlowPyrLK(
        before, now, 0.5 * uv - np.float32(0.25), (0.5 * predicted - 0.25).astype(np.float32),
        winSize=_WINDOW, maxLevel=_LEVELS, criteria=_STEPS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    flow = 2.0 * flow.astype(np.float64) + 0.5
    seen = (status.ravel() > 0) & (tracks.missed == 0)
    known = seen & np.isfinite(tracks.points[:, 2])
    T = fit_motion(tracks.points[known], flow[known], camera, expected)
    if T is None:
        return np.where(seen[:, None], flow, np.nan), None
    projected = _projected(T, tracks.points, camera, flow)
    agrees = seen & (np.linalg.norm(flow - projected, axis=1) < 0.5 * _MAX_SHIFT)
    return np.where(agrees[:, None], flow, projected), T


def _is_sound(found: FloatArray) -> npt.NDArray[np.bool_]:
    """Mask (n,) of the alignments that succeeded, correlate and are bent within reason."""
    determinant = found[:, 2] * found[:, 5] - found[:, 3] * found[:, 4]
    size = np.abs(np.log(np.maximum(np.nan_to_num(determinant), 1e-6)))
    return np.asarray((found[:, 8] >= _MIN_CORRELATION) & (size < 2.0 * np.log(_MAX_STRETCH)))


def _in_sight(points: FloatArray, uv: FloatArray, camera: Camera) -> npt.NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        inside = (uv >= 0.0).all(axis=1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
        return np.asarray(inside & ~(points[:, 2] <= 0.05))


def _projected(T: FloatArray, points: FloatArray, camera: Camera, otherwise: AnyArray) -> FloatArray:
    """Pixels (n, 2) of moved points (n, 3), ``otherwise`` (n, 2) of those without depth or behind the camera."""
    pixels = camera.project(transform_points(T, points))
    return np.asarray(np.where(np.isfinite(pixels), pixels, otherwise))


def _composed(first: FloatArray, second: FloatArray) -> FloatArray:
    """Products (n, 4) of affine parts, row by row."""
    A, B = first.reshape(-1, 2, 2), second.reshape(-1, 2, 2)
    return np.asarray((A @ B).reshape(-1, 4))


def _selected(values: Any, index: npt.NDArray[np.generic]) -> Any:
    """Rows ``index`` of an array or of keypoints."""
    return values.select(index) if isinstance(values, Keypoints) else values[index]


def _joined(first: Any, second: Any) -> Any:
    """Rows of two arrays, or of two sets of keypoints, one after the other."""
    if isinstance(first, Keypoints):
        return Keypoints(*(_joined(getattr(first, f.name), getattr(second, f.name)) for f in dataclasses.fields(first)))
    return np.concatenate([first, second])
