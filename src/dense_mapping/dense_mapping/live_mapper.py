# SPDX-License-Identifier: Apache-2.0
"""The dense model while the map grows: key frames wait for the trajectory to reach them, and follow it when it moves.

Images come at once, the joined trajectory only with the next submap. Key frames are chosen by the odometry, made small,
and kept until a path has a pose for their stamp; every path after that moves what has to move, a bounded number at a
time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dense_mapping.colours import RecentColours
from dense_mapping.dense_model import DenseConfig, DenseModel
from dense_mapping.keyframes import Keyframe, KeyframeSelector, with_picture
from slam_core.geometry import FloatArray
from slam_core.trajectory import Trajectory
from slam_core.types import ByteArray, PoseEstimate

_WAITING = 400
"""Key frames kept for each camera until their pose is known."""


@dataclass(frozen=True, eq=False)
class _Waiting:
    camera: str
    T_base_camera: FloatArray
    keyframe: Keyframe


class LiveMapper:
    """Feeds a :class:`DenseModel` from several agents' cameras.

    Attributes
    ----------
    model
        The model; what waits is not in it yet.
    dropped
        Key frames that were dropped because no pose came for them.
    """

    def __init__(self, config: DenseConfig) -> None:
        self.config = config
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.model = DenseModel(self.config)
        self.dropped = 0
        self._selectors: dict[str, KeyframeSelector] = {}
        self._odometry: dict[str, FloatArray] = {}
        self._paths: dict[str, Trajectory] = {}
        self._mounts: dict[str, tuple[str, FloatArray]] = {}
        self._waiting: deque[_Waiting] = deque()
        self._colours: dict[str, RecentColours] = {}

    def begin_session(self) -> None:
        """The clock has begun anew: drop what waits for a pose of the old time; the model stays."""
        self.dropped += len(self._waiting)
        self._waiting.clear()
        self._selectors.clear()
        self._odometry.clear()

    @property
    def waiting(self) -> int:
        """Key frames whose pose is not known yet."""
        return len(self._waiting)

    def add_odometry(self, agent: str, T_odom_base: FloatArray) -> None:
        """Take an agent's pose by its odometry, by which key frames are chosen."""
        self._odometry[agent] = T_odom_base

    def add_image(self, agent: str, sensor: str, T_base_camera: FloatArray, make: Callable[[], Keyframe]) -> bool:
        """Take an image if it is a key frame by the odometry; only then ``make`` is called. Returns whether it is."""
        camera = f"{agent}/{sensor}"
        T_odom_base = self._odometry.get(agent)
        if T_odom_base is None:
            return False
        selector = self._selectors.setdefault(camera, KeyframeSelector(self.config.keyframe))
        if not selector.wants(T_odom_base @ T_base_camera):
            return False
        self._mounts[camera] = (agent, T_base_camera)
        self._waiting.append(self._coloured(_Waiting(camera, T_base_camera, make())))
        if len(self._waiting) > _WAITING:
            self._waiting.popleft()
            self.dropped += 1
        return True

    def has_colours(self, agent: str) -> bool:
        """True if any colour picture of the agent has come."""
        return any(camera.startswith(f"{agent}/") for camera in self._colours)

    def add_colour(self, agent: str, sensor: str, stamp_ns: int, picture: ByteArray) -> None:
        """Take a colour picture (h, w, 3) uint8 in the pixels of the camera's images, before or after the image."""
        camera = f"{agent}/{sensor}"
        self._colours.setdefault(camera, RecentColours()).add(stamp_ns, picture)
        self._waiting = deque(self._coloured(item) if item.camera == camera else item for item in self._waiting)

    def _coloured(self, item: _Waiting) -> _Waiting:
        colours = self._colours.get(item.camera)
        picture = None if colours is None else colours.near(item.keyframe.stamp_ns)
        return item if picture is None else replace(item, keyframe=with_picture(item.keyframe, picture))

    def set_path(self, agent: str, poses: Sequence[tuple[int, FloatArray]]) -> int:
        """Take an agent's trajectory in the map, (stamp, T_map_base); returns how many key frames came in or moved."""
        self._paths[agent] = Trajectory.from_estimates(PoseEstimate(stamp, T, _NO_COVARIANCE) for stamp, T in poses)
        return self._place() + self.model.move(self._pose)

    def _place(self) -> int:
        """Put in what has a pose now."""
        still: deque[_Waiting] = deque()
        placed = 0
        for item in self._waiting:
            T = self._pose(item.camera, item.keyframe.stamp_ns)
            if T is None:
                still.append(item)
                continue
            self.model.add_keyframe(item.camera, T, item.keyframe)
            placed += 1
        self._waiting = still
        return placed

    def _pose(self, camera: str, stamp_ns: int) -> FloatArray | None:
        """T_map_camera at a stamp, or None where the trajectory does not reach."""
        agent, T_base_camera = self._mounts[camera]
        path = self._paths.get(agent)
        if path is None or not len(path) or not path.stamps_ns[0] <= stamp_ns <= path.stamps_ns[-1]:
            return None
        return np.asarray(path.interpolate(np.array([stamp_ns]))[0] @ T_base_camera)


_NO_COVARIANCE: FloatArray = np.zeros((6, 6))
