# SPDX-License-Identifier: Apache-2.0
"""The dense model: key frames of all cameras fused in one TSDF, moved when the trajectory is corrected.

    model = DenseModel(DenseConfig())
    model.add("agent/tof", T_map_camera, depth_image)      # only key frames are taken
    model.move(lambda camera, stamp_ns: T_map_camera)      # after a loop closure
    surface = model.surface()

A key frame keeps its depth image. When its pose changes, it is taken out of the field where it was put in and put in
where it belongs (Dai et al. 2017), those that moved farthest first and a bounded number at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from dense_mapping.keyframes import Keyframe, KeyframeConfig, KeyframeSelector, PlacedKeyframe, make_keyframe, thinned
from dense_mapping.plans.floor_plan import RAY_STEP, FloorPlan, FloorPlanConfig, floor_plans
from dense_mapping.reconstruction.surface import Surface, extract_surface
from dense_mapping.reconstruction.tsdf import TsdfConfig, TsdfVolume
from dense_mapping.stereo_depth import StereoDepthConfig
from slam_core.config import Config, group, parameter
from slam_core.geometry import FloatArray, boxminus
from slam_core.types import ByteArray, DepthImage

_MOVE_DISTANCE = 0.01
"""A key frame is moved when its pose changes by more."""
_MOVE_ANGLE_DEG = 0.3
"""Or turns by more, deg."""
_MOVES_AT_ONCE = 40
"""Key frames moved in one step."""
_MOVABLE_KEYFRAMES = 1500
"""Key frames kept to be moved; the oldest beyond that stay where they are."""

PoseLookup = Callable[[str, int], FloatArray | None]
"""T_map_camera of a camera at a stamp, or None where it is not known (any more)."""


@dataclass(frozen=True)
class DenseConfig(Config):
    """The dense model."""

    use_tof: bool = parameter(True, "depth of the ToF or depth camera, where there is one")
    use_stereo: bool = parameter(True, "depth of the stereo camera, where there is one")
    keyframe: KeyframeConfig = group(KeyframeConfig)
    stereo: StereoDepthConfig = group(StereoDepthConfig)
    tsdf: TsdfConfig = group(TsdfConfig)
    floor_plan: FloorPlanConfig = group(FloorPlanConfig)


class DenseModel:
    """Collects key frames of any number of cameras.

    Parameters
    ----------
    fixed
        Poses are final: nothing will be moved, and of the key frames only what floor plans need is kept.

    Attributes
    ----------
    moved
        How often a key frame was moved since the start.
    """

    def __init__(self, config: DenseConfig | None = None, *, fixed: bool = False) -> None:
        self.config = config or DenseConfig()
        self._fixed = fixed
        self.moved = 0
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.volume = TsdfVolume(self.config.tsdf)
        self._selectors: dict[str, KeyframeSelector] = {}
        self._placed: list[PlacedKeyframe] = []

    @property
    def keyframes(self) -> tuple[PlacedKeyframe, ...]:
        """The key frames that are kept, oldest first."""
        return tuple(self._placed)

    def wants(self, camera: str, T_map_camera: FloatArray) -> bool:
        """True if a frame of ``camera`` at this pose is a key frame; the caller then adds it."""
        selector = self._selectors.setdefault(camera, KeyframeSelector(self.config.keyframe))
        return selector.wants(T_map_camera)

    def add(self, camera: str, T_map_camera: FloatArray, image: DepthImage, picture: ByteArray | None = None) -> None:
        """Put a key frame into the field; ``picture`` (h, w[, 3]) uint8 of its camera, by default the amplitude."""
        self.add_keyframe(camera, T_map_camera, make_keyframe(image, self.config.keyframe, picture))

    def add_keyframe(self, camera: str, T_map_camera: FloatArray, keyframe: Keyframe) -> None:
        """Put a key frame that is made already into the field."""
        placed = PlacedKeyframe(camera, keyframe, T_map_camera)
        self._put(placed)
        if self._fixed:
            placed.keyframe = thinned(keyframe, RAY_STEP)
        self._placed.append(placed)
        del self._placed[:-_MOVABLE_KEYFRAMES]

    def move(self, lookup: PoseLookup, most: int | None = None) -> int:
        """Move key frames whose pose has changed, ``most`` at once (default ``moves_at_once``); returns how many."""
        changes = sorted(self._changes(lookup), key=lambda change: -change[0])
        chosen = changes[: _MOVES_AT_ONCE if most is None else most]
        for _, placed, T in chosen:
            k = placed.keyframe
            self.volume.remove(placed.T_map_camera, k.camera, k.depth, k.sigma)
            placed.T_map_camera = T
            self._put(placed)
        self.moved += len(chosen)
        return len(chosen)

    def surface(self) -> Surface:
        """Mesh of all key frames. Where poses are final it is made once: its field is forgotten."""
        return extract_surface(self.volume, release=self._fixed)

    def floor_plans(self, surface: Surface, gravity_up: FloatArray | None = None) -> tuple[FloorPlan, ...]:
        """Plans of all storeys, lowest first.

        ``surface``: that of :meth:`surface`. ``gravity_up`` (3,): specific force in the map frame, where it is known.
        """
        return floor_plans(surface, self._placed, self.config.floor_plan, gravity_up)

    def _put(self, placed: PlacedKeyframe) -> None:
        k = placed.keyframe
        self.volume.add(placed.T_map_camera, k.camera, k.depth, k.sigma, k.picture)

    def _changes(self, lookup: PoseLookup) -> Iterator[tuple[float, PlacedKeyframe, FloatArray]]:
        """Distances of key frames from where they belong, in units of what is tolerated."""
        tolerance = np.array([_MOVE_DISTANCE, np.radians(_MOVE_ANGLE_DEG)]) + 1e-9
        for placed in self._placed:
            T = lookup(placed.camera, placed.keyframe.stamp_ns)
            if T is None:
                continue
            moved = boxminus(T, placed.T_map_camera)
            size = max(np.linalg.norm(moved[:3]) / tolerance[0], np.linalg.norm(moved[3:]) / tolerance[1])
            if size > 1.0:
                yield float(size), placed, T
