# SPDX-License-Identifier: Apache-2.0
"""The data types that cross package borders: shapes are checked where they are made."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.camera import Camera
from slam_core.types import Counters, DepthImage, Features, PoseEstimate, Submap


def make_submap(n: int = 4, **change: object) -> Submap:
    pose = PoseEstimate(0, np.eye(4), np.eye(6))
    values: dict[str, object] = {
        "agent": "", "index": 3, "start_stamp_ns": 0, "end_stamp_ns": 1, "end_pose": np.eye(4),
        "landmarks": np.zeros((n, 3)), "covariance": np.eye(6 + 3 * n), "landmark_ids": np.arange(n),
        "sightings": np.ones(n, dtype=np.int32), "descriptors": np.zeros((n, 128), dtype=np.float32), "path": (pose,),
    }  # fmt: skip
    return Submap(**{**values, **change})  # type: ignore[arg-type]


def test_submap_names_its_frame() -> None:
    assert make_submap().frame_id == "submap_3"
    assert make_submap(agent="alice").frame_id == "alice/submap_3"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("end_pose", np.eye(3)),
        ("covariance", np.eye(6)),
        ("landmark_ids", np.arange(3)),
        ("sightings", np.ones(5)),
        ("descriptors", np.zeros((3, 128))),
    ],
)
def test_submap_parts_must_fit_together(field: str, value: object) -> None:
    with pytest.raises(ValueError, match=field.removesuffix("s")):
        make_submap(**{field: value})


def test_depth_image_points_lie_on_the_pixels_rays(rng: np.random.Generator) -> None:
    camera = Camera(8, 6, 10.0, 11.0, 3.5, 2.0)
    depth = rng.uniform(1.0, 5.0, (6, 8)).astype(np.float32)
    depth[2, 3] = np.nan
    points = DepthImage(0, depth, depth, camera).points().reshape(-1, 3).astype(np.float64)
    assert np.isnan(points[2 * 8 + 3]).all()
    v, u = np.divmod(np.arange(48), 8)
    expected = np.column_stack([u, v]).astype(np.float64)
    expected[2 * 8 + 3] = np.nan
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-5)
    np.testing.assert_array_equal(points[:, 2], depth.ravel())


def test_selecting_features_keeps_every_column_in_step(rng: np.random.Generator) -> None:
    n = 7
    columns = {name: rng.normal(size=(n, k)).astype(np.float32) for name, k in (("xyz", 3), ("uv", 2), ("sigma_uv", 2))}
    singles = {name: rng.normal(size=n).astype(np.float32) for name in ("depth", "sigma_depth", "response")}
    features = Features(
        5,
        source=np.arange(n, dtype=np.uint8),
        descriptors=rng.normal(size=(n, 128)).astype(np.float32),
        camera=Camera(8, 6, 10.0, 11.0, 3.5, 2.0),
        **columns,
        **singles,
    )
    chosen = features.select(np.array([5, 2]))
    assert len(chosen) == 2
    for name in (*columns, *singles, "source", "descriptors"):
        np.testing.assert_array_equal(getattr(chosen, name), getattr(features, name)[[5, 2]], err_msg=name)
    assert (chosen.stamp_ns, chosen.frame_id) == (5, features.frame_id)


def test_counters_add_up() -> None:
    counters = Counters()
    counters.add("frames")
    counters.add("dropped", 3)
    counters.add("frames")
    assert counters.counts == {"frames": 2, "dropped": 3}
