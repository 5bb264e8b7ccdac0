# SPDX-License-Identifier: Apache-2.0
"""Joins text submaps to one map: the problem, a start, and the optimum.

The start is what each map says, chained. From there the optimum is approached in different ways, since any of them can
end in a local minimum: all maps at once, and incrementally, where each further part of the maps is placed against what
is joined so far, in ever smaller parts. The lowest chi2 is believed once two ways end there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.joining import JoiningProblem, map_residual
from sjsam_node.joint_problem.problem import FlatMaps, JoiningState, LocalMap, block_rows, flatten
from sjsam_node.joint_problem.robust import RobustConfig, RobustJoining, closing_rows
from slam_core.config import Config, group, parameter
from slam_core.estimation.least_squares import LeastSquaresResult, LevenbergMarquardtConfig
from slam_core.geometry import FloatArray, euler_from_rotation, rotation_from_euler
from slam_core.linear_algebra.sparse_cholesky import BACKENDS, IntArray
from slam_experiments.linear_slam.block_problem import BlockProblem, FlatRows, flatten_rows
from slam_experiments.linear_slam.text_maps import Progress, TextMap

ROWS = ("joint", "block")


@dataclass(frozen=True)
class TextJoiningConfig(Config):
    """Parameters of joining text submaps."""

    rows: str = parameter("joint", "a submap as one Gaussian, or pose and landmarks each on their own", choices=ROWS)
    solver: str = parameter("auto", "sparse solver", choices=BACKENDS)
    growth: float = parameter(
        0.08, "share of maps added per step of incremental joining, where it is tried first", minimum=0.001, maximum=1.0
    )
    refinements: int = parameter(
        2, "times it is tried again with a third of that, as long as no two ways agree on the lowest chi2", minimum=0
    )
    step_iterations: int = parameter(4, "iterations per step of incremental joining", minimum=1)
    optimizer: LevenbergMarquardtConfig = group(LevenbergMarquardtConfig)
    robust: RobustConfig = group(RobustConfig)


@dataclass(frozen=True, eq=False)
class TextJoiningResult:
    """The joined map in the frame of the first map's reference pose, and how it came about.

    dropped: poses and features of single maps that a robust loss left out; chi2 is then that of the others. Covariances
    (P, 3 | 6, 3 | 6) of the poses and (F, 2 | 3, 2 | 3) of the features, in the frame of the map: position, then turn
    about its axes. The first pose has none: it is the frame.
    """

    chi2: float
    start_chi2: float
    pose_ids: IntArray
    poses: FloatArray
    pose_covariances: FloatArray
    feature_ids: IntArray
    features: FloatArray
    feature_covariances: FloatArray
    solver: str
    iterations: int
    converged: bool
    start: str
    dropped: int


def join_text_maps(
    maps: list[TextMap], dimension: int, config: TextJoiningConfig | None = None, progress: Progress | None = None
) -> TextJoiningResult:
    """Join all ``maps`` of one ``dimension`` to the optimum of their joint cost.

    Raises
    ------
    ValueError
        If a map hangs on none of the others.
    """
    config = config or TextJoiningConfig()
    index = TextIndex.of(maps, dimension)
    joiner = TextJoiner(index, config)
    best, optimum = joiner.best(progress)
    of_poses, of_features = joiner.covariances(best)
    return TextJoiningResult(
        optimum.cost, joiner.start_cost, index.pose_ids, _pose_values(best), of_poses, index.feature_ids,
        best.landmarks, of_features, joiner.solver, optimum.iterations, optimum.converged, joiner.start,
        joiner.dropped,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class TextIndex:
    """Text maps in an order in which each hangs on one before it, with ids turned into indices of the state."""

    dimension: int
    pose_ids: IntArray
    feature_ids: IntArray
    maps: list[LocalMap]

    @classmethod
    def of(cls, maps: list[TextMap], dimension: int) -> TextIndex:
        """Index ``maps``; poses and features keep the order in which they first appear."""
        maps = _connected_order(maps)
        pose_index: dict[int, int] = {}
        feature_index: dict[int, int] = {}
        local = []
        for m in maps:
            reference = pose_index.setdefault(m.reference, len(pose_index))
            poses = [pose_index.setdefault(int(i), len(pose_index)) for i in m.pose_ids]
            features = [feature_index.setdefault(int(i), len(feature_index)) for i in m.feature_ids]
            mean = np.concatenate([m.poses.ravel(), m.features.ravel()])
            local.append(
                LocalMap(reference, np.array(poses, np.int64), np.array(features, np.int64), mean, m.information)
            )
        return cls(dimension, np.array(list(pose_index)), np.array(list(feature_index), np.int64), local)


def _connected_order(maps: list[TextMap]) -> list[TextMap]:
    """The maps, each after one that shares a pose with it; the given order where that already holds."""
    known = {maps[0].reference}
    ordered: list[TextMap] = []
    waiting = list(maps)
    while waiting:
        left = []
        for m in waiting:
            ids = {m.reference, *m.pose_ids.tolist()}
            if known & ids:
                known |= ids
                ordered.append(m)
            else:
                left.append(m)
        if len(left) == len(waiting):
            raise ValueError(
                f"{len(left)} submaps share no pose with the others (is a file missing?);"
                f" the first has reference {left[0].reference}"
            )
        waiting = left
    return ordered


class TextJoiner:
    """The optimisation of one set: keeps the flat maps, so that every prefix is joined without copying."""

    def __init__(self, index: TextIndex, config: TextJoiningConfig) -> None:
        self.index, self.config = index, config
        self.model = kernels.PLANAR if index.dimension == 2 else kernels.EULER
        size = 3 if index.dimension == 2 else 6
        block = config.rows == "block"
        self.maps = [block_rows(m, size, index.dimension) for m in index.maps] if block else index.maps
        flat = flatten_rows(self.maps, size, index.dimension) if block else flatten(self.maps)
        self.flat: FlatMaps | FlatRows = flat
        self.solver, self.start, self.start_cost, self.dropped = "", "", np.nan, 0

    def chained(self) -> JoiningState:
        """Poses and features as the maps say, each from where it starts."""
        state = self._blank()
        self._place(state, 0, len(self.index.maps), set())
        return state

    def best(self, progress: Progress | None) -> tuple[JoiningState, LeastSquaresResult]:
        """The lowest optimum, once two ways have led there or none is left; from there robustly, if so configured."""
        self.start, (state, result) = "chained", self.optimize(self.chained())
        self.start_cost = result.initial_cost
        for k in range(1 + self.config.refinements):
            growth = self.config.growth / 3.0**k
            found, other = self.optimize(self._incremental(growth, progress))
            agree = abs(other.cost - result.cost) <= 1e-6 * result.cost + 1e-9
            if other.cost < result.cost:
                self.start, state, result = f"incremental by {growth:.3g}", found, other
            if agree:
                break
        return (state, result) if self.config.robust.loss == "none" else self._robust(state)

    def covariances(self, state: JoiningState) -> tuple[FloatArray, FloatArray]:
        """Marginal covariances of every pose and every feature at the optimum."""
        fixed = np.array([0])
        problem = JoiningProblem(flatten(self.maps), state, fixed, self.model, self.config.solver)
        marginals = problem.marginals(state)
        size, d = state.model_dimensions
        poses = np.zeros((len(state.translations), size, size))
        for k in range(1, len(poses)):
            poses[k] = marginals.covariance([k])
        features = np.arange(len(state.landmarks))
        return poses, marginals.landmark_blocks(features) if len(features) else np.empty((0, d, d))

    def _robust(self, state: JoiningState) -> tuple[JoiningState, LeastSquaresResult]:
        """Without the closing rows that the others contradict."""
        sizes = state.model_dimensions
        joining = RobustJoining(
            self.maps, closing_rows(self.maps, *sizes), partial(map_residual, self.model),
            lambda maps, start: self._optimize_maps(maps, start)[0], self.config.robust,
        )  # fmt: skip
        found = joining.run(state)
        self.maps, self.dropped = found.maps, found.count
        return self._optimize_maps(found.maps, found.state)

    def optimize(self, state: JoiningState) -> tuple[JoiningState, LeastSquaresResult]:
        """The optimum of all maps reached from ``state``."""
        problem = self._problem(len(self.maps), state)
        self.solver = problem.backend
        return problem.optimize(state, self.config.optimizer)

    def _optimize_maps(self, maps: list[LocalMap], state: JoiningState) -> tuple[JoiningState, LeastSquaresResult]:
        """Maps with other information matrices."""
        problem = JoiningProblem(flatten(maps), state, np.array([0]), self.model, self.config.solver)
        return problem.optimize(state, self.config.optimizer)

    def _problem(self, count: int, state: JoiningState) -> JoiningProblem | BlockProblem:
        fixed, maps = np.array([0]), self.flat.first(count)
        if isinstance(maps, FlatRows):
            return BlockProblem(maps, state, fixed, self.model, self.config.solver)
        return JoiningProblem(maps, state, fixed, self.model, self.config.solver)

    def _incremental(self, growth: float, progress: Progress | None) -> JoiningState:
        """Place and join a growing part of the maps, by the share ``growth``, so that each starts near its optimum."""
        state, known, done, total = self._blank(), set[tuple[bool, int]](), 0, len(self.index.maps)
        few = LevenbergMarquardtConfig(max_iterations=self.config.step_iterations, relative_tolerance=1e-4)
        while done < total:
            added = min(total, max(done + 1, int(done * (1.0 + growth))))
            self._place(state, done, added, known)
            done = added
            state, _ = self._problem(done, state).optimize(state, few)
            if progress is not None:
                progress(done, total)
        return state

    def _blank(self) -> JoiningState:
        d = self.index.dimension
        poses = len(self.index.pose_ids)
        return JoiningState(
            np.tile(np.eye(d), (poses, 1, 1)), np.zeros((poses, d)), np.zeros((len(self.index.feature_ids), d))
        )

    def _place(self, state: JoiningState, first: int, last: int, known: set[tuple[bool, int]]) -> None:
        """Initialise (in place) what the maps ``first`` to ``last`` see for the first time, from where they start."""
        known.add((True, 0))
        for m in self.index.maps[first:last]:
            rotations, translations, points = _local_values(m, self.index.dimension)
            if (True, m.reference) not in known:
                anchor = next(k for k, j in enumerate(m.poses) if (True, int(j)) in known)
                R = state.rotations[m.poses[anchor]] @ rotations[anchor].T
                state.rotations[m.reference] = R
                state.translations[m.reference] = state.translations[m.poses[anchor]] - R @ translations[anchor]
                known.add((True, m.reference))
            R, t = state.rotations[m.reference], state.translations[m.reference]
            for k, j in enumerate(m.poses):
                if (True, int(j)) not in known:
                    state.rotations[j], state.translations[j] = R @ rotations[k], R @ translations[k] + t
                    known.add((True, int(j)))
            for k, j in enumerate(m.landmarks):
                if (False, int(j)) not in known:
                    state.landmarks[j] = R @ points[k] + t
                    known.add((False, int(j)))


def _local_values(m: LocalMap, dimension: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotations, translations and points of one map, in its own frame."""
    size = 3 if dimension == 2 else 6
    poses = m.mean[: size * len(m.poses)].reshape(-1, size)
    angles = poses[:, dimension:]
    if dimension == 2:
        c, s = np.cos(angles[:, 0]), np.sin(angles[:, 0])
        rotations = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    else:
        rotations = np.array([rotation_from_euler(*a) for a in angles]).reshape(-1, 3, 3)
    return rotations, poses[:, :dimension], m.mean[size * len(m.poses) :].reshape(-1, dimension)


def _pose_values(state: JoiningState) -> FloatArray:
    """Poses as the format writes them: x y phi, or x y z yaw pitch roll."""
    if state.translations.shape[1] == 2:
        angles = np.arctan2(state.rotations[:, 1, 0], state.rotations[:, 0, 0])[:, None]
    else:
        angles = euler_from_rotation(state.rotations)
    return np.concatenate([state.translations, angles], axis=1)
