# SPDX-License-Identifier: Apache-2.0
"""Association of a whole planar drive by several hypotheses (Reid 1979).

Every hypothesis is an EKF-SLAM of its own. A sighting may be one of each landmark that is near, or a new one; each
choice is followed as long as it stays probable beside the best one. So landmarks that lie too close to be told apart at
once are told apart by what is seen later, and the choice takes all sightings together.

Sightings half a landmark apart split hypotheses that hardly differ. Of those whose poses agree, the most probable one
is followed alone: so a hundred stand for a hundred places where the robot may be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ekf_slam_node.association.jcbb import IndexArray
from slam_core.config import Config, parameter
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray
from slam_experiments.planar import hypothesis_kernels as kernels
from slam_experiments.planar.ekf import POSE_DIM, PlanarConfig


@dataclass(frozen=True)
class HypothesesConfig(Config):
    """Parameters of the hypotheses: what a sighting may be, and how many are followed."""

    most: int = parameter(100, "hypotheses that are followed", minimum=1)
    least_weight: float = parameter(
        -60.0,
        "logarithm of the weight, beside the best one's, below which a hypothesis is dropped; errors that stay the same"
        " from sighting to sighting make the true one improbable for a while",
        maximum=0.0,
    )
    new: float = parameter(0.01, "share of the sightings that show a landmark for the first time", minimum=1e-9)
    confidence: float = parameter(0.9999, "share of true pairs inside a gate", minimum=0.5, maximum=0.99999999)
    same_pose: float = parameter(
        0.5, "squared Mahalanobis distance below which two hypotheses' poses agree, 0: never", minimum=0.0
    )


class PlanarHypotheses:
    """K hypotheses: states (K, D), covariances (K, D, D), landmarks in use (K,) and log weights (K,), best first.

    Parameters
    ----------
    pose
        Where the robot starts, (3,) m and rad; it is known.
    area
        Range times bearing within which sightings lie, m rad: how far a new landmark is spread.
    """

    def __init__(
        self, config: PlanarConfig, pose: FloatArray, area: float, tree: HypothesesConfig | None = None
    ) -> None:
        self._tree = tree = tree or HypothesesConfig()
        self._gate = chi_square_bound(tree.confidence, 2)
        self._log_new = np.log(tree.new / area)
        self._R = np.array([config.sigma_range**2, config.sigma_bearing**2])
        self._x = np.array(pose, dtype=np.float64)[None]
        self._P = 1e-12 * np.eye(POSE_DIM)[None]
        self._used = np.zeros(1, dtype=np.int64)
        self._weight = np.zeros(1)
        self._parents: list[IndexArray] = []
        self._choices: list[IndexArray] = []

    def predict(self, motion: FloatArray, covariance: FloatArray) -> None:
        """Move by (3,) in the robot's frame, with covariance (3, 3)."""
        kernels.predict(self._x, self._P, self._used, motion, covariance)

    def process(self, measured: FloatArray) -> None:
        """Branch over what each of the measurements (k, 2) of one step may be; no landmark is seen twice in a step."""
        taken = np.zeros((len(self._x), (self._x.shape[1] - POSE_DIM) // 2), dtype=bool)
        for z in measured:
            taken = self._merge(self._branch(z, taken))

    def _branch(self, z: FloatArray, taken: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Follow the most probable choices for one sighting; ``taken``: (K, M) landmarks seen in this step."""
        M = taken.shape[1]
        found = kernels.scores(self._x, self._P, self._used, taken, z, self._R, self._gate)
        total = (np.pad(found, ((0, 0), (0, 1)), constant_values=self._log_new) + self._weight[:, None]).ravel()
        order = np.argsort(-total, kind="stable")[: self._tree.most]
        order = order[total[order] > total[order[0]] + self._tree.least_weight]
        parent, choice = np.divmod(order, M + 1)
        self._weight = total[order] - total[order[0]]
        self._take(parent)
        taken = np.pad(taken[parent], ((0, 0), (0, max(int(self._used.max()) + 1 - M, 0))))
        self._make_room(taken.shape[1])
        slot = np.where(choice == M, self._used, choice)
        kernels.follow(self._x, self._P, self._used, slot, z, self._R)
        taken[np.arange(len(slot)), slot] = True
        self._parents.append(parent)
        self._choices.append(slot)
        return taken

    def _take(self, rows: IndexArray) -> None:
        if not np.array_equal(rows, np.arange(len(self._x))):
            self._x, self._P, self._used = self._x[rows], self._P[rows], self._used[rows]

    def _make_room(self, landmarks: int) -> None:
        more = POSE_DIM + 2 * landmarks - self._x.shape[1]
        if more > 0:
            self._x = np.pad(self._x, ((0, 0), (0, more)))
            self._P = np.pad(self._P, ((0, 0), (0, more), (0, more)))

    def _merge(self, taken: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Keep the most probable one of hypotheses whose poses agree; returns the rows of ``taken`` that stay."""
        rows = kernels.distinct(self._x, self._P, self._tree.same_pose)
        self._take(rows)
        self._weight = self._weight[rows]
        self._parents[-1], self._choices[-1] = self._parents[-1][rows], self._choices[-1][rows]
        return np.asarray(taken[rows])

    @property
    def most_probable(self) -> tuple[FloatArray, FloatArray]:
        """Pose and landmarks (3 + 2 m,) of the most probable hypothesis, and their covariance."""
        n = POSE_DIM + 2 * int(self._used[0])
        return self._x[0, :n].copy(), self._P[0, :n, :n].copy()

    def best(self) -> IndexArray:
        """Landmark of every sighting so far (n,) in the most probable hypothesis."""
        at, slots = 0, []
        for parent, choice in zip(reversed(self._parents), reversed(self._choices), strict=True):
            slots.append(int(choice[at]))
            at = int(parent[at])
        return np.array(slots[::-1], dtype=np.int64)
