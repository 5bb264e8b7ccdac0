"""Section 3.3 again: how repeatable are features of the ToF camera's amplitude, range and intensity images?

Frames of a simulated room 0.3 s apart: share of keypoints of the first that are found again within 2 px of their true
place in the second, and precision of mutual best matches. Only keypoints with a depth under them count: the others
cannot be used.
"""

from __future__ import annotations

import numpy as np
from truth import TrueFrame, simulated_frames

from slam_core.geometry import invert_transform, transform_points
from slam_core.types import DepthImage
from stereo_frontend.depth_lookup import DepthLookupConfig, sample_depth
from stereo_frontend.features import FeatureConfig, FeatureExtractor
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.tof_features import TofFeatureConfig, normalised_picture

KINDS = ("amplitude", "range", "intensity")


def picture(image: DepthImage, kind: str) -> np.ndarray:
    config = TofFeatureConfig()
    if kind == "range":
        return normalised_picture(image.depth, config.clip, 1.0)
    values = image.amplitude if kind == "amplitude" else image.intensity
    assert values is not None
    return normalised_picture(values, config.clip, config.gamma)


def keypoints_with_depth(extractor: FeatureExtractor, image: DepthImage, kind: str) -> tuple[Keypoints, np.ndarray]:
    keypoints = extractor(picture(image, kind))
    depth = sample_depth(image, keypoints.uv, DepthLookupConfig()).depth
    known = np.isfinite(depth)
    return keypoints.select(known), depth[known]


def place_in_next(first: TrueFrame, second: TrueFrame, keypoints: Keypoints, depth: np.ndarray) -> np.ndarray:
    assert first.depth is not None
    camera = first.depth.camera
    T_first, T_second = (f.T_world_left @ f.T_left_tof for f in (first, second))
    points = transform_points(invert_transform(T_second) @ T_first, camera.unproject(keypoints.uv, depth))
    pixels = camera.project(points)
    inside = np.all((pixels > 6) & (pixels < [camera.width - 7, camera.height - 7]), axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def compare(frames: list[TrueFrame], kind: str) -> None:
    extractor = FeatureExtractor(FeatureConfig(target=300))
    sets = [keypoints_with_depth(extractor, f.depth, kind) for f in frames if f.depth is not None]
    repeated, right, matched = [], 0, 0
    for k in range(len(frames) - 1):
        (a, depth), (b, _) = sets[k], sets[k + 1]
        moved = place_in_next(frames[k], frames[k + 1], a, depth)
        visible = np.isfinite(moved[:, 0])
        distance = np.linalg.norm(moved[:, None] - b.uv[None], axis=2)
        repeated.append((distance[visible].min(axis=1) < 2.0).mean())
        similarity = a.descriptors @ b.descriptors.T
        best = similarity.argmax(axis=1)
        mutual = (similarity.argmax(axis=0)[best] == np.arange(len(a))) & visible
        good = distance[np.arange(len(a)), best] < 2.0
        right, matched = right + (mutual & good).sum(), matched + mutual.sum()
    n = len(frames) - 1
    found = np.mean([len(s[0]) for s in sets])
    print(f"{kind:10s}{found:12.0f}{np.mean(repeated):14.3f}{right / n:15.0f}{right / matched:11.3f}")


def main() -> None:
    frames = list(simulated_frames("small_room", 20, 3))
    print(f"{'image':10s}{'with depth':>12s}{'repeatability':>14s}{'matched right':>15s}{'precision':>11s}")
    for kind in KINDS:
        compare(frames, kind)


if __name__ == "__main__":
    main()
