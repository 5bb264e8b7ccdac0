# SPDX-License-Identifier: Apache-2.0
"""The solver: the state of the map, brought to its optimum, as another state.

    state = solve(state, component, config)
    state = updated(state, newest, added, removed, config)

Every update joins in batch, warm from the estimate, without the old submaps that nothing new touches
(:mod:`sjsam_node.smoothing.condensing`) and with a selection of the shared landmarks
(:mod:`sjsam_node.graph.selection`): it costs what is near the new submap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sjsam_node.graph.links import Link
from sjsam_node.graph.map_graph import ALL
from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.joining import JoiningProblem, joint_errors, map_residual
from sjsam_node.joint_problem.problem import JoiningState, LocalMap, flatten, split
from sjsam_node.joint_problem.robust import RobustConfig, RobustJoining, closing_rows, predicted
from sjsam_node.smoothing.assembly import assemble, observations_of, with_component
from sjsam_node.smoothing.component_problem import ComponentProblem, UpdateResult
from sjsam_node.smoothing.condensed import CondensedSubmap
from sjsam_node.smoothing.condensing import RegionConfig, expanded, fully_expanded, valid_submaps
from sjsam_node.smoothing.frozen import FrozenSubmaps
from sjsam_node.smoothing.reduction import RecoveredLandmarks, ReducedMap
from sjsam_node.smoothing.state import EstimateState, SolvedComponent, with_exactly, with_links, without
from slam_core.config import Config, group, parameter
from slam_core.estimation.least_squares import LeastSquaresResult, LevenbergMarquardtConfig
from slam_core.geometry import FloatArray, make_transform
from slam_core.linear_algebra.sparse_cholesky import BACKENDS

_UNMOVED = 1e-4
"""Squared change of a submap's residual, in sigmas, below which its own landmarks stay where they were in it."""

_LIVE_ITERATIONS = 6
"""Iterations of an update while submaps come in, at most."""


@dataclass(frozen=True)
class EstimatorConfig(Config):
    """Parameters of the joining problem and its solver."""

    rows: str = parameter(
        "joint", "noise of a submap: its joint covariance, or per landmark", choices=("joint", "block")
    )
    iterations: int = parameter(30, "Gauss-Newton iterations per closure; 1 is Algorithm 4 as written", minimum=1)
    solver: str = parameter("auto", "sparse solver", choices=BACKENDS)
    relative_tolerance: float = 1e-9
    """Stop when a step promises to lower chi2 by less than this share."""
    live_tolerance: float = 1e-4
    """The same while submaps come in; the map is brought to its optimum when it settles."""
    robust: RobustConfig = group(RobustConfig)

    @property
    def linearises(self) -> bool:
        """True if submaps may be joined to larger ones: at the optimum, and with all their rows."""
        return self.robust.loss == "none" and self.iterations > 1

    def optimizer(self, *, coarse: bool) -> LevenbergMarquardtConfig:
        """Criteria to stop; ``coarse``: where a step promises less than ``live_tolerance``."""
        if coarse:
            return LevenbergMarquardtConfig(min(self.iterations, _LIVE_ITERATIONS), self.live_tolerance)
        return LevenbergMarquardtConfig(self.iterations, self.relative_tolerance)


_SETTLED_TIES = 24
"""Landmarks that tie two submaps when a map settles, at least, where all that they share are too many."""


@dataclass(frozen=True)
class SmootherConfig(Config):
    """Parameters of keeping the estimate."""

    settled_work: float = 4e6
    """Entries of the submaps' information matrices up to which a map settles with more than the selected landmarks.

    They are in memory four times: reduced, in the problem, in its normal equations and in their factor, 32 MB each.
    """
    estimator: EstimatorConfig = group(EstimatorConfig)
    region: RegionConfig = group(RegionConfig)


Optimize = Callable[[JoiningProblem, JoiningState, LevenbergMarquardtConfig], tuple[JoiningState, LeastSquaresResult]]
"""Brings a problem from a state to its optimum."""


