"""Our joining against GTSAM on the same problems, in one run: time to the optimum, chi2, memory, incremental joining.

    python benchmarks/joining/peers.py [--sizes 34 500] [--isam2]

Needs gtsam beside the run-time requirements (a separate environment is best). Block rows (each landmark with its own
3x3) are what both can express with their own factors; GTSAM's chi2 is our cost function at its solution, so that both
are measured alike.
"""

from __future__ import annotations

import argparse
import resource
import time

import gtsam
import numpy as np
from problems import joining_problem, local_maps, ring

from sjsam_node.problem import LocalMap, State
from slam_core.geometry import make_transform, so3_exp
from slam_core.least_squares import LevenbergMarquardtConfig

X, L = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L


STOP = LevenbergMarquardtConfig(relative_tolerance=1e-6)
"""GTSAM stops when the cost falls by less than 1e-5 of itself; ours a little later."""


def graph_of(maps: list[LocalMap], state: State) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The same block rows as GTSAM's own factors. Its poses move in the body frame, rotation first."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(X(0), _pose(state, 0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    for i in range(len(state.translations)):
        values.insert(X(i), _pose(state, i))
    for i, point in enumerate(state.landmarks):
        values.insert(L(i), point)
    for m in maps:
        for factor in factors_of(m):
            graph.add(factor)
    return graph, values


def factors_of(m: LocalMap) -> list[gtsam.NonlinearFactor]:
    R = so3_exp(m.mean[3:6])
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = R
    noise = gtsam.noiseModel.Gaussian.Information(turn.T @ m.information[[*range(6)]][:, [*range(6)]] @ turn)
    out = [
        gtsam.BetweenFactorPose3(X(m.reference), X(int(m.poses[0])), gtsam.Pose3(make_transform(R, m.mean[:3])), noise)
    ]
    for k, landmark in enumerate(m.landmarks):
        rows = slice(6 + 3 * k, 9 + 3 * k)
        out.append(_sighting(m.reference, int(landmark), m.mean[rows], m.information[rows, rows]))
    return out


def _sighting(pose: int, landmark: int, point: np.ndarray, information: np.ndarray) -> gtsam.NonlinearFactor:
    """A point in the pose's frame. GTSAM's Python has no such factor: as bearing and range, the same to first order."""
    distance = float(np.linalg.norm(point))
    bearing = gtsam.Unit3(point)
    J = np.vstack([bearing.basis().T / distance, point / distance])
    noise = gtsam.noiseModel.Gaussian.Covariance(J @ np.linalg.inv(information) @ J.T)
    return gtsam.BearingRangeFactor3D(X(pose), L(landmark), bearing, distance, noise)


def _pose(state: State, i: int) -> gtsam.Pose3:
    return gtsam.Pose3(make_transform(state.rotations[i], state.translations[i]))


def state_of(values: gtsam.Values, like: State) -> State:
    poses = [values.atPose3(X(i)).matrix() for i in range(len(like.translations))]
    points = [values.atPoint3(L(i)) for i in range(len(like.landmarks))]
    stacked = np.array(poses)
    return State(np.ascontiguousarray(stacked[:, :3, :3]), np.ascontiguousarray(stacked[:, :3, 3]), np.array(points))


def timed(action):  # type: ignore[no-untyped-def]
    began = time.perf_counter()
    result = action()
    return time.perf_counter() - began, result


def ours(maps: list[LocalMap], state: State, rows: str) -> tuple[float, State, float]:
    def run():  # type: ignore[no-untyped-def]
        return joining_problem(maps, state, rows).optimize(state, STOP)

    seconds, (optimum, result) = timed(run)
    return seconds, optimum, result.cost


def compare(count: int, incremental: bool) -> None:
    problem = ring(count)
    maps, state = local_maps(problem, "block", shared_only=False)
    ours(maps[:2], *[local_maps(problem.first(2), "block", False)[1]], "block")  # compile
    mine, _, chi2 = min(ours(maps, state, "block") for _ in range(3))
    judge = joining_problem(maps, state, "block")
    graph, values = graph_of(maps, state)
    theirs, solution = timed(gtsam.LevenbergMarquardtOptimizer(graph, values).optimize)
    their_chi2 = judge.cost(state_of(solution, state))
    print(f"{count:6d} block  ours {mine:8.3f} s  chi2 {chi2:14.4f}   GTSAM LM {theirs:8.3f} s  chi2 {their_chi2:14.4f}"
          f"   ratio {mine / theirs:6.3f}")  # fmt: skip
    joint_maps, joint_state = local_maps(problem, "joint", shared_only=True)
    joint, optimum, joint_chi2 = ours(joint_maps, joint_state, "joint")
    marginals, _ = timed(lambda: joining_problem(joint_maps, optimum, "joint").marginals(optimum))
    print(f"{count:6d} joint  ours {joint:8.3f} s  chi2 {joint_chi2:14.4f}   all marginals {marginals:8.3f} s")
    if incremental:
        seconds, last = timed(lambda: isam2(maps, state))
        reached = judge.cost(state_of(last, state))
        print(f"{count:6d} iSAM2 {seconds:8.3f} s  chi2 {reached:14.4f}   {1e3 * seconds / count:8.2f} ms per submap")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"       peak memory so far {peak:.0f} MiB")


def isam2(maps: list[LocalMap], state: State) -> gtsam.Values:
    solver = gtsam.ISAM2(gtsam.ISAM2Params())
    known: set[int] = set()
    estimate = gtsam.Values()
    for m in maps:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if m.reference == 0:
            graph.add(gtsam.PriorFactorPose3(X(0), _pose(state, 0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
            values.insert(X(0), _pose(state, 0))
        start = _pose(state, 0) if m.reference == 0 else estimate.atPose3(X(m.reference))
        step = gtsam.Pose3(make_transform(so3_exp(m.mean[3:6]), m.mean[:3]))
        values.insert(X(int(m.poses[0])), start.compose(step))
        for k, landmark in enumerate(m.landmarks.tolist()):
            if landmark not in known:
                known.add(landmark)
                values.insert(L(landmark), start.transformFrom(m.mean[6 + 3 * k : 9 + 3 * k]))
        for factor in factors_of(m):
            graph.add(factor)
        solver.update(graph, values)
        estimate = solver.calculateEstimate()
    return estimate


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[34, 500])
    parser.add_argument("--isam2", action="store_true", help="GTSAM's incremental solver too (minutes at 2000)")
    arguments = parser.parse_args()
    for size in arguments.sizes:
        compare(size, arguments.isam2)
