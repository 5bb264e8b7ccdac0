"""A joining problem that stays solved while local maps are added and replaced, at the cost of what that affects.

It keeps three things: every local map's cost and gradient at the estimate, which are exact; the sum of these gradients;
and a factor (:class:`~slam_core.clique_tree.CliqueTree`) whose parts may have been linearised a little elsewhere. Steps
with that factor and the exact gradient end at the optimum of the whole problem, not near it; how far the factor is out
of date only decides how many there are. So an update eliminates anew what the changed local maps touch and what hangs
above it, moves only what the new gradient moves, and linearises again only local maps that have turned since.
"""

from __future__ import annotations

import copy

import numpy as np

from sjsam_node import growing_kernels, kernels
from sjsam_node.layout import make_layout
from sjsam_node.problem import FlatMaps, LocalMap, State, flatten
from sjsam_node.sighting_kernels import counting_order
from slam_core.block_pattern import BlockPattern, IntArray, pointers
from slam_core.clique_tree import CliqueTree
from slam_core.elimination_tree import Symbolic, analyze, update_stack_size
from slam_core.geometry import FloatArray
from slam_core.growing import Growing, GrowingRuns
from slam_core.least_squares import LeastSquaresResult, LevenbergMarquardtConfig

_SLOW = 0.25
"""A step that promises more than this share of what the last one did asks for a newer factor."""
_STILL = 1e-4
"""rad that a local map must have turned for a newer factor to be of use."""


