# SPDX-License-Identifier: Apache-2.0
"""The map under construction: filter, table of landmarks and the last frame's other features, kept in step.

:class:`OpenSubmap` alone holds the filter.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from ekf_slam_node.association.linking import FrameLink
from ekf_slam_node.config import MAX_UPDATE_LANDMARKS, EkfSlamConfig
from ekf_slam_node.filtering.candidates import Candidates
from ekf_slam_node.filtering.covariance import IndexArray
from ekf_slam_node.filtering.drift import Drift
from ekf_slam_node.filtering.ekf import Ekf, TimeUpdate, UpdateReport
from ekf_slam_node.filtering.landmarks import CandidateLandmarks, LandmarkTable, spread_choice
from ekf_slam_node.filtering.models import CORE_DIM, Frame, relative_motion, rig_points
from ekf_slam_node.filtering.sightings import in_view, observed_by, sighted_by
from ekf_slam_node.odometry.odometry import UpDirection
from ekf_slam_node.odometry.relative_poses import RELATIVE_POSE_GATE, RelativePoseMeasurement, relative_pose_error
from slam_core.camera import MIN_DEPTH
from slam_core.geometry import FloatArray, inverse_jacobian, invert_transform, skew
from slam_core.tags import CORNERS
from slam_core.types import PoseEstimate

_STANDING_VELOCITY = np.repeat([0.02, np.radians(0.5)], 3)
"""Standard deviations (m/s, rad/s) of the velocities of a rig that stands."""

_MISSED_TAG = 4
"""Frames in a row in which a tag is elsewhere, after which it has moved."""
_ELSEWHERE = 3.0
"""NIS of a tag's corners, in gates, beyond which it is elsewhere and not only badly seen."""