def solve(
    state: EstimateState, component: int, config: SmootherConfig, *, coarse: bool = True,
    optimize: Optimize | None = None,
) -> EstimateState:  # fmt: skip
    """The state with a component at its optimum; condensed submaps that this bends take part again.

    ``optimize``: what solves the problem instead of its own factor.
    """
    while True:
        state = replace(state, frozen=state.frozen.still_tied(state.component_of))
        frozen = state.frozen.of_component(component, state.component_of)
        state, condensed = valid_submaps(state, component)
        state, problem, found, bent = optimized(
            state, component, config, condensed, frozen, coarse=coarse, optimize=optimize
        )
        if not bent:
            break
        state = expanded(state, bent)
    nodes, moved = frozen.apply_motion(state.poses, problem.nodes)
    poses = state.poses.copy()
    poses[nodes] = moved
    result = _result_of(state, component, problem, found.cost, found.iterations, found.converged)
    return replace(state, poses=poses, solved={**state.solved, component: SolvedComponent(problem, result)})


def updated(
    state: EstimateState, newest: int, added: Sequence[Link], removed: Sequence[Link], config: SmootherConfig
) -> EstimateState:
    """The state with links added and removed, and the component of record ``newest`` at its optimum.

    Other components that the change splits off are brought to theirs.
    """
    if removed:
        state = with_exactly(state, without(state.graph.links, removed))
    state = with_links(state, added)
    return _solve_changed(solve(state, state.component(newest), config), config)


def relinked(
    state: EstimateState, removed: Sequence[Link], added: Sequence[Link], config: SmootherConfig
) -> EstimateState:
    """The state with other links; the next update optimises them, but parts that this splits off are optimised now."""
    return _solve_changed(with_exactly(state, [*without(state.graph.links, removed), *added]), config)


def simplified(state: EstimateState, config: SmootherConfig) -> EstimateState:
    """The state with nothing but the graph and its estimate, in which every submap takes part by itself.

    As many landmarks connect submaps as the work allows; those selected alone where submaps contradicted each other.
    """
    return replace(fully_expanded(_with_budget(state, config)), solved={}, frozen=FrozenSubmaps())


def optimize_full(
    state: EstimateState, config: SmootherConfig, *, coarse: bool = False, optimize: Optimize | None = None
) -> EstimateState:
    """The simplified state with all components at their optimum; ``coarse``: as near to it as an update comes."""
    for component in state.components():
        state = solve(state, component, config, coarse=coarse, optimize=optimize)
    return state


def relinearized(state: EstimateState, config: SmootherConfig) -> EstimateState:
    """The state as it is after loading, and after saving: linearised anew at an estimate that is at its optimum."""
    state = _with_budget(state, config)
    count, solved = len(state.graph.records), dict[int, SolvedComponent]()
    reduced: dict[int, ReducedMap] = {}
    state = replace(
        state, condensed=(), frozen=FrozenSubmaps(), solved={}, reduced={}, recovered={}, last_needed=np.arange(count)
    )
    for component in state.components():
        problem = assemble(state, component, config.estimator.rows, config.estimator.solver)
        cost = problem.problem.cost(problem.optimum)
        solved[component] = SolvedComponent(problem, _result_of(state, component, problem, cost, 0, True))
        reduced |= dict(zip(problem.records, problem.reduced, strict=True))
    return replace(state, solved=solved, reduced=reduced)


def _with_budget(state: EstimateState, config: SmootherConfig) -> EstimateState:
    contradicted = bool((state.overconfidence > 1.0).any())
    graph = state.graph
    for least in (0,) if contradicted else (ALL, _SETTLED_TIES, 0):
        graph = graph.with_least_budget(least)
        connecting = np.bincount(graph.record_of[graph.is_connecting], minlength=len(graph.records))
        if float(np.square(6.0 + 3.0 * connecting).sum()) <= config.settled_work:
            break
    return replace(state, graph=graph)


def _solve_changed(state: EstimateState, config: SmootherConfig) -> EstimateState:
    """Forget components that are no more, and solve those that have other records than when they were solved."""
    components = state.components()
    state = replace(state, solved={c: s for c, s in state.solved.items() if c in set(components)})
    for component in components:
        solved = state.solved.get(component)
        if solved is None or solved.problem.size != len(state.records_in(component)):
            state = solve(state, component, config)
    return state


def _result_of(
    state: EstimateState, component: int, problem: ComponentProblem, cost: float, iterations: int, converged: bool
) -> UpdateResult:
    overconfidence = float(state.overconfidence[state.records_in(component)].max())
    return UpdateResult(cost, problem.redundancy, iterations, converged, problem.problem.backend, overconfidence)


# -- one component -----------------------------------------------------------------------------------------------------


