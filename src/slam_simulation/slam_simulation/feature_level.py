# SPDX-License-Identifier: Apache-2.0
"""Features without images: landmarks on the surfaces of a scenario's building, observed with known association.

For Monte-Carlo runs of the estimators: the same building, path and cameras as the images, but the measurement of a
landmark is its true pixel and depth plus Gaussian noise of known size, and a landmark is seen where nothing stands
between.

    for frame in simulate_features(scenario):
        frame.ids, frame.features   # which landmark, and its (u, v, d) as the front end would give it
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, invert_transform, transform_points
from slam_core.types import Features, FeatureSource, Float32Array
from slam_simulation.scenario import Scenario
from slam_simulation.sensors.stereo_sensor import StereoSensor

DESCRIPTOR_SIZE = 128


@dataclass(frozen=True)
class FeatureLevelConfig(Config):
    """Landmarks and their measurement."""

    density: float = parameter(4.0, "landmarks per square metre of surface", unit="1/m2", minimum=0.001)
    sigma_px: float = parameter(0.5, "noise of u and v", unit="px", minimum=0.0)
    sigma_disparity: float = parameter(0.3, "noise of the disparity", unit="px", minimum=1e-6)
    detection: float = parameter(0.8, "share of the visible landmarks that a frame reports", minimum=0.0, maximum=1.0)
    max_features: int = parameter(150, "most features of one frame", minimum=1)
    min_depth: float = parameter(0.4, "nearest depth", unit="m", minimum=0.01)
    max_depth: float = parameter(8.0, "farthest depth", unit="m", minimum=0.1)
    descriptor_noise: float = parameter(0.03, "noise of each descriptor element; a unit vector has 128", minimum=0.0)


@dataclass(frozen=True, eq=False)
class FeatureFrame:
    """One frame: true pose, features in the rectified left camera and the landmark (row of the map) behind each."""

    stamp_ns: int
    T_world_rig: FloatArray
    ids: npt.NDArray[np.int64]
    features: Features


class FeatureSimulator:
    """Observes random landmarks along the path of one agent.

    Attributes
    ----------
    landmarks
        True positions, shape (n, 3) m, world frame.
    descriptors
        True descriptors, shape (n, 128), unit norm.
    """

    def __init__(
        self, scenario: Scenario, config: FeatureLevelConfig | None = None, agent: int = 0, seed: int = 0
    ) -> None:
        self.scenario, self.config, self.agent = scenario, config or FeatureLevelConfig(), agent
        self.seed = seed
        self.path = scenario.path(agent)
        sensor = StereoSensor(scenario.suite.stereo, rectified=True)
        self.stereo, self.T_rig_left = sensor.stereo, sensor.T_rig_raw[0]
        surfaces = scenario.world().surfaces
        self._frames = np.array([[s.origin, s.edge_u, s.edge_v] for s in surfaces])
        # Landmarks belong to the building: the same for every agent and every run.
        rng = np.random.default_rng([scenario.seed, 6])
        self.landmarks, self._owners = _scatter(self._frames, self.config.density, rng)
        self.descriptors = _unit(rng.standard_normal((len(self.landmarks), DESCRIPTOR_SIZE)))

    def run(self, frames: int | None = None) -> Iterator[FeatureFrame]:
        """The frames in order."""
        for k in range(min(frames or self.scenario.frames, self.scenario.frames)):
            yield self.frame(k)

    def frame(self, k: int) -> FeatureFrame:
        """Frame ``k``: the same whatever was asked for before."""
        rng = np.random.default_rng([self.scenario.seed, 7, self.seed, self.agent, k])
        T_world_rig = self.path.pose(k / self.scenario.rate)
        T_world_left = T_world_rig @ self.T_rig_left
        points = transform_points(invert_transform(T_world_left), self.landmarks)
        ids = self._visible(points, T_world_left[:3, 3])
        ids = ids[rng.random(len(ids)) < self.config.detection]
        ids = np.sort(rng.permutation(ids)[: self.config.max_features])
        stamp = round((self.scenario.suite.start_stamp_s + k / self.scenario.rate) * 1e9)
        return FeatureFrame(stamp, T_world_rig, ids, self._measure(stamp, points[ids], self.descriptors[ids], rng))

    def _visible(self, points: FloatArray, eye: FloatArray) -> npt.NDArray[np.int64]:
        """Landmarks within the image, the range of depth and sight."""
        c, camera = self.config, self.stereo.camera
        ahead = np.flatnonzero((points[:, 2] > c.min_depth) & (points[:, 2] < c.max_depth))
        pixels = camera.project(points[ahead])
        disparity = camera.fx * self.stereo.baseline / points[ahead, 2]
        inside = (pixels[:, 0] - disparity >= 0) & (pixels[:, 0] <= camera.width - 1)
        inside &= (pixels[:, 1] >= 0) & (pixels[:, 1] <= camera.height - 1)
        ids = ahead[inside].astype(np.int64)
        return np.asarray(ids[in_sight(eye, self.landmarks[ids], self._owners[ids], self._frames)], dtype=np.int64)

    def _measure(self, stamp: int, points: FloatArray, descriptors: FloatArray, rng: np.random.Generator) -> Features:
        """Noisy pixel and depth; the depth by a noisy disparity, as in a stereo pair (Eq. 4.4)."""
        c, camera, n = self.config, self.stereo.camera, len(points)
        fb = camera.fx * self.stereo.baseline
        uv = camera.project(points) + c.sigma_px * rng.standard_normal((n, 2))
        disparity = fb / points[:, 2] + c.sigma_disparity * rng.standard_normal(n)
        depth = fb / np.maximum(disparity, 1e-3)
        xyz = camera.unproject(uv, depth)
        noisy = _unit(descriptors + c.descriptor_noise * rng.standard_normal(descriptors.shape))
        return Features(
            stamp_ns=stamp,
            xyz=_single(xyz),
            uv=_single(uv),
            depth=_single(depth),
            sigma_uv=np.full((n, 2), c.sigma_px, np.float32),
            sigma_depth=_single(depth**2 / fb * c.sigma_disparity),
            response=np.ones(n, np.float32),
            source=np.full(n, int(FeatureSource.STEREO), np.uint8),
            descriptors=_single(noisy),
            camera=camera,
        )


def simulate_features(
    scenario: Scenario, config: FeatureLevelConfig | None = None, agent: int = 0, seed: int = 0
) -> Iterator[FeatureFrame]:
    """Frames of features with known association; ``seed`` draws other noise for the same building and path."""
    return FeatureSimulator(scenario, config, agent, seed).run()


def _single(array: FloatArray) -> Float32Array:
    return np.asarray(array, dtype=np.float32)


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _scatter(frames: FloatArray, density: float, rng: np.random.Generator) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Random points on all surfaces, shape (n, 3), and the surface of each."""
    area = np.linalg.norm(np.cross(frames[:, 1], frames[:, 2]), axis=1)
    owners = np.repeat(np.arange(len(frames)), rng.poisson(density * area))
    place = rng.random((len(owners), 2))
    points = frames[owners, 0] + place[:, :1] * frames[owners, 1] + place[:, 1:] * frames[owners, 2]
    return points, owners.astype(np.int64)