@dataclass(frozen=True, eq=False)
class LandmarkMatches:
    """Landmarks ``slots`` (k,) seen as features ``columns`` (k,) of a frame, to be measured."""

    slots: IndexArray
    columns: IndexArray

    @classmethod
    def of_nothing(cls) -> LandmarkMatches:
        """No landmark."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.slots)

    def select(self, index: np.ndarray) -> LandmarkMatches:
        """The sightings at ``index``."""
        return LandmarkMatches(self.slots[index], self.columns[index])

    def every_second(self) -> LandmarkMatches:
        """Half of the sightings."""
        return self.select(np.arange(0, len(self), 2))


@dataclass(frozen=True)
class TagReport:
    """Numbers of fiducial tags of a frame: measured, seen elsewhere, and moved for good."""

    measured: int
    elsewhere: int
    moved: int


class OpenSubmap:
    """Landmarks around the start of one submap.

    Parameters
    ----------
    ekf, table
        The same landmarks in the same order.
    pending
        Features of the frame at which the map begins.
    """

    def __init__(
        self,
        config: EkfSlamConfig,
        T_rig_optical: FloatArray,
        ekf: Ekf,
        table: LandmarkTable,
        pending: CandidateLandmarks,
    ) -> None:
        self._ekf = ekf
        self.table = table
        self.pending = pending
        self._drift = Drift()
        self._config = config
        self._T_rig_optical = T_rig_optical
        self._frames = 0
        self._missed_tags: Counter[int] = Counter()

    @classmethod
    def empty(
        cls, config: EkfSlamConfig, T_rig_optical: FloatArray, velocity: FloatArray, variance: FloatArray,
        pending: CandidateLandmarks,
    ) -> OpenSubmap:  # fmt: skip
        """A map without landmarks, with a velocity (6,) of some variances (6,)."""
        covariance = np.zeros((CORE_DIM, CORE_DIM))
        covariance[6:, 6:] = np.diag(variance)
        table = LandmarkTable(pending.candidates.descriptors.shape[1])
        return cls(config, T_rig_optical, Ekf(velocity, covariance, config.error == "invariant"), table, pending)

    def given_pose(self, slots: IndexArray, pending: CandidateLandmarks) -> OpenSubmap:
        """The seed's start of the next map, in the rig's frame: landmarks ``slots`` and velocity given its pose.

        What is known of them stays in this submap too, so that joining counts it twice: the joint NEES test shows it.
        """
        known = self._ekf.given_pose(slots)
        return OpenSubmap(self._config, self._T_rig_optical, known, self.table.select(slots), pending)

    # ----------------------------------------------------------------------------------------------- what is estimated
    @property
    def is_finite(self) -> bool:
        """True if all that matters of the estimate are finite numbers."""
        return self._ekf.is_finite

    @property
    def T(self) -> FloatArray:
        """T_submap_rig (4, 4)."""
        return self._ekf.T

    @property
    def velocity(self) -> FloatArray:
        """Body velocity (6,), linear and angular, m/s and rad/s."""
        return self._ekf.velocity

    def velocity_covariance(self) -> FloatArray:
        """Covariance (6, 6) of the velocity."""
        return self._ekf.velocity_covariance()

    def filter_pose(self, stamp_ns: int) -> PoseEstimate:
        """Pose of the rig as the filter has it; with drift only if ``submap.drift`` says so."""
        covariance = self.pose_covariance() if self._config.submap.drift else self._ekf.pose_covariance()
        return PoseEstimate(stamp_ns, self._ekf.T.copy(), covariance)

    def pose_covariance(self) -> FloatArray:
        """Covariance (6, 6) of the rig's pose, drift included."""
        return self._ekf.pose_covariance() + self._drift.covariance(self._ekf.T[:3, 3])

    def predicted_pose(self, dt: float, moving: float) -> tuple[FloatArray, FloatArray]:
        """Pose (4, 4) and covariance (6, 6), drift included, in dt s, of which the rig is ``moving`` on, then stops."""
        grown = self._ekf.time_update(dt, self._config.motion.sigma).head[:6, :6] - self._ekf.pose_covariance()
        return self._ekf.T @ relative_motion(self._ekf.velocity, moving), self.pose_covariance() + grown

    def landmarks(self) -> tuple[FloatArray, FloatArray]:
        """Positions (m, 3) and covariances (m, 3, 3) of the landmarks in the frame of the submap."""
        blocks = self._ekf.covariance.blocks(CORE_DIM + 3 * np.arange(len(self._ekf.landmarks)))
        return self._ekf.landmarks, blocks

    def close(self) -> tuple[FloatArray, FloatArray]:
        """Landmarks (m, 3), and the joint covariance (6 + 3 m, 6 + 3 m) of the rig's pose and them."""
        keep = np.concatenate([np.arange(6), np.arange(CORE_DIM, self._ekf.covariance.size)])
        covariance = self._ekf.covariance.dense(keep)
        if self._config.submap.drift:
            covariance[:6, :6] = self.pose_covariance()
        return self._ekf.landmarks.copy(), covariance

    @property
    def descriptor_size(self) -> int:
        """Columns of the descriptors, 0 while none is known."""
        known = len(self.table) or len(self.pending.ids)
        return int(self.pending.candidates.descriptors.shape[1]) if known else 0

    def candidates(self) -> Candidates:
        """Everything a frame can be linked to: landmarks first, then the pending features."""
        points, covariances = self._ekf.landmarks_in_rig()
        pending = self.pending.candidates
        return Candidates(
            np.concatenate([points, pending.points]),
            np.concatenate([covariances, pending.covariances]),
            np.concatenate([self.table.descriptors, pending.descriptors]),
            np.concatenate([self.table.tracks, pending.tracks]),
            len(self.table),
        )

    # ---------------------------------------------------------------------------------------------- one frame, in order
    def predict(self, dt: float, sigma: FloatArray, T_previous_now: FloatArray) -> TimeUpdate:
        """Time update by dt s with acceleration noise sigma (6,), linearised at a motion found; returns it."""
        step = self._ekf.time_update(dt, sigma, T_previous_now)
        self._ekf.apply_time_update(step)
        return step

    def apply_motion(self, step: TimeUpdate, aid: RelativePoseMeasurement, T_previous_now: FloatArray) -> bool:
        """Measure the step just predicted by another sensor, unless that contradicts it; returns whether it was."""
        rotation = step.T[:3, :3] @ T_previous_now[:3, :3].T
        error, covariance = relative_pose_error(aid, T_previous_now, rotation)
        return self._ekf.update_increment(step, error, covariance, aid.rows, RELATIVE_POSE_GATE).applied

    def move_without_link(self, frame: Frame, dt: float, aid: RelativePoseMeasurement) -> bool:
        """Move to a frame that no image links, by a motion that something else has measured; whether it was used."""
        applied = self.apply_motion(self.predict(dt, self._config.motion.sigma, aid.T), aid, aid.T)
        self._ekf.move_to_mean()
        self.pending = candidate_landmarks(frame, self._T_rig_optical)
        return applied

    def stand(self) -> None:
        """The rig stands."""
        self.set_velocity(np.zeros(6), _STANDING_VELOCITY)

    def set_velocity(self, velocity: FloatArray, sigma: FloatArray) -> None:
        """Replace what is known of the velocity by (6,) with standard deviations (6,)."""
        self._ekf.restart(velocity, sigma)

    def displace(self, height: float, variance: float, up: UpDirection) -> None:
        """Move the rig, not the landmarks, by a height (m) with its variance; ``up`` along the submap's axes."""
        self._ekf.displace(height * up.direction, up.spread(height, variance))

    def initialise_landmarks(self, frame: Frame, link: FrameLink, wanted: int, new_ids: IndexArray) -> LandmarkMatches:
        """Make landmarks of the pending features that the frame confirms, until ``wanted`` are in sight.

        The rig must still be at the previous frame: a new landmark's place comes from that frame's measurement.
        Features that belong to a landmark of the submap before (``ids``) come first.
        """
        known = np.flatnonzero(link.rows < len(self.table))
        fresh = np.flatnonzero(link.rows >= len(self.table))
        fresh = fresh[self.pending.free[link.rows[fresh] - len(self.table)]]
        pixels, size = frame.side_by_side()[link.columns], frame.wide_size
        known = known[spread_choice(pixels[known], pixels[:0], MAX_UPDATE_LANDMARKS, size)]
        which = link.rows[fresh] - len(self.table)
        inherited = self.pending.ids[which] >= 0
        first = fresh[inherited]
        others = fresh[~inherited]
        room = max(wanted - len(known) - len(first), 0)
        others = others[spread_choice(pixels[others], pixels[np.concatenate([known, first])], room, size)]
        chosen = np.concatenate([first, others])
        slots = self._add(link.rows[chosen] - len(self.table), new_ids)
        return LandmarkMatches(
            np.concatenate([link.rows[known], slots]), np.concatenate([link.columns[known], link.columns[chosen]])
        )

    def _add(self, which: IndexArray, new_ids: IndexArray) -> IndexArray:
        pending = self.pending
        candidates = pending.candidates.select(which)
        slots = self._ekf.augment(candidates.points, candidates.covariances)
        ids = np.where(pending.ids[which] >= 0, pending.ids[which], new_ids[: len(which)])
        self.table.add(ids, pending.sightings[which], candidates.descriptors, candidates.tracks, self._frames)
        return slots

    def measure(
        self, frame: Frame, sight: LandmarkMatches, common: FloatArray, closes: bool
    ) -> tuple[UpdateReport, LandmarkMatches]:
        """Measurement update with the sightings whose innovation is inside the gate; returns those.

        ``common`` (6,): standard deviations of an error of the camera's pose that all of them share. ``closes``: the
        next submap starts at the camera's pose in this frame, its error included: so does this one end there.
        """
        if closes:
            self._ekf.add_pose_noise(common)
            common = np.zeros(6)
        seen = frame.places(sight.columns)
        z, variance = seen.z, seen.variance * self._noise_factors(sight)
        found = sighted_by(self._ekf.sighted, seen, variance, sight.slots, self._T_rig_optical, common)
        good = np.flatnonzero((found.nis < self._config.association.gate) & (found.seen.depth > MIN_DEPTH))
        tracks = frame.tracks[sight.columns]
        is_followed = 2 * np.sum((tracks > 0) & (tracks == self.table.tracks[sight.slots])) > len(sight)
        used = most_telling(found.information, good, self._config.landmark.most_measured) if is_followed else good
        report = self._ekf.update(z[used], variance[used], found.seen.select(used), sight.slots[used], common)
        after = observed_by(seen, self._ekf.T, self._T_rig_optical, self._ekf.landmarks[sight.slots])
        self.table.noise.record(sight.slots, (z - after.z)[:, :2], seen.variance[:, :2])
        return report, sight.select(good)

    def measure_tags(self, frame: Frame, common: FloatArray) -> TagReport:
        """Measure the corners of fiducial tags after a frame's features; new tags become landmarks.

        frame: four corners of each tag. A tag is measured if all its corners are inside their gates; one that was not
        for a while has moved, and begins anew with its next sighting. ``common``: as in :meth:`measure`.
        """
        tags = np.arange(len(frame)).reshape(-1, CORNERS)
        slot_of = {corner: slot for slot, corner in enumerate(self.table.ids.tolist()) if corner < 0}
        is_new = np.array([int(frame.tracks[columns[0]]) not in slot_of for columns in tags], dtype=bool)
        columns = tags[~is_new].ravel()
        slots = np.array([slot_of[c] for c in frame.tracks[columns].tolist()], dtype=np.int64)
        distance = self._distances(frame, slots, columns, common).reshape(-1, CORNERS)
        fits = (distance < self._config.association.gate).all(axis=1)
        is_far = distance.mean(axis=1) > _ELSEWHERE * self._config.association.gate
        good = np.repeat(fits, CORNERS)
        if good.any():
            self.measure(frame, LandmarkMatches(slots[good], columns[good]), common, closes=False)
            self.table.sightings[slots[good]] += 1
        moved = self._tags_missed(frame.tracks[columns][::CORNERS], is_far)
        if is_new.any():
            self._add_tags(frame.select(tags[is_new].ravel()), common)
        return TagReport(int(fits.sum()), int(is_far.sum()), moved)

    def _distances(self, frame: Frame, slots: IndexArray, columns: IndexArray, common: FloatArray) -> FloatArray:
        """NIS (k,) of sightings; infinite behind the camera."""
        seen = frame.places(columns)
        found = sighted_by(self._ekf.sighted, seen, seen.variance, slots, self._T_rig_optical, common)
        return np.where(found.seen.depth > MIN_DEPTH, found.nis, np.inf)

    def _tags_missed(self, first_corners: IndexArray, is_far: np.ndarray) -> int:
        """Note tags that were seen elsewhere several times in a row, to be removed; returns how many."""
        moved = 0
        for corner, is_elsewhere in zip(first_corners.tolist(), is_far.tolist(), strict=True):
            self._missed_tags[corner] = self._missed_tags[corner] + 1 if is_elsewhere else 0
            moved += self._missed_tags[corner] == _MISSED_TAG
        return moved

    def _remove_moved_tags(self) -> None:
        for corner in [c for c, missed in self._missed_tags.items() if missed >= _MISSED_TAG]:
            del self._missed_tags[corner]
            for slot in np.flatnonzero((self.table.ids <= corner) & (self.table.ids > corner - CORNERS))[::-1]:
                self._remove(int(slot))

    def _remove(self, slot: int) -> None:
        self._ekf.remove(slot)
        self.table.remove(slot)

    def _add_tags(self, frame: Frame, common: FloatArray) -> None:
        points, covariances = rig_points(frame, self._T_rig_optical)
        J = np.concatenate([np.broadcast_to(np.eye(3), (len(points), 3, 3)), -skew(points)], axis=2)
        self._ekf.augment(points, covariances + J @ np.diag(common**2) @ np.swapaxes(J, 1, 2))
        n = len(frame)
        ids, once, untracked = frame.tracks.astype(np.int64), np.ones(n, np.int32), np.zeros(n, np.int32)
        self.table.add(ids, once, frame.descriptors, untracked, self._frames)

    def drift_by(self, common: FloatArray) -> None:
        """Take in what a frame's common error (6,) leaves behind, at the camera's present place."""
        self._drift.add(common, (self._ekf.T @ self._T_rig_optical)[:3, 3])

    def _noise_factors(self, sight: LandmarkMatches) -> FloatArray:
        """Factors (k, 3) on the variances of u, v and inverse depth: a landmark's own share of the pixel noise."""
        own = self.table.noise.factors(sight.slots)
        return np.column_stack([own, own, np.ones(len(own))])

    def remember(self, frame: Frame, sight: LandmarkMatches, link: FrameLink, landmarks_before: int) -> None:
        """Keep the features of a frame that measured nothing as the next frame's pending ones, with any names."""
        named = np.flatnonzero(link.rows >= landmarks_before)
        which = link.rows[named] - landmarks_before
        pending = candidate_landmarks(frame, self._T_rig_optical)
        pending.ids[link.columns[named]] = self.pending.ids[which]
        pending.sightings[link.columns[named]] = self.pending.sightings[which] + 1
        pending = pending.without(sight.columns)
        if frame.cameras:
            others = self.pending.without(which).of_others(frame.camera_numbers, frame.stamp_ns)
            J = inverse_jacobian(link.T)
            pending = pending.joined(others.moved(invert_transform(link.T), J @ link.covariance @ J.T))
        self.pending = pending

    def prune_landmarks(self, frame: Frame, sight: LandmarkMatches) -> None:
        """Count who was seen and who should have been, and remove landmarks that cannot be relied on."""
        expected = in_view(frame, self._ekf.T, self._T_rig_optical, self._ekf.landmarks, margin_px=10.0)
        self.table.tracks[sight.slots] = frame.tracks[sight.columns]
        self.table.count(sight.slots, frame.descriptors[sight.columns], expected)
        self._frames += 1
        for slot in self.table.unreliable(self._frames, self._config.landmark):
            self._remove(slot)
        self._remove_moved_tags()