class GrowingProblem:
    """Local maps under keys, poses that move as rotation vectors do, in 3D.

    Parameters
    ----------
    anchor
        Pose that is fixed.
    turn
        Local maps that turned by more (rad) are linearised anew.
    """

    def __init__(self, anchor: int, turn: float) -> None:
        self.last: tuple[int, IntArray] = (anchor, np.empty(0, dtype=np.int64))
        """A pose and landmarks that will change next: they are eliminated last."""
        self.state = State(np.empty((0, 3, 3)), np.empty((0, 3)), np.empty((0, 3)))
        self._anchor, self._turn, self._entry = anchor, turn, dict[int, int]()
        self._tree = CliqueTree()
        # Local maps one after the other, those that were replaced among them.
        self._reference, self._key, self._alive = Growing(np.int64), Growing(np.int64), Growing(np.bool_)
        self._poses, self._landmarks = GrowingRuns(np.int64), GrowingRuns(np.int64)
        self._mean, self._information = GrowingRuns(np.float64), GrowingRuns(np.float64)
        self._slots, self._own = GrowingRuns(np.int64), GrowingRuns(np.float64)
        self._cost, self._home = Growing(np.float64), Growing(np.int64)
        self._turned = Growing(np.float64, (3, 3))
        # Unknowns one after the other: gradient, and the pose p or the landmark -1 - p that each belongs to.
        self._gradient, self._owner = Growing(np.float64), Growing(np.int64)
        self._pose_slot, self._landmark_slot = Growing(np.int64), Growing(np.int64)

    def copy(self) -> GrowingProblem:
        """The problem as it is now; this one may go on growing."""
        other = copy.copy(self)
        other._entry, other._tree = dict(self._entry), self._tree.copy()
        for name in ("_reference", "_key", "_poses", "_landmarks", "_mean", "_information", "_slots", "_owner"):
            setattr(other, name, getattr(self, name).fork())
        for name in ("_alive", "_own", "_cost", "_home", "_turned", "_gradient", "_pose_slot", "_landmark_slot"):
            setattr(other, name, getattr(self, name).copy())
        return other

    @property
    def cost(self) -> float:
        """chi2."""
        return float(self._cost.data[self._alive.data].sum())

    @property
    def redundancy(self) -> int:
        """Rows beyond unknowns."""
        alive = np.nonzero(self._alive.data)[0]
        return int(self._mean.sizes(alive).sum()) - self._tree.unknowns

    @property
    def wasted(self) -> float:
        """Share of what is stored that is not needed any more."""
        return max(self._tree.wasted, 1.0 - len(self._entry) / max(len(self._alive), 1))

    def covariance(self, poses: IntArray) -> FloatArray:
        """Joint covariance (6k, 6k) of poses with the factor as it is; zero for the anchor."""
        slots = (self._pose_slot.data[poses][:, None] + np.arange(6)).ravel()
        free = np.repeat(self._pose_slot.data[poses] >= 0, 6)
        out = np.zeros((len(slots), len(slots)))
        out[np.ix_(free, free)] = self._tree.covariance(slots[free])
        return out

    def update(
        self, state: State, changed: dict[int, LocalMap], config: LevenbergMarquardtConfig, least: float = 0.0
    ) -> tuple[LeastSquaresResult, IntArray]:
        """Put local maps under their keys, and optimise from ``state``, which differs from the last one only in what
        is new, and in what the ``changed`` maps see; ``least`` as in :meth:`converge`.

        Returns
        -------
        The result, not converged where a batch is needed; and the keys of the local maps that changed or moved.
        """
        self.state = state
        for table, size in ((self._pose_slot, len(state.translations)), (self._landmark_slot, len(state.landmarks))):
            table.extend(np.full(max(size - len(table), 0), -1, dtype=np.int64))
        if changed and not self._replace(changed):
            result = LeastSquaresResult(np.nan, np.nan, 0, False, "the normal equations are singular")
            return result, np.empty(0, dtype=np.int64)
        result, moved = self.converge(config, least)
        return result, np.unique(np.concatenate([moved, np.array(list(changed), dtype=np.int64)]))

    # -- local maps ----------------------------------------------------------------------------------------------------

    def _replace(self, changed: dict[int, LocalMap]) -> bool:
        """Put local maps in the place of older ones; False if the problem is not determined."""
        old = np.array([self._entry[key] for key in changed if key in self._entry], dtype=np.int64)
        self._alive.data[old] = False
        self._take(old, np.zeros(len(old)), np.zeros(int(self._slots.sizes(old).sum())))
        new = self._append(changed)
        self._take(new, *growing_kernels.evaluate(kernels.TANGENT, new, self._flat(), *_arrays(self.state)))
        return self._eliminate(np.concatenate([old, new]))

    def _append(self, changed: dict[int, LocalMap]) -> IntArray:
        """Store local maps; their numbers."""
        first, flat = len(self._alive), flatten(list(changed.values()))
        self._reference.extend(flat.reference)
        self._poses.extend(flat.poses, flat.pose_ptr)
        self._landmarks.extend(flat.landmarks, flat.landmark_ptr)
        self._mean.extend(flat.mean, flat.mean_ptr)
        self._information.extend(flat.information, flat.information_ptr)
        self._key.extend(np.array(list(changed), dtype=np.int64))
        poses, landmarks = self._slots_of(flat.poses, 6), self._slots_of(-1 - flat.landmarks, 3)
        references = self._slots_of(flat.reference, 6)
        parts = [
            (references[k], poses[flat.pose_ptr[k] : flat.pose_ptr[k + 1]].ravel(),
             landmarks[flat.landmark_ptr[k] : flat.landmark_ptr[k + 1]].ravel())
            for k in range(len(changed))
        ]  # fmt: skip
        ptr = pointers([sum(map(len, run)) for run in parts])
        self._slots.extend(np.concatenate([part for run in parts for part in run]), ptr)
        self._own.extend(np.zeros(int(ptr[-1])), ptr)
        count = len(changed)
        self._alive.extend(np.ones(count, dtype=np.bool_))
        self._cost.extend(np.zeros(count))
        self._home.extend(np.full(count, -1, dtype=np.int64))
        self._turned.extend(np.zeros((count, 3, 3)))
        new = np.arange(first, first + count)
        self._entry.update(zip(changed, new.tolist(), strict=True))
        return new

    def _slots_of(self, owners: IntArray, width: int) -> IntArray:
        """Unknowns (k, width) of poses p or landmarks -1 - p, made where there are none; -1 for the anchor."""
        table, numbers = (self._pose_slot, owners) if width == 6 else (self._landmark_slot, -1 - owners)
        fresh = np.unique(numbers[table.data[numbers] < 0])
        fresh = fresh[fresh != self._anchor] if width == 6 else fresh
        first = len(self._gradient)
        table.data[fresh] = first + width * np.arange(len(fresh))
        self._gradient.extend(np.zeros(width * len(fresh)))
        self._owner.extend(np.repeat(fresh if width == 6 else -1 - fresh, width))
        slots = table.data[numbers]
        return np.where(slots[:, None] >= 0, slots[:, None] + np.arange(width), -1)

    def _flat(self) -> FlatMaps:
        """Everything stored, as the kernels read it."""
        return FlatMaps(
            self._reference.data, self._poses.ptr, self._poses.data, self._landmarks.ptr, self._landmarks.data,
            self._mean.ptr, self._mean.data, self._information.ptr, self._information.data,
        )  # fmt: skip

    def _take(self, chosen: IntArray, costs: FloatArray, gradients: FloatArray) -> None:
        """Costs and gradients of some local maps from now on."""
        self._cost.data[chosen] = costs
        growing_kernels.replace(
            chosen, gradients, self._slots.ptr, self._slots.data, self._own.data, self._gradient.data
        )

    # -- optimum -------------------------------------------------------------------------------------------------------

    def converge(self, config: LevenbergMarquardtConfig, least: float = 0.0) -> tuple[LeastSquaresResult, IntArray]:
        """Steps to the optimum; the result and the keys of the local maps that moved.

        What would gain less chi2 than ``least`` by a move stays where it is; its gradient is not forgotten.
        """
        initial = cost = self.cost
        moved, decrement = np.zeros(len(self._alive), dtype=np.bool_), np.inf
        iterations, reason = 0, "iteration limit"
        while iterations < config.max_iterations:
            iterations += 1
            enough, before = config.relative_tolerance * max(cost, 1e-9), decrement
            step, decrement = self._tree.step(self._gradient.data, least)
            if decrement <= enough:
                reason = ""
                break
            found = self._moved_by(step)
            if found is None and not self._relinearize(_STILL):
                reason = "no step lowers the cost"
                break
            if found is not None:
                cost = self.cost
                moved[found] = True
                self._relinearize(_STILL if decrement > _SLOW * before else self._turn)
        return LeastSquaresResult(initial, cost, iterations, not reason, reason), np.unique(self._key.data[moved])

    def _moved_by(self, step: FloatArray) -> IntArray | None:
        """Take a step; the local maps that it moved. None, and nothing moves, if it does not lower the cost."""
        flat, alive = self._flat(), np.nonzero(self._alive.data)[0]
        state = self.state.retract(self._pose_slot.data, self._landmark_slot.data, step)
        moved = growing_kernels.touched(alive, self._slots.ptr, self._slots.data, step)
        costs, gradients = growing_kernels.evaluate(kernels.TANGENT, moved, flat, *_arrays(state))
        if not costs.sum() <= self._cost.data[moved].sum():
            return None
        self.state = state
        self._take(moved, costs, gradients)
        return np.asarray(moved)

    def _relinearize(self, turn: float) -> bool:
        """Eliminate anew what has turned by more than ``turn`` since it was linearised; whether there was any."""
        alive = np.nonzero(self._alive.data)[0]
        R, then = self.state.rotations[self._reference.data[alive]], self._turned.data[alive]
        stale = alive[np.linalg.norm(R - then, axis=(1, 2)) > np.sqrt(2.0) * turn]
        return len(stale) > 0 and self._eliminate(stale)

    # -- elimination ---------------------------------------------------------------------------------------------------

    def _eliminate(self, changed: IntArray) -> bool:
        """Eliminate anew what some local maps touch and what hangs above it; False if that is not determined."""
        slots = np.unique(_runs(self._slots, changed))
        orphans = self._tree.detach(self._tree.covering(slots[slots >= 0]))
        if self._tree.is_empty:
            self._tree = CliqueTree()
            self._home.data[:] = -1
        chosen = np.nonzero(self._alive.data & self._tree.is_off(self._home.data))[0]
        left = [self._tree.left_over(c) for c in orphans.tolist()]
        pattern, unknowns = self._pattern(chosen, [rows for rows, _ in left])
        symbolic = analyze(pattern)
        ordered = unknowns[symbolic.order(pattern)]
        value_ptr, values = self._tree.room(symbolic)
        packed = [part for _, part in left]
        good = growing_kernels.factorize(
            kernels.TANGENT, chosen, self._flat(), *_arrays(self.state),
            self._elements(chosen, [rows for rows, _ in left], ordered, symbolic),
            (pointers([len(part) for part in packed]), np.concatenate([np.empty(0), *packed])),
            symbolic, value_ptr, values, np.empty(update_stack_size(symbolic)),
        )  # fmt: skip
        if not good:
            return False
        self._tree.attach(symbolic, ordered, orphans)
        self._home.data[chosen] = growing_kernels.first_home(
            chosen, self._slots.ptr, self._slots.data, self._tree.homes
        )
        self._turned.data[chosen] = self.state.rotations[self._reference.data[chosen]]
        gone = self._tree.homes < 0
        self._gradient.data[: len(gone)][gone] = 0.0
        return True

    def _pattern(self, chosen: IntArray, left: list[IntArray]) -> tuple[BlockPattern, IntArray]:
        """Blocks that some local maps and what orphans leave over couple, in an order of little fill, and the unknowns
        in that order. An orphan is a local map of a fixed pose of its own.
        """
        owners = [np.unique(self._owner.data[rows]) for rows in left]
        left_poses, left_points = [o[o >= 0] for o in owners], [-1 - o[o < 0] for o in owners]
        reference = self._reference.data[chosen]
        in_poses = np.concatenate([_runs(self._poses, chosen), *left_poses])
        in_points = np.concatenate([_runs(self._landmarks, chosen), *left_points])
        poses, points = np.unique(np.concatenate([reference, in_poses])), np.unique(in_points)
        empty = np.zeros(len(chosen) + len(left) + 1, dtype=np.int64)
        flat = FlatMaps(
            np.concatenate([np.searchsorted(poses, reference), np.full(len(left), len(poses))]),
            pointers([*self._poses.sizes(chosen), *map(len, left_poses)]), np.searchsorted(poses, in_poses),
            pointers([*self._landmarks.sizes(chosen), *map(len, left_points)]), np.searchsorted(points, in_points),
            empty, np.zeros(0), empty, np.zeros(0),
        )  # fmt: skip
        fixed = np.append(np.nonzero(poses == self._anchor)[0], len(poses))
        end = np.nonzero(poses == self.last[0])[0]
        end = np.concatenate([len(poses) + 1 + np.nonzero(np.isin(points, self.last[1]))[0], end])
        layout = make_layout(flat, len(poses) + 1, len(points), fixed, 3, end)
        unknowns = np.empty(layout.pattern.n, dtype=np.int64)
        for offsets, slots, width in (
            (layout.pose_offset[:-1], self._pose_slot.data[poses], 6),
            (layout.landmark_offset, self._landmark_slot.data[points], 3),
        ):
            free = offsets >= 0
            unknowns[offsets[free, None] + np.arange(width)] = slots[free, None] + np.arange(width)
        return layout.pattern, unknowns

    def _elements(
        self, chosen: IntArray, left: list[IntArray], ordered: IntArray, symbolic: Symbolic
    ) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """Local maps and orphans as ``growing_kernels.factorize`` takes them."""
        place = np.full(len(self._gradient) + 1, -1, dtype=np.int64)
        place[ordered] = np.arange(len(ordered))
        rows = place[np.concatenate([_runs(self._slots, chosen), *left])]
        ptr = pointers([*self._slots.sizes(chosen), *map(len, left)])
        first = np.minimum.reduceat(np.where(rows >= 0, rows, len(ordered)), ptr[:-1])
        front = np.repeat(np.arange(len(symbolic.size)), symbolic.eliminated)[first]
        first_ptr, by_first = counting_order(front, len(symbolic.size))
        return ptr, rows, first_ptr, by_first


def _arrays(state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
    return state.rotations, state.translations, state.landmarks


def _runs(runs: GrowingRuns, chosen: IntArray) -> IntArray:
    """Some runs one after the other."""
    sizes = runs.sizes(chosen)
    shift = runs.ptr[chosen] - pointers(sizes)[:-1]
    return np.asarray(runs.data[np.arange(int(sizes.sum())) + np.repeat(shift, sizes)])
