# SPDX-License-Identifier: Apache-2.0
"""Maps a range-bearing log: by one EKF, by smoothing everything at once, or by joined submaps.

All poses and landmarks of a result are in the frame of the first robot's first pose, which is held at the truth where
that is known, else at zero.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from slam_core.estimation.chi_square import chi_square_bound
from slam_core.estimation.least_squares import LevenbergMarquardtConfig
from slam_core.estimation.rigid_alignment import umeyama
from slam_core.evaluation import nees
from slam_core.geometry import FloatArray
from slam_experiments.linear_slam.text_joining import join_text_maps
from slam_experiments.linear_slam.text_maps import TextMap
from slam_experiments.planar.ekf import PlanarConfig, PlanarEkf, move, wrap
from slam_experiments.planar.log import PlanarLog, RobotLog
from slam_experiments.planar.naming import named
from slam_experiments.planar.sam import PlanarGraph, PlanarMap, pose_covariances, sighting_nis, smooth

METHODS = ("ekf", "sam", "submaps")
ASSOCIATIONS = ("known", "hypotheses", "nearest", "mahalanobis", "jcbb", "ccda")
_INLIER_PROBABILITY = 0.999999
"""Share of true sightings that lie within their gate; others are left out where the association is known."""
_NARROWING_GATES = (2500.0, 400.0, 100.0, 36.0, 36.0, 36.0)
"""Squared residuals beyond which a sighting is left out of the next smoothing: 50 to 6 sigma."""
_OPTIMIZER = LevenbergMarquardtConfig(relative_tolerance=1e-6)
_COVARIANCES = 300
"""Poses of each robot whose covariance is computed, evenly spread."""
_SUBMAP_STEPS = 60
_MIN_COMMON = 3
"""Landmarks that two robots must share for their maps to be put together."""

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RobotPath:
    """Poses (n, 3) of one robot, and covariances (k, 3, 3) of those at ``known`` (k,)."""

    name: str
    poses: FloatArray
    known: Indices
    covariances: FloatArray


@dataclass(frozen=True, eq=False)
class PlanarResult:
    """Result of a log: paths, landmarks (m, 2) with their ids, sightings left out, cost, and processor time."""

    paths: tuple[RobotPath, ...]
    landmarks: FloatArray
    landmark_ids: Indices
    rejected: int
    chi2: float | None
    degrees_of_freedom: int | None
    seconds: float


@dataclass(frozen=True, eq=False)
class _Drive:
    """One robot mapped on its own: poses (n, 3), landmarks (m, 2) with ids, and the landmark's row of every sighting.

    covariances: (n, 3, 3), or (0, 3, 3) where none were computed. rows: per step (k,), -1 for what was left out.
    """

    poses: FloatArray
    covariances: FloatArray
    landmarks: FloatArray
    ids: Indices
    rows: list[Indices]
    chi2: float | None = None
    freedom: int | None = None

    @property
    def rejected(self) -> int:
        """Sightings left out."""
        return sum(int((rows < 0).sum()) for rows in self.rows)


def map_log(
    log: PlanarLog, method: str, association: str = "known", make_filter: type[PlanarEkf] = PlanarEkf
) -> PlanarResult:
    """Map all robots of a log; ``make_filter``: the filter of method ``ekf``.

    Raises
    ------
    ValueError
        If several robots are to be joined without known landmarks, or share too few of them.
    """
    config = PlanarConfig(
        sigma_range=log.sigma_range,
        sigma_bearing=log.sigma_bearing,
        method="jcbb" if association in ("known", "hypotheses") else association,
    )
    if len(log.robots) > 1 and not (association == "known" and method == "sam"):
        raise ValueError(
            f"{len(log.robots)} robots are joined by --method sam with known association; choose one with --robot"
        )
    began, sightings = time.process_time(), _sightings(log)
    if association == "hypotheses":
        log = replace(log, robots=tuple(named(robot, _start(robot), config) for robot in log.robots))
    known = association in ("known", "hypotheses")
    drive = _joined if known and method != "ekf" else partial(_filtered, make_filter=make_filter)
    drives = [drive(robot, config, known) for robot in log.robots]
    paths = tuple(
        RobotPath(r.name, d.poses, np.arange(len(d.covariances)), d.covariances)
        for r, d in zip(log.robots, drives, strict=True)
    )
    alone = drives[0]
    result = PlanarResult(
        paths, alone.landmarks, alone.ids, sum(d.rejected for d in drives), alone.chi2, alone.freedom, 0.0
    )
    if method == "sam":
        result = _smoothed(log, drives, config)
    unnamed = sightings - _sightings(log)
    return replace(result, rejected=result.rejected + unnamed, seconds=time.process_time() - began)


def _sightings(log: PlanarLog) -> int:
    return sum(len(z) for robot in log.robots for z in robot.observations)


def _start(robot: RobotLog) -> FloatArray:
    return np.zeros(3) if robot.truth is None else robot.truth[0]


def _filtered(robot: RobotLog, config: PlanarConfig, known: bool, make_filter: type[PlanarEkf]) -> _Drive:
    """One filter over the whole drive."""
    ekf = make_filter(config, _start(robot), 1e-12 * np.eye(3))
    poses, covariances, slots = [], [], []
    for k, (z, ids) in enumerate(zip(robot.observations, robot.ids, strict=True)):
        if k:
            ekf.predict(robot.motions[k - 1], robot.motion_covariances[k - 1])
        slots.append(_see(ekf, z, ids if known else None))
        poses.append(ekf.pose.copy())
        covariances.append(ekf.covariance.head(3)[:3].copy())
    return _Drive(np.array(poses), np.array(covariances), ekf.landmarks, np.array(ekf.ids, np.int64), slots)


def _see(ekf: PlanarEkf, z: FloatArray, ids: Indices | None) -> Indices:
    """Update with what lies within its gate; landmark slots (k,), -1 for what was left out."""
    if not len(z):
        return np.empty(0, dtype=np.int64)
    if ids is None:
        return ekf.process(z)[1]
    slot_of = {landmark: slot for slot, landmark in enumerate(ekf.ids)}
    slots = np.array([slot_of.get(int(i), -1) for i in ids], dtype=np.int64)
    old = np.flatnonzero(slots >= 0)
    fits = np.ones(len(z), dtype=bool)
    if len(old):
        fits[old] = ekf.innovation_nis(z[old], slots[old]) < chi_square_bound(_INLIER_PROBABILITY, 2)
    used = np.full(len(z), -1, dtype=np.int64)
    if fits.any():
        used[fits] = ekf.process(z[fits], ids[fits])[1]
    return used


def _smoothed(log: PlanarLog, drives: list[_Drive], config: PlanarConfig) -> PlanarResult:
    """All robots at once, from where each was mapped on its own."""
    moved = [d if k == 0 else _moved_onto(drives[0], d, log.robots[k].name) for k, d in enumerate(drives)]
    ids = np.unique(np.concatenate([d.ids for d in drives]))
    points = np.zeros((len(ids), 2))
    for drive in reversed(moved):  # the first robot that has seen a landmark says where it starts
        points[np.searchsorted(ids, drive.ids)] = drive.landmarks
    graph = _graph(log, drives, ids)
    start = PlanarMap(np.concatenate([d.poses for d in moved]), points)
    graph, smoothed, chi2 = _without_outliers(graph, start, config)
    paths = []
    for first, robot in zip(graph.starts, log.robots, strict=True):
        count = len(robot.observations)
        chosen = np.unique(np.linspace(0, count - 1, min(count, _COVARIANCES)).astype(np.int64))
        covariances = pose_covariances(graph, smoothed, config, first + chosen)
        paths.append(RobotPath(robot.name, smoothed.poses[first : first + count], chosen, covariances))
    equations = 3 * len(graph.motions) + 2 * len(graph.measured)
    freedom = equations - 3 * (len(smoothed.poses) - 1) - 2 * len(smoothed.landmarks)
    rejected = _sightings(log) - len(graph.measured)
    return PlanarResult(tuple(paths), smoothed.landmarks, ids, rejected, chi2, freedom, 0.0)


def _without_outliers(
    graph: PlanarGraph, start: PlanarMap, config: PlanarConfig
) -> tuple[PlanarGraph, PlanarMap, float]:
    """Smoothed again and again without the sightings that the others contradict, the worst ones first."""
    state, whole, kept = start, graph, np.ones(len(graph.measured), dtype=bool)
    for gate in _NARROWING_GATES:
        graph = replace(
            whole,
            pose_index=whole.pose_index[kept],
            landmark_index=whole.landmark_index[kept],
            measured=whole.measured[kept],
        )
        state, optimum = smooth(graph, state.poses[0], config, state, _OPTIMIZER)
        before, kept = kept, sighting_nis(whole, state, config) < gate
        if gate == _NARROWING_GATES[-1] and np.array_equal(before, kept):
            break
    return graph, state, optimum.cost


def _moved_onto(first: _Drive, other: _Drive, name: str) -> _Drive:
    """Another robot's poses and landmarks in the first one's frame, by the landmarks that both have."""
    common, a, b = np.intersect1d(first.ids, other.ids, return_indices=True)
    if len(common) < _MIN_COMMON:
        raise ValueError(f"{name} shares {len(common)} landmarks with the first robot; {_MIN_COMMON} are needed")
    pad = np.zeros((len(common), 1))
    T = umeyama(np.hstack([other.landmarks[b], pad]), np.hstack([first.landmarks[a], pad]))
    frame = np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])
    points = np.column_stack([other.landmarks, np.zeros(len(other.landmarks))])
    return replace(other, poses=_placed(frame, other.poses), landmarks=_placed(frame, points)[:, :2])


def _graph(log: PlanarLog, drives: list[_Drive], ids: Indices) -> PlanarGraph:
    counts = [len(robot.observations) for robot in log.robots]
    starts = tuple(int(s) for s in np.concatenate([[0], np.cumsum(counts)[:-1]]))
    pose, landmark, measured = [], [], []
    for start, robot, drive in zip(starts, log.robots, drives, strict=True):
        number = np.searchsorted(ids, drive.ids)
        for k, (z, rows) in enumerate(zip(robot.observations, drive.rows, strict=True)):
            used = rows >= 0
            pose.append(np.full(int(used.sum()), start + k))
            landmark.append(number[rows[used]])
            measured.append(z[used])
    return PlanarGraph(
        np.concatenate([r.motions for r in log.robots]),
        np.concatenate([r.motion_covariances for r in log.robots]),
        np.concatenate(pose).astype(np.int64),
        np.concatenate(landmark).astype(np.int64),
        np.concatenate(measured),
        starts,
    )


@dataclass(frozen=True, eq=False)
class PlanarSubmap:
    """A stretch of the drive in the frame of its first pose: poses in it, the map that is joined, sightings' ids."""

    poses: FloatArray
    text: TextMap
    seen: list[Indices]


