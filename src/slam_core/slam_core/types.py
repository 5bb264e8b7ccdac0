# SPDX-License-Identifier: Apache-2.0
"""The data that crosses package borders. Every array's shape, unit and frame stands here and nowhere else.

All objects are immutable by convention: arrays are handed over, never changed afterwards. Times are header stamps in
integer nanoseconds, the only time an estimator knows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from slam_core.camera import Camera, StereoCamera
from slam_core.geometry import FloatArray

Float32Array = npt.NDArray[np.float32]
ByteArray = npt.NDArray[np.uint8]
AnyArray = npt.NDArray[Any]

ORIGIN_SIGMA = 1e-6
"""Standard deviation (m, rad) of a pose that is the origin by definition: no covariance may be singular."""
GRAVITY = 9.81
"""Specific force of a rig at rest, m/s2."""
LONGEST_IMU_STEP_S = 0.05
"""IMU readings farther apart than this say nothing of what was between them."""


class FeatureSource(IntEnum):
    """Source of a feature's depth; the values of the ``source`` field of the ``features`` topic.

    ``TAG``: a corner of a fiducial tag, with depth from the tag's pose (:mod:`slam_core.tags`). ``PREDICTED``: none was
    measured; it is the depth that the frames before and the motion since predict, so that the direction alone counts.
    """

    STEREO = 0
    TOF = 1
    FUSED = 2
    TAG = 3
    PREDICTED = 4


MakeColour = Callable[[], ByteArray | None]
"""Makes an image in colour once it is wanted, uint8 (height, width, 3), red first; None of a grey camera."""


def no_colour() -> None:
    """The :data:`MakeColour` of a grey camera."""


@dataclass(frozen=True, eq=False)
class Mask:
    """Pixels (height, width) uint8 of a rectified image that are not to be used, of people for instance: not zero."""

    stamp_ns: int
    pixels: ByteArray


MakeImage = Callable[[], ByteArray]
"""Makes an image once it is wanted, uint8 (height, width)."""


class ImageOnDemand:
    """A field of a dataclass that is given an image or a :data:`MakeImage`, and read as the image.

    That is made once, when it is first read; ``dataclasses.replace`` reads every field that it is not given.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, instance: None, owner: type) -> ImageOnDemand: ...

    @overload
    def __get__(self, instance: object, owner: type) -> ByteArray: ...

    def __get__(self, instance: object | None, owner: type) -> ImageOnDemand | ByteArray:
        if instance is None:
            raise AttributeError(f"{self._name} has no default")
        image: ByteArray | MakeImage = vars(instance)[self._name]
        if not callable(image):
            return image
        made = vars(instance)[self._name] = image()
        return made

    def __set__(self, instance: object, image: ByteArray | MakeImage) -> None:
        vars(instance)[self._name] = image


@dataclass(frozen=True, eq=False)
class StereoImages:
    """A rectified pair: ``left`` and ``right`` uint8, shape (height, width), of ``stereo``, left in ``frame_id``.

    ``right`` may be given as what makes it: not every frame needs it. So is ``colour``, the left image in colour: few
    frames are shown, all are searched for features. ``mask``: see :class:`Mask`, of the left image.
    """

    stamp_ns: int
    left: ByteArray
    right: ImageOnDemand = ImageOnDemand()
    stereo: StereoCamera  # type: ignore[misc]  # the field above has none
    frame_id: str = "stereo_left_optical_frame"
    colour: MakeColour = no_colour
    mask: ByteArray | None = None

    def picture(self) -> ByteArray:
        """The left image in colour, or grey of a grey camera."""
        colour = self.colour()
        return self.left if colour is None else colour


@dataclass(frozen=True, eq=False)
class DepthImage:
    """A rectified depth image with its uncertainty.

    depth: float32 (height, width), m along z, NaN where there is none. sigma: float32, standard deviation of depth, m,
    NaN likewise. amplitude, intensity: float32 or None. All in the optical frame ``frame_id``.
    """

    stamp_ns: int
    depth: Float32Array
    sigma: Float32Array
    camera: Camera
    amplitude: Float32Array | None = None
    intensity: Float32Array | None = None
    frame_id: str = "tof_optical_frame"
    mask: ByteArray | None = None

    def points(self) -> Float32Array:
        """Points (height, width, 3) float32 in the optical frame, NaN where there is no depth."""
        c = self.camera
        u = (np.arange(c.width, dtype=np.float32) - np.float32(c.cx)) / np.float32(c.fx)
        v = (np.arange(c.height, dtype=np.float32) - np.float32(c.cy)) / np.float32(c.fy)
        points = np.empty((*self.depth.shape, 3), np.float32)
        np.multiply(self.depth, u[None, :], out=points[..., 0])
        np.multiply(self.depth, v[:, None], out=points[..., 1])
        points[..., 2] = self.depth
        return points