def in_sight(
    eye: FloatArray, points: FloatArray, owners: npt.NDArray[np.int64], frames: FloatArray
) -> npt.NDArray[np.bool_]:
    """Mask (n,) of the points that nothing hides from ``eye`` (3,).

    Each point (n, 3) lies on the front of its own surface ``owners`` (n,).

    ``frames``: (m, 3, 3) = origin, edge_u, edge_v of every surface.
    """
    clear = np.empty(len(points), np.bool_)
    _in_sight(eye, np.ascontiguousarray(points), owners, frames, clear)
    return clear


@njit(cache=True, nogil=True, error_model="numpy")
def _in_sight(
    eye: FloatArray,
    points: FloatArray,
    owners: npt.NDArray[np.int64],
    frames: FloatArray,
    clear: npt.NDArray[np.bool_],
) -> None:  # pragma: no cover - compiled
    m = frames.shape[0]
    planes = np.empty((m, 12))
    for q in range(m):
        u, v = frames[q, 1], frames[q, 2]
        planes[q, 0] = u[1] * v[2] - u[2] * v[1]
        planes[q, 1] = u[2] * v[0] - u[0] * v[2]
        planes[q, 2] = u[0] * v[1] - u[1] * v[0]
        uu, vv = u[0] * u[0] + u[1] * u[1] + u[2] * u[2], v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        for k in range(3):
            planes[q, 3 + k], planes[q, 6 + k] = u[k] / uu, v[k] / vv
            planes[q, 9 + k] = eye[k] - frames[q, 0, k]
    for i in range(points.shape[0]):
        dx, dy, dz = points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]
        o = owners[i]
        clear[i] = planes[o, 0] * dx + planes[o, 1] * dy + planes[o, 2] * dz < 0.0
        for q in range(m):
            if not clear[i]:
                break
            p = planes[q]
            along = p[0] * dx + p[1] * dy + p[2] * dz
            if q == o or abs(along) < 1e-12:
                continue
            t = -(p[0] * p[9] + p[1] * p[10] + p[2] * p[11]) / along
            if t <= 1e-6 or t >= 1.0 - 1e-6:
                continue
            hx, hy, hz = p[9] + t * dx, p[10] + t * dy, p[11] + t * dz
            u = p[3] * hx + p[4] * hy + p[5] * hz
            v = p[6] * hx + p[7] * hy + p[8] * hz
            if 0.0 <= u <= 1.0 and 0.0 <= v <= 1.0:
                clear[i] = False