def optimized(
    state: EstimateState,
    component: int,
    config: SmootherConfig,
    condensed: Sequence[CondensedSubmap],
    frozen: FrozenSubmaps,
    *,
    coarse: bool,
    optimize: Optimize | None = None,
) -> tuple[EstimateState, ComponentProblem, LeastSquaresResult, list[CondensedSubmap]]:
    """The state with a component at its optimum but for what is ``frozen``, the problem, and how it was solved.

    Also the condensed submaps that this bends too far.
    """
    estimator, graph = config.estimator, state.graph
    problem = assemble(state, component, estimator.rows, estimator.solver, condensed, frozen)
    optimizer = estimator.optimizer(coarse=coarse)
    if optimize is None:
        optimum, result = problem.problem.optimize(problem.optimum, optimizer, keep_factor=coarse)
    else:
        optimum, result = optimize(problem.problem, problem.optimum, optimizer)
    if estimator.robust.loss != "none":
        optimum, result, problem = _robust(problem, optimum, optimizer, estimator.robust)
    problem = replace(problem, optimum=optimum)
    poses, points = state.poses.copy(), state.points.copy()
    poses[problem.nodes] = make_transform(optimum.rotations, optimum.translations)
    points[problem.landmarks] = optimum.landmarks
    points[problem.observations] = points[graph.variable_of[problem.observations]]
    own = _recovered(state, problem, 0.0 if not coarse else _UNMOVED)
    rows, private = _in_map(state, problem, own, poses)
    points[rows] = private
    bent = []
    for c in condensed:
        motion = c.apply_motion(graph, poses, points)
        poses[c.inner], points[c.inner_observations] = motion.poses, motion.points
        bent += [c] if motion.turn > config.region.largest_turn(c) else []
    reduced = with_component(state.reduced, problem, state)
    recovered = {i: r for i, r in state.recovered.items() if i in reduced} | own
    return replace(state, poses=poses, points=points, reduced=reduced, recovered=recovered), problem, result, bent


def _robust(
    problem: ComponentProblem, optimum: JoiningState, optimizer: LevenbergMarquardtConfig, config: RobustConfig
) -> tuple[JoiningState, LeastSquaresResult, ComponentProblem]:
    """Without the rows that the others contradict; the order of the variables stays."""
    solver, maps = problem.problem, problem.maps.unflattened()

    def solve_weighted(weighted: list[LocalMap], start: JoiningState) -> JoiningState:
        solver.maps = flatten(weighted)
        return solver.optimize(start, optimizer)[0]

    rows = closing_rows(maps, *optimum.model_dimensions)
    found = RobustJoining(maps, rows, partial(map_residual, solver.model), solve_weighted, config).run(optimum)
    solver.maps = flatten(found.maps)
    optimum, result = solver.optimize(found.state, optimizer)
    return optimum, result, replace(problem, dropped=found.dropped)


def _recovered(state: EstimateState, problem: ComponentProblem, unmoved: float) -> dict[int, RecoveredLandmarks]:
    """Own landmarks of each record given what was joined.

    Where the residual of a submap hardly changed they stay as they were in it.
    """
    own, out = problem.maps.first(len(problem.records)), {}
    residual, weighted, _ = joint_errors(kernels.TANGENT, own, problem.optimum)
    each = split(residual, own.mean_ptr), split(weighted, own.mean_ptr)
    parts = zip(problem.records, problem.reduced, *each, strict=True)
    for (i, reduced, r, w), dropped in zip(parts, problem.dropped, strict=True):
        known = state.recovered.get(i)
        if known is None or known.reduced is not reduced or (r - known.residual) @ (w - known.weighted) > unmoved:
            if len(dropped):
                w = reduced.information @ predicted(reduced.information, r, dropped)
            private = state.graph.records[i].submap.landmarks[reduced.private]
            if reduced.cross is not None:
                private = private + (reduced.cross @ w).reshape(-1, 3)
            known = RecoveredLandmarks(reduced, r, w, private)
        out[i] = known
    return out


def _in_map(
    state: EstimateState, problem: ComponentProblem, own: dict[int, RecoveredLandmarks], poses: FloatArray
) -> tuple[np.ndarray, FloatArray]:
    """Observations (n,) of the recovered landmarks, and where these are in the map, (n, 3)."""
    graph, records = state.graph, problem.records
    every = [own[i].private for i in records]
    T = np.repeat(poses[graph.starts[records]], [len(p) for p in every], axis=0)
    rows = observations_of(graph, records, [m.private for m in problem.reduced])
    moved = (T[:, :3, :3] @ np.concatenate([np.empty((0, 3)), *every])[..., None])[..., 0] + T[:, :3, 3]
    return rows, moved