@dataclass(frozen=True)
class RigCamera:
    """One of several cameras of a rig.

    Its rectified lens, the optical frame ``frame_id`` of its features, its number on the rig.
    """

    camera: Camera
    frame_id: str
    number: int


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one instant in one optical frame, as on the ``features`` topic; float32, so a topic loses nothing.

    xyz (n, 3) m in the optical frame ``frame_id``; uv (n, 2) px in the rectified image of ``camera``; depth (n,) m
    along z; sigma_uv (n, 2) px; sigma_depth (n,) m; response (n,); source (n,) uint8, see :class:`FeatureSource`;
    descriptors (n, d), unit norm, d = 128 for SURF-128 and SIFT. track_ids (n,): equal in the frames through which
    the front end has followed a feature, 0 where it has not. Corners of fiducial tags have descriptors of zeros and
    negative track ids, which say the tag and the corner (:mod:`slam_core.tags`). Features of several cameras of a rig
    (:func:`slam_core.rig_features.features_of_rig`): ``cameras`` and ``seen_by`` (n,), which of them; each feature is
    then in the optical frame and the image of its own camera. Both are empty for one camera alone.
    """

    stamp_ns: int
    xyz: Float32Array
    uv: Float32Array
    depth: Float32Array
    sigma_uv: Float32Array
    sigma_depth: Float32Array
    response: Float32Array
    source: ByteArray
    descriptors: Float32Array
    camera: Camera
    frame_id: str = "stereo_left_optical_frame"
    track_ids: npt.NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    cameras: tuple[RigCamera, ...] = ()
    seen_by: ByteArray = field(default_factory=lambda: np.zeros(0, np.uint8))

    def __post_init__(self) -> None:
        if len(self.track_ids) != len(self.uv):
            object.__setattr__(self, "track_ids", np.zeros(len(self.uv), np.int32))
        if len(self.seen_by) != len(self.uv):
            object.__setattr__(self, "seen_by", np.zeros(len(self.uv), np.uint8))

    def __len__(self) -> int:
        return len(self.uv)

    @property
    def is_pose_only(self) -> bool:
        """True if no depth was measured: the frame tells where the rig is, and nothing new of the landmarks."""
        return len(self) > 0 and bool((self.source == FeatureSource.PREDICTED).all())

    def joined(self, others: Features) -> Features:
        """Features with others of the same instant after them."""
        f, g = self, others
        return replace(
            self,
            xyz=np.concatenate([f.xyz, g.xyz]),
            uv=np.concatenate([f.uv, g.uv]),
            depth=np.concatenate([f.depth, g.depth]),
            sigma_uv=np.concatenate([f.sigma_uv, g.sigma_uv]),
            sigma_depth=np.concatenate([f.sigma_depth, g.sigma_depth]),
            response=np.concatenate([f.response, g.response]),
            source=np.concatenate([f.source, g.source]),
            descriptors=np.concatenate([f.descriptors, g.descriptors]),
            track_ids=np.concatenate([f.track_ids, g.track_ids]),
            seen_by=np.concatenate([f.seen_by, g.seen_by]),
        )

    def select(self, index: AnyArray) -> Features:
        """The features at ``index`` (mask or indices)."""
        return Features(
            self.stamp_ns,
            self.xyz[index],
            self.uv[index],
            self.depth[index],
            self.sigma_uv[index],
            self.sigma_depth[index],
            self.response[index],
            self.source[index],
            self.descriptors[index],
            self.camera,
            self.frame_id,
            self.track_ids[index],
            self.cameras,
            self.seen_by[index],
        )


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose ``T`` = T_parent_child (4, 4) at a stamp, covariance (6, 6) in the order of ``slam_core.geometry``."""

    stamp_ns: int
    T: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """Motion of the rig between two stamps: ``T`` = T_rig(start)_rig(end), with covariance (6, 6)."""

    start_stamp_ns: int
    end_stamp_ns: int
    T: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class ImuSample:
    """An IMU reading along the axes of ``frame_id``.

    Angular_velocity (3,) rad/s, linear_acceleration (3,) m/s2 with gravity. position: (3,) m where the IMU sits in that
    frame.
    """

    stamp_ns: int
    angular_velocity: FloatArray
    linear_acceleration: FloatArray
    frame_id: str = "base_link"
    position: FloatArray = field(default_factory=lambda: np.zeros(3))

    def seen_from(self, T: FloatArray, frame_id: str, delay_ns: int = 0) -> ImuSample:
        """Reading along the axes of another frame, ``T`` = T_frame_own (4, 4), and so much later."""
        R, stamp_ns = T[:3, :3], self.stamp_ns + delay_ns
        position = R @ self.position + T[:3, 3]
        return ImuSample(stamp_ns, R @ self.angular_velocity, R @ self.linear_acceleration, frame_id, position)


