# SPDX-License-Identifier: Apache-2.0
"""How far do keypoints leave their surface points as the view changes? Tracks of simulated bags under the true poses.

    python benchmarks/ekf/keypoints.py BAG [BAG ...]

A landmark's sightings, as the filter associates them, are explained by one point, fitted under the true poses. For two
sightings the difference of their residuals, squared and in units of the variance that the features claim, is one on
average if the claim is true and the noise fresh in every image. Printed by the change of view between the two: the
angle between the lines of sight, together with 0.2 rad per unit of ln of the ratio of the distances.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.filtering.models import project, project_jacobian
from ekf_slam_node.slam import EkfSlam
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.sensor_pipeline import SensorPipeline
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.geometry import FloatArray, transform_points
from slam_core.types import Features

EDGES_DEG = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
SCALE_WEIGHT = 0.2
_SHORTEST = 4
_OUTLIER = 5.0


@dataclass(frozen=True, eq=False)
class Track:
    """Sightings of one landmark: residuals (n, 3) of u, v and inverse depth over their sigmas.

    Arms (n, 3) m from the point to the camera.
    """

    residuals: FloatArray
    arms: FloatArray


def tracks_of(bag: Path) -> list[Track]:
    """All landmarks of the filter that were seen often enough."""
    frames, poses, T_rig_optical = _frames(bag)
    slam, sightings = EkfSlam(EkfSlamConfig(), T_rig_optical), dict[int, list[tuple[int, int]]]()
    for k, features in enumerate(frames):
        result = slam.process(features)
        for landmark, feature in zip(result.landmark_ids, result.feature_index, strict=True):
            sightings.setdefault(int(landmark), []).append((k, int(feature)))
    cameras = poses @ T_rig_optical
    return [_track(frames, cameras, seen) for seen in sightings.values() if len(seen) >= _SHORTEST]


def _frames(path: Path) -> tuple[list[Features], FloatArray, FloatArray]:
    """Features, true poses (n, 4, 4) of the rig and the camera's mounting."""
    system = choose(load_system_config(None), "stereo", "sjsam", "none")
    with SensorBag(path) as bag:
        agent = bag.agents[0]
        pipeline, truth = SensorPipeline(system, bag.sensors[agent], False, StageTimes()), bag.ground_truth(agent)
        items = [pipeline.measure(item).value for reading in bag.readings() for item in pipeline.add(reading)]
        T_rig_optical = bag.sensors[agent].transform("base", "left")
    assert truth is not None, f"{path} holds no ground truth"
    frames = [value for value in items if isinstance(value, Features)]
    return frames, truth.interpolate(np.array([f.stamp_ns for f in frames])), T_rig_optical


def _track(frames: list[Features], cameras: FloatArray, seen: list[tuple[int, int]]) -> Track:
    """Gauss-Newton for the point, large residuals weighing less."""
    features = [frames[k].select(np.array([i])) for k, i in seen]
    T, camera = cameras[[k for k, _ in seen]], features[0].camera
    depth = np.array([float(f.depth[0]) for f in features])
    z = np.column_stack([[f.uv[0].astype(np.float64) for f in features], 1.0 / depth])
    sigma = np.column_stack([[f.sigma_uv[0] for f in features], [f.sigma_depth[0] for f in features] / depth**2])
    xyz = np.array([f.xyz[0] for f in features], np.float64)
    point = np.median([transform_points(pose, p[None])[0] for pose, p in zip(T, xyz, strict=True)], axis=0)
    R = T[:, :3, :3]
    for _ in range(6):
        optical = np.einsum("nji,nj->ni", R, point - T[:, :3, 3])
        residuals = (z - project(optical, camera)) / sigma
        J = project_jacobian(optical, camera) @ np.swapaxes(R, 1, 2) / sigma[:, :, None]
        weight = 1.0 / np.maximum(np.linalg.norm(residuals, axis=1) / 3.0, 1.0)
        normal = np.einsum("n,nki,nkj->ij", weight, J, J)
        point = point + np.linalg.solve(normal, np.einsum("n,nki,nk->i", weight, J, residuals))
    return Track(residuals, T[:, :3, 3] - point)


def pairs_of(track: Track) -> FloatArray:
    """Change of view (rad) and squared difference of the residuals, half of it, of u, v and inverse depth: (m, 4)."""
    good = (np.abs(track.residuals) < _OUTLIER).all(axis=1)
    arms, residuals = track.arms[good], track.residuals[good]
    a, b = np.triu_indices(len(arms), 1)
    sine, cosine = np.linalg.norm(np.cross(arms[a], arms[b]), axis=1), np.einsum("ni,ni->n", arms[a], arms[b])
    distance = np.linalg.norm(arms, axis=1)
    change = np.hypot(np.arctan2(sine, cosine), SCALE_WEIGHT * np.log(distance[a] / distance[b]))
    return np.column_stack([change, 0.5 * (residuals[a] - residuals[b]) ** 2])


def main() -> None:
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    print("squares in claimed variances, u and v | inverse depth, by change of view in degrees")
    for bag in map(Path, sys.argv[1:]):
        tracks = tracks_of(bag)
        # Every landmark counts alike, however long it was seen.
        parts = [pairs_of(track) for track in tracks]
        weights = np.concatenate([np.full(len(part), 1.0 / max(len(part), 1)) for part in parts])
        change, squares = np.split(np.concatenate(parts), [1], axis=1)
        which = np.digitize(np.degrees(change[:, 0]), EDGES_DEG) - 1
        cells = []
        for k in range(len(EDGES_DEG) - 1):
            inside = which == k
            if inside.sum() > 100:
                u, v, w = np.average(squares[inside], axis=0, weights=weights[inside])
                cells.append(f"{EDGES_DEG[k]:g}-{EDGES_DEG[k + 1]:g}: {0.5 * (u + v):.2f} | {w:.2f}")
        print(f"{bag.stem}, {len(tracks)} landmarks: " + "; ".join(cells), flush=True)


if __name__ == "__main__":
    main()