def _joined(robot: RobotLog, config: PlanarConfig, known: bool = True) -> _Drive:
    """Submaps of one robot, each by a filter of its own, joined by sparse least squares (chapter 7)."""
    submaps = list(submaps_of(robot, config))
    result = join_text_maps([s.text for s in submaps], 2)
    origin = _start(robot)
    at = dict(zip(result.pose_ids.tolist(), _placed(origin, result.poses), strict=True))
    poses = np.concatenate([_placed(at[k], s.poses) for k, s in enumerate(submaps)])
    landmarks = _placed(origin, np.column_stack([result.features, np.zeros(len(result.features))]))[:, :2]
    order = np.argsort(result.feature_ids)
    ids = result.feature_ids[order]
    rows = [np.where(seen >= 0, np.searchsorted(ids, seen), -1) for s in submaps for seen in s.seen]
    equations = sum(3 + 2 * len(s.text.feature_ids) for s in submaps)
    freedom = equations - 3 * (len(result.pose_ids) - 1) - 2 * len(ids)
    return _Drive(poses, np.empty((0, 3, 3)), landmarks[order], ids, rows, result.chi2, freedom)


def submaps_of(robot: RobotLog, config: PlanarConfig) -> Iterator[PlanarSubmap]:
    """Stretches of ``_SUBMAP_STEPS`` steps; what is seen at the last pose of one belongs to the next alone."""
    steps = len(robot.observations)
    edges = [*range(0, max(steps - 1, 1), _SUBMAP_STEPS), steps - 1]
    if len(edges) > 2 and edges[-1] - edges[-2] < _SUBMAP_STEPS // 2:
        del edges[-2]
    for number, (first, last) in enumerate(pairwise(edges)):
        ekf, poses, seen = PlanarEkf(config, np.zeros(3), 1e-12 * np.eye(3)), [np.zeros(3)], []
        is_last = last == steps - 1
        for k in range(first, last + is_last):
            if k > first:
                ekf.predict(robot.motions[k - 1], robot.motion_covariances[k - 1])
                poses.append(ekf.pose.copy())
            used = _see(ekf, robot.observations[k], robot.ids[k])
            seen.append(np.where(used >= 0, robot.ids[k], -1))
            poses[-1] = ekf.pose.copy()
        if not is_last:
            ekf.predict(robot.motions[last - 1], robot.motion_covariances[last - 1])
        text = TextMap(
            number,
            np.array([number + 1]),
            ekf.pose[None].copy(),
            np.array(ekf.ids, dtype=np.int64),
            ekf.landmarks.copy(),
            np.asarray(np.linalg.inv(ekf.covariance.dense()), dtype=np.float64),
        )
        yield PlanarSubmap(np.array(poses), text, seen)


