"""The last few keyframe scans as one cloud: what a new scan is registered to, so that small errors do not add up scan
by scan.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from ndt_registration.cloud import Cloud, prepare
from ndt_registration.pyramid import Pyramid
from ndt_registration.registration import RegistrationConfig, Target, check_cloud
from ndt_registration.visibility import range_image
from slam_core.geometry import FloatArray, invert_transform, transform_points


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A scan, thinned, with its pose T_odom_sensor (4, 4) and covariance (6, 6)."""

    T: FloatArray
    covariance: FloatArray
    points: FloatArray
    rims: FloatArray


class LocalMap:
    """A sliding window of keyframes, as a registration target in the frame of the newest."""

    def __init__(self, keyframes: int, config: RegistrationConfig) -> None:
        self._config = config
        self._keyframes: deque[Keyframe] = deque(maxlen=keyframes)
        self._target: Target | None = None

    @property
    def newest(self) -> Keyframe:
        """The keyframe whose frame the target is in."""
        return self._keyframes[-1]

    @property
    def target(self) -> Target | None:
        """What scans are registered to; None while there is no keyframe."""
        return self._target

    def clear(self) -> None:
        """Forget every keyframe."""
        self._keyframes.clear()
        self._target = None

    def add(self, T: FloatArray, covariance: FloatArray, points: FloatArray) -> None:
        """Append a keyframe of finite points (n, 3) and rebuild the target."""
        check_cloud(points, "target", self._config)
        scan = prepare(points, self._config.target_points, planar=False, centre=np.zeros(3))
        self._keyframes.append(Keyframe(T, covariance, scan.points, scan.rims))
        self._target = self._build(scan)

    def _build(self, scan: Cloud) -> Target:
        T_newest_odom = invert_transform(self.newest.T)
        older = [transform_points(T_newest_odom @ k.T, k.points) for k in list(self._keyframes)[:-1]]
        older_rims = [transform_points(T_newest_odom @ k.T, k.rims) for k in list(self._keyframes)[:-1]]
        points, rims = np.concatenate([scan.points, *older]), np.concatenate([scan.rims, *older_rims])
        cloud = Cloud(np.ascontiguousarray(points), np.ascontiguousarray(rims), scan.scale, scan.planar)
        image = range_image(scan.points, self._config.image_size)
        return Target(cloud, Pyramid.build(cloud, self._config.grid), image, np.zeros(3))