def most_telling(information: FloatArray, good: IndexArray, most: int) -> IndexArray:
    """Select of the sightings ``good`` (k,) the ``most`` that tell most; ``information`` is that of all (n,).

    For frames whose features were followed: their errors last as long as the patch, so that all tell little more.
    """
    order = np.argsort(-information[good], kind="stable")
    return np.asarray(np.sort(good[order[:most]]))


def candidate_landmarks(frame: Frame, T_rig_optical: FloatArray) -> CandidateLandmarks:
    """All features of a frame, nameless, as candidates for the next one."""
    points, covariances = rig_points(frame, T_rig_optical)
    n = len(frame)
    return CandidateLandmarks(
        Candidates(points, covariances, frame.descriptors, frame.tracks),
        np.full(n, -1, dtype=np.int64),
        np.ones(n, dtype=np.int32),
        np.ones(n, dtype=bool),
        np.array(frame.camera_numbers)[frame.seen_by],
        np.full(n, frame.stamp_ns, dtype=np.int64),
    )


def with_inherited_ids(
    frame: Frame, T_rig_optical: FloatArray, sight: LandmarkMatches, used: LandmarkMatches, table: LandmarkTable
) -> CandidateLandmarks:
    """All features of a frame, those in ``sight`` with their landmarks' names: what an independent submap starts from.

    Names and descriptors are inherited, no places: these come from this frame's measurements except the ``used`` ones,
    which have gone into the submap before. So the two submaps share no information.
    """
    pending = candidate_landmarks(frame, T_rig_optical)
    descriptors = pending.candidates.descriptors.copy()
    descriptors[sight.columns] = table.descriptors[sight.slots]
    pending.ids[sight.columns] = table.ids[sight.slots]
    pending.sightings[sight.columns] = table.sightings[sight.slots] + 1
    pending.free[used.columns] = False
    candidates = replace(pending.candidates, descriptors=descriptors)
    return replace(pending, candidates=candidates)