@dataclass(frozen=True, eq=False)
class OdometryReading:
    """A pose of ``frame_id`` as wheels, legs or another estimator have it, T_odom_frame (4, 4).

    covariance: (6, 6) of the pose; twist: (6,) m/s and rad/s along the frame's axes; twist_covariance: (6, 6). The
    covariances are as reported: they may be zero, huge or not finite. T_rig_frame: (4, 4) mounting of the frame.
    """

    stamp_ns: int
    T: FloatArray
    covariance: FloatArray
    twist: FloatArray
    twist_covariance: FloatArray
    frame_id: str = "base_link"
    T_rig_frame: FloatArray = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, eq=False)
class PositionReading:
    """Position (3,) m of an antenna in a fixed frame of its own, as UWB or GNSS has it; covariance (3, 3) as reported.

    The covariance may be zero, huge or not finite.
    """

    stamp_ns: int
    position: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class PressureReading:
    """Pressure of the air (Pa) around the rig with its variance (Pa2) as reported, which may be zero or not finite."""

    stamp_ns: int
    pressure: float
    variance: float = 0.0


@dataclass(frozen=True, eq=False)
class Submap:
    """A local map as one joint Gaussian, in the frame of its own first rig pose, ``<agent>/submap_<index>``.

    end_pose: T_start_end (4, 4), the rig pose at which the submap was closed. landmarks: (n, 3) m, in the start frame.
    covariance: (6 + 3n, 6 + 3n) of (end pose error, landmarks), positive definite. landmark_ids: (n,) int64, unique
    within the agent and kept when a landmark is carried into the next submap, so that equal ids of neighbours are a
    known association (a hint, not proof); negative ones are corners of fiducial tags (:mod:`slam_core.tags`), the same
    for every agent on every day. sightings: (n,) int32. descriptors: (n, d) float32, unit norm. path: the rig
    poses inside, T_start_rig, each with the marginal covariance (6, 6) at that time; the first is identity, the last is
    ``end_pose``. follows_previous: the start pose is the end pose of submap ``index - 1`` of the agent (odometry
    chains); False after the rig was lost. session: run of the agent's filter, given by the filter; indices begin anew
    in each, and a later one has a larger number.
    """

    agent: str
    index: int
    start_stamp_ns: int
    end_stamp_ns: int
    end_pose: FloatArray
    landmarks: FloatArray
    covariance: FloatArray
    landmark_ids: npt.NDArray[np.int64]
    sightings: npt.NDArray[np.int32]
    descriptors: Float32Array
    path: tuple[PoseEstimate, ...]
    follows_previous: bool = True
    session: int = 0

    def __post_init__(self) -> None:
        n = len(self.landmarks)
        expected = {
            "end_pose": (4, 4),
            "landmarks": (n, 3),
            "covariance": (6 + 3 * n, 6 + 3 * n),
            "landmark_ids": (n,),
            "sightings": (n,),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"submap {name} must have shape {shape}, got {getattr(self, name).shape}")
        if len(self.descriptors) != n:
            raise ValueError(f"submap has {n} landmarks but {len(self.descriptors)} descriptors")

    @property
    def frame_id(self) -> str:
        """Name of the submap's frame."""
        return f"{self.agent}/submap_{self.index}" if self.agent else f"submap_{self.index}"


@dataclass
class Counters:
    """Named counts of what was accepted and rejected; a rejection is counted, never silent."""

    counts: dict[str, int] = field(default_factory=dict)

    def add(self, name: str, amount: int = 1) -> None:
        """Count ``amount`` more of ``name``."""
        self.counts[name] = self.counts.get(name, 0) + amount
