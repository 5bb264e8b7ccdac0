# SPDX-License-Identifier: Apache-2.0
"""The last few keyframe scans as one cloud.

What a new scan is registered to, so that small errors do not add up scan by scan.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ndt_registration.clouds.cloud import Cloud, evened, finite_points, is_planar, thinned
from ndt_registration.clouds.visibility import range_image
from ndt_registration.methods.pyramid import Pyramid
from ndt_registration.registration import IMAGE_SIZE, RegistrationConfig, Target, check_cloud
from slam_core.geometry import FloatArray, invert_transform, transform_points
from slam_core.types import AnyArray

_MANY_POINTS = 160_000
"""Points of a scan beyond which some are left out at once: a few thousand are drawn of them anyway."""


def _fewer(points: AnyArray) -> AnyArray:
    """Every second, third, ... of many points (..., d), as (n, d); of a depth image these are columns."""
    stride = 1 + points.size // points.shape[-1] // _MANY_POINTS if points.ndim > 1 and points.size else 1
    return points.reshape(-1, points.shape[-1])[::stride] if stride > 1 else points


@dataclass(frozen=True, eq=False)
class ScanPoints:
    """Finite points (n, 3) m of a scan, and whether they came as (n, 2)."""

    points: FloatArray
    planar: bool

    @staticmethod
    def of(points: npt.ArrayLike) -> ScanPoints:
        """The scan of an array (..., 3) or (..., 2), NaN where invalid; of many points only some are taken."""
        return ScanPoints(finite_points(_fewer(np.asarray(points))), is_planar(points))

    @cached_property
    def _evened(self) -> FloatArray:
        return evened(self.points)

    def cloud(self, limit: int) -> Cloud:
        """At most ``limit`` of the points, made ready for registration; what is alike for all limits is done once."""
        return thinned(self._evened, limit, planar=self.planar)


@dataclass(frozen=True, eq=False)
class ScanKeyframe:
    """A scan, thinned, with its pose T_odom_sensor (4, 4) and covariance (6, 6)."""

    T: FloatArray
    covariance: FloatArray
    points: FloatArray
    rims: FloatArray


class KeyframeWindow:
    """A sliding window of keyframes, as a registration target in the frame of the newest."""

    def __init__(self, keyframes: int) -> None:
        self._keyframes: deque[ScanKeyframe] = deque(maxlen=keyframes)
        self._target: Target | None = None

    @property
    def newest(self) -> ScanKeyframe:
        """The keyframe whose frame the target is in."""
        return self._keyframes[-1]

    @property
    def target(self) -> Target | None:
        """Target of the next scan; None while there is no keyframe."""
        return self._target

    def clear(self) -> None:
        """Forget every keyframe."""
        self._keyframes.clear()
        self._target = None

    def add(self, T: FloatArray, covariance: FloatArray, scan: ScanPoints, config: RegistrationConfig) -> None:
        """Append a keyframe and rebuild the target."""
        check_cloud(scan.points, "target", config)
        cloud = scan.cloud(config.target_points)
        self._keyframes.append(ScanKeyframe(T, covariance, cloud.points, cloud.rims))
        self._target = self._build(cloud, config)

    def _build(self, scan: Cloud, config: RegistrationConfig) -> Target:
        T_newest_odom = invert_transform(self.newest.T)
        older = [transform_points(T_newest_odom @ k.T, k.points) for k in list(self._keyframes)[:-1]]
        older_rims = [transform_points(T_newest_odom @ k.T, k.rims) for k in list(self._keyframes)[:-1]]
        points, rims = np.concatenate([scan.points, *older]), np.concatenate([scan.rims, *older_rims])
        cloud = Cloud(np.ascontiguousarray(points), np.ascontiguousarray(rims), scan.scale, scan.planar)
        image = range_image(scan.points, IMAGE_SIZE)
        return Target(cloud, Pyramid.build(cloud, config.grid), image, np.zeros(3))