def _placed(frame: FloatArray, poses: FloatArray) -> FloatArray:
    """Poses (n, 3) given in the frame of a pose (3,), in that pose's own frame."""
    return np.array([move(frame, pose)[0] for pose in poses])


def accuracy(robot: RobotLog, path: RobotPath) -> dict[str, float]:
    """RMSE m and deg, and mean NEES per degree of freedom of a path against the truth; empty without one.

    Nothing is aligned but for ``ate_m``: the first robot starts at its true pose, so all poses are in the frame of the
    truth.
    """
    if robot.truth is None:
        return {}
    truth = robot.truth
    error = path.poses - truth
    error[:, 2] = wrap(error[:, 2])
    found = {
        "rmse_m": float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
        "rmse_deg": float(np.degrees(np.sqrt(np.mean(error[:, 2] ** 2)))),
        "ate_m": _aligned_rmse(path.poses, truth),
    }
    usable = [i for i, P in zip(path.known, path.covariances, strict=True) if np.linalg.eigvalsh(P)[0] > 1e-14 and i]
    if usable:
        rows = np.searchsorted(path.known, usable)
        found["anees"] = float(nees(error[usable], path.covariances[rows]).mean() / 3.0)
    return found


def _aligned_rmse(poses: FloatArray, truth: FloatArray) -> float:
    """RMSE of the positions after the rigid motion in the plane that fits them best, m."""
    a, b = (np.column_stack([p[:, :2], np.zeros(len(p))]) for p in (poses, truth))
    T = umeyama(a, b)
    return float(np.sqrt(np.mean(np.sum((a @ T[:3, :3].T + T[:3, 3] - b)[:, :2] ** 2, axis=1))))


def dead_reckoning(robot: RobotLog) -> FloatArray:
    """Poses (n, 3) from the motions alone."""
    poses = [_start(robot)]
    for motion in robot.motions:
        poses.append(move(poses[-1], motion)[0])
    return np.array(poses)
