# SPDX-License-Identifier: Apache-2.0
"""The dense model from images and a look-up of poses, without ROS: on trajectories that are final, or that still move.

    stage = DenseStage(config)                              # moving: key frames are chosen by the odometry
    stage.add_odometry(agent, T_odom_base)
    if stage.wants(agent, "tof", stamp_ns, T_base_camera):
        stage.add(agent, "tof", T_base_camera, depth_image)
    stage.set_path(agent, trajectory)                       # what waits comes in, what has moved follows

    with DenseStage(config, final=trajectories) as stage:   # key frames are chosen by the trajectories
        ...

A key frame waits until a path has a pose for its stamp, and of a final model until the colour picture and the mask of
its time can have come. What accelerometers read turns with the path too: it levels the floor plans.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from dense_mapping.colours import RecentColours, stereo_picture
from dense_mapping.dense_model import DenseConfig, DenseModel
from dense_mapping.keyframes import Keyframe, KeyframeSelector, make_keyframe, with_picture
from dense_mapping.masks import RecentMasks, masked
from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.reconstruction.surface import Surface
from dense_mapping.stereo_depth import stereo_depth
from slam_core.geometry import FloatArray
from slam_core.messages.key_frames import AnchoredKeyFrame
from slam_core.trajectory import Trajectory
from slam_core.types import ByteArray, DepthImage, Mask
from stereo_frontend.sources import RawPair
from stereo_frontend.stage import StereoStage

_MAX_WAITING = 400
"""Key frames kept until their pose is known."""
_MAX_FORCES = 100_000
_FORCE_STEP_NS = 50_000_000
"""Of a path that still moves, so many readings of an accelerometer are kept, and one in so much time."""


@dataclass(frozen=True, eq=False)
class _Waiting:
    camera: str
    keyframe: Keyframe


def cameras_of(agent: str, names: Sequence[str]) -> list[str]:
    """Namespaces of an agent's cameras: of the ``names`` of every agent's, and of its own ``agent/camera``."""
    own = [name for name in names if name.startswith(f"{agent}/")]
    every = [f"{agent}/{name}".lstrip("/") for name in names if "/" not in name]
    return [*every, *own] or [agent]


class DenseStage:
    """Feeds a :class:`DenseModel` from several agents' cameras.

    Parameters
    ----------
    final
        Trajectories by agent that will not change; None: they come by :meth:`set_path` and change.
    coloured
        Agents whose depth images have colour pictures; of others it is known when one comes.
    with_masks
        Cameras, ``AGENT/stereo`` or ``AGENT/tof``, that have masks; of others it is known when one comes.
    rides
        First and last stamp (ns) of lift rides by agent: a cabin on its way is no part of the building.

    Attributes
    ----------
    model
        The model; what waits is not in it yet.
    dropped
        Key frames that were dropped because no pose came for them.
    refused_masks
        Key frames whose mask was of another size.
    """

    def __init__(
        self,
        config: DenseConfig,
        final: Mapping[str, Trajectory] | None = None,
        coloured: frozenset[str] = frozenset(),
        with_masks: frozenset[str] = frozenset(),
        rides: Mapping[str, Sequence[tuple[int, int]]] | None = None,
    ) -> None:
        self.config = config
        self._final, self._first_coloured, self._first_masked = final, coloured, with_masks
        self._rides = rides or {}
        self._pool = None if final is None else ThreadPoolExecutor(1, "field")
        self._last: Future[None] | None = None
        self.reset()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            with self._pool:
                self._wait()

    def reset(self) -> None:
        """Forget everything."""
        self.model = DenseModel(self.config, fixed=self._final is not None)
        self.dropped = self.refused_masks = self._put = 0
        self._paths = dict(self._final or {})
        self._coloured = set(self._first_coloured)
        self._selectors: dict[str, KeyframeSelector] = {}
        self._odometry: dict[str, FloatArray] = {}
        self._mounts: dict[str, tuple[str, FloatArray]] = {}
        self._waiting: deque[_Waiting] = deque()
        self._anchored: set[str] = set()
        """Cameras of key frames of the radio that wait or are in the model."""
        self._colours: dict[str, RecentColours] = {}
        self._masks = {camera: RecentMasks() for camera in self._first_masked}
        self._forces: dict[str, deque[tuple[int, FloatArray]]] = {}

    def begin_session(self) -> None:
        """A clock has begun anew: drop what waits for a pose of the old time; the model stays.

        So do key frames of the radio, which wait for the map to have their submap.
        """
        still = deque(item for item in self._waiting if item.camera in self._anchored)
        self.dropped += len(self._waiting) - len(still)
        self._waiting = still
        self._selectors.clear()
        self._odometry.clear()

    @property
    def waiting(self) -> int:
        """Key frames whose pose or colour is not known yet."""
        return len(self._waiting)

    # -- inputs --------------------------------------------------------------------------------------------------------

    def add_odometry(self, agent: str, T_odom_base: FloatArray) -> None:
        """Take an agent's pose by its odometry, by which key frames are chosen while the path moves."""
        self._odometry[agent] = T_odom_base

    def wants(self, agent: str, sensor: str, stamp_ns: int, T_base_camera: FloatArray) -> bool:
        """True if an image is a key frame; the caller then adds it."""
        if self._is_riding(agent, np.array([stamp_ns]))[0]:
            return False
        T = self._odometry.get(agent) if self._final is None else self._T_map_base(agent, stamp_ns)
        selector = self._selectors.setdefault(f"{agent}/{sensor}", KeyframeSelector(self.config.keyframe))
        return T is not None and selector.wants(T @ T_base_camera)

    def key_stamps(
        self, agent: str, T_base_camera: FloatArray, stamps_ns: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.int64]:
        """The stamps of a camera's images that make key frames on a final trajectory."""
        path = self._paths[agent]
        inside = (stamps_ns >= path.stamps_ns[0]) & (stamps_ns <= path.stamps_ns[-1])
        stamps: npt.NDArray[np.int64] = stamps_ns[inside & ~self._is_riding(agent, stamps_ns)]
        selector = KeyframeSelector(self.config.keyframe)
        poses = path.interpolate(stamps) @ T_base_camera if len(stamps) else ()
        return np.array([t for t, T in zip(stamps, poses, strict=True) if selector.wants(T)], dtype=np.int64)

    def _is_riding(self, agent: str, stamps_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """True (n,) for stamps (n,) within a lift ride."""
        riding = np.zeros(len(stamps_ns), dtype=bool)
        for first, last in self._rides.get(agent, ()):
            riding |= (stamps_ns > first) & (stamps_ns < last)
        return riding

    def add(
        self, agent: str, sensor: str, T_base_camera: FloatArray, image: DepthImage, picture: ByteArray | None = None
    ) -> None:
        """Take the depth image of a key frame; ``picture`` (h, w[, 3]) uint8, by default the amplitude."""
        camera = f"{agent}/{sensor}"
        self._mounts[camera] = (agent, T_base_camera)
        item = _Waiting(camera, make_keyframe(image, self.config.keyframe, picture))
        self._waiting.append(self._with_mask(self._with_colour(item)))
        if self._final is not None:
            self._place()
        elif len(self._waiting) > _MAX_WAITING:
            self._anchored.discard(self._waiting.popleft().camera)
            self.dropped += 1

    def add_pair(self, agent: str, T_base_left: FloatArray, pair: RawPair, stereo: StereoStage) -> None:
        """Take a stereo pair if it is a key frame; ``stereo`` rectifies it."""
        if not self.wants(agent, "stereo", pair.stamp_ns, T_base_left):
            return
        stereo.add(pair)
        for images in stereo.ready():
            picture = stereo_picture(images, agent in self._coloured)
            self.add(agent, "stereo", T_base_left, stereo_depth(images, self.config.stereo), picture)

    def add_colour(self, agent: str, sensor: str, stamp_ns: int, picture: ByteArray | None) -> None:
        """Take a colour picture (h, w, 3) uint8 in the pixels of the camera's images, before or after the image.

        None: there is none at this stamp.
        """
        camera = f"{agent}/{sensor}"
        self._coloured.add(agent)
        self._colours.setdefault(camera, RecentColours()).add(stamp_ns, picture)
        self._waiting = deque(self._with_colour(item) if item.camera == camera else item for item in self._waiting)
        if self._final is not None:
            self._place()

    def add_mask(self, agent: str, sensor: str, mask: Mask) -> None:
        """Take a mask in the pixels of the camera's images, before or after the image that it belongs to.

        One of another size than a key frame of its time is counted as refused.
        """
        camera = f"{agent}/{sensor}"
        self._masks.setdefault(camera, RecentMasks()).add(mask)
        self._waiting = deque(self._with_mask(item) if item.camera == camera else item for item in self._waiting)
        if self._final is not None:
            self._place()

    def add_anchored(self, agent: str, frame: AnchoredKeyFrame) -> bool:
        """Take a key frame that came over the radio, whatever the odometry says; True if it is in the model now.

        Its camera is one of its own, mounted on the rig as it was when a submap began: there the map has a pose, and
        moves the key frame with it.
        """
        camera = f"{agent}/view_{frame.image.stamp_ns}"
        if camera in self._anchored:
            return False
        self._anchored.add(camera)
        image = replace(frame.image, stamp_ns=frame.start_stamp_ns)
        self.add(agent, camera.removeprefix(f"{agent}/"), frame.T_start_camera, image, frame.colours)
        return self._final is None and self._place() > 0

    def add_force(self, agent: str, stamp_ns: int, force: FloatArray) -> None:
        """Take an accelerometer's reading (3,) m/s2 in the rig's frame: on the whole it points up."""
        own = self._forces.setdefault(agent, deque(maxlen=None if self._final is not None else _MAX_FORCES))
        if self._final is not None or not own or stamp_ns - own[-1][0] >= _FORCE_STEP_NS:
            own.append((stamp_ns, force))

    def set_path(self, agent: str, path: Trajectory) -> int:
        """Take an agent's trajectory in the map; returns how many key frames came in or moved."""
        self._paths[agent] = path
        return self._place() + self.model.move(self._pose)

    def finish(self) -> None:
        """Put in what waits for colours that will not come."""
        self._place(is_over=True)
        self._wait()

    # -- outputs -------------------------------------------------------------------------------------------------------

    def surface(self) -> Surface:
        """The mesh of all key frames; of a final model it is made once."""
        return self.model.surface()

    def floor_plans(self, surface: Surface) -> tuple[FloorPlan, ...]:
        """Plans of all storeys, lowest first, levelled; ``surface`` is that of :meth:`surface`."""
        return self.model.floor_plans(surface, self.specific_force())

    def specific_force(self) -> FloatArray | None:
        """Sum (3,) of what the accelerometers read along the paths, map frame: it points up. None without any."""
        total = np.zeros(3)
        for agent, readings in self._forces.items():
            path = self._paths.get(agent)
            if path is None or not len(path):
                continue
            stamps = np.array([stamp for stamp, _ in readings], dtype=np.int64)
            inside = (stamps >= path.stamps_ns[0]) & (stamps <= path.stamps_ns[-1])
            if inside.any():
                forces = np.array([force for _, force in readings])[inside]
                total += np.einsum("nij,nj->i", path.interpolate(stamps[inside])[:, :3, :3], forces)
        return total if total.any() else None

    # -- placing -------------------------------------------------------------------------------------------------------

    def _with_colour(self, item: _Waiting) -> _Waiting:
        colours = self._colours.get(item.camera)
        picture = None if colours is None else colours.near(item.keyframe.stamp_ns)
        return item if picture is None else replace(item, keyframe=with_picture(item.keyframe, picture))

    def _with_mask(self, item: _Waiting) -> _Waiting:
        masks = self._masks.get(item.camera)
        mask = None if masks is None else masks.at(item.keyframe.stamp_ns)
        if mask is None:
            return item
        try:
            return replace(item, keyframe=masked(item.keyframe, mask))
        except ValueError:
            self.refused_masks += 1
            return item

    def _awaits_mask(self, item: _Waiting) -> bool:
        """True if the mask of an image of a final model may still come."""
        masks = self._masks.get(item.camera)
        return self._final is not None and masks is not None and masks.newest_ns < item.keyframe.stamp_ns

    def _awaits_colour(self, item: _Waiting) -> bool:
        """True if the colour picture of a depth image of a final model may still come."""
        agent, _, sensor = item.camera.rpartition("/")
        if self._final is None or sensor != "tof" or agent not in self._coloured:
            return False
        colours = self._colours.get(item.camera)
        return colours is None or colours.newest_ns < item.keyframe.stamp_ns

    def _place(self, *, is_over: bool = False) -> int:
        """Put in what waits for nothing any more; returns how many key frames."""
        still: deque[_Waiting] = deque()
        before = self._put
        for item in self._waiting:
            T = self._pose(item.camera, item.keyframe.stamp_ns)
            if T is None or (not is_over and (self._awaits_colour(item) or self._awaits_mask(item))):
                still.append(item)
            else:
                self._add_to_model(item, T)
        self._waiting = still
        return self._put - before

    def _add_to_model(self, item: _Waiting, T_map_camera: FloatArray) -> None:
        """Add a key frame; to a final model by a thread, so that the next one's depth is measured meanwhile."""
        self._put += 1
        if self._pool is None:
            self.model.add_keyframe(item.camera, T_map_camera, item.keyframe)
            return
        self._wait()
        self._last = self._pool.submit(self.model.add_keyframe, item.camera, T_map_camera, item.keyframe)

    def _wait(self) -> None:
        if self._last is not None:
            self._last.result()

    def _pose(self, camera: str, stamp_ns: int) -> FloatArray | None:
        """T_map_camera at a stamp, or None where the trajectory does not reach."""
        agent, T_base_camera = self._mounts[camera]
        T_map_base = self._T_map_base(agent, stamp_ns)
        return None if T_map_base is None else T_map_base @ T_base_camera

    def _T_map_base(self, agent: str, stamp_ns: int) -> FloatArray | None:
        path = self._paths.get(agent)
        if path is None or not len(path) or not path.stamps_ns[0] <= stamp_ns <= path.stamps_ns[-1]:
            return None
        return np.asarray(path.interpolate(np.array([stamp_ns]))[0])
