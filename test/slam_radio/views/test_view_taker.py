# SPDX-License-Identifier: Apache-2.0
"""Which images an agent keeps, where their camera was, and how many bytes of them stay."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.camera import Camera
from slam_core.geometry import boxplus, make_transform
from slam_core.trajectory import Trajectory
from slam_core.types import DepthImage
from slam_radio.views.places import moment_of
from slam_radio.views.view_config import ViewConfig
from slam_radio.views.view_files import ViewFiles
from slam_radio.views.view_format import DENSE, PICTURE, rgb_of
from slam_radio.views.view_taker import ViewTaker
from slam_radio.wire.view_messages import ViewKey

T_BASE_CAMERA = boxplus(np.eye(4), np.array([0.1, 0.05, 0.2, -1.2, 1.2, -1.2]))
CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)


def pose(x, yaw=0.0):
    return boxplus(np.eye(4), np.array([x, 0.0, 0.0, 0.0, 0.0, yaw]))


@pytest.fixture
def taker(tmp_path):
    return ViewTaker(ViewConfig(width=80, depth_pixels=5000), ViewFiles(tmp_path / "views", 1e6))


def picture(rng):
    return np.asarray(np.kron(rng.integers(0, 256, (12, 16, 3)), np.ones((10, 10, 1))), dtype=np.uint8)


def test_an_image_is_kept_every_so_much_way_or_turn(taker):
    assert not taker.wants(PICTURE)  # no pose yet
    taken = []
    small = np.zeros((12, 16, 3), dtype=np.uint8)
    for k in range(100):
        taker.set_pose(pose(0.02 * min(k, 50), np.radians(2.1) * max(k - 50, 0)))
        if taker.wants(PICTURE) and taker.wants(PICTURE):  # only one that is added counts
            taker.add_picture(k, T_BASE_CAMERA, small, None)
            taken.append(k)
    assert taken == [0, 25, 50, 60, 70, 80, 90]
    assert taker.wants(DENSE)  # each kind has its own


def test_images_are_kept_with_the_submap_in_which_they_were_taken(taker, make_submap, rng):
    submap = make_submap(5, index=3)  # from 6 to 8 s
    start = submap.start_stamp_ns
    image = picture(rng)
    for stamp in (start - 10**8, start + 5 * 10**8):
        taker.add_picture(stamp, T_BASE_CAMERA, image, CAMERA)
    depth = np.full((120, 160), 2.0, dtype=np.float32)
    depth[:, 80:] = 3.0
    sigma = np.full_like(depth, 0.01)
    sigma[0, :] = 0.5
    taker.add_depth(DepthImage(start + 10**9, depth, sigma, CAMERA), T_BASE_CAMERA, image)
    taker.add_picture(submap.end_stamp_ns + 10**8, T_BASE_CAMERA, image, CAMERA)
    assert not taker.files.sizes
    assert taker.end_submap(submap) == 2
    assert taker.dropped == 1
    keys = [ViewKey(PICTURE, 2, start + 5 * 10**8), ViewKey(DENSE, 2, start + 10**9)]
    assert sorted(taker.files.sizes) == keys
    shot, dense = (taker.files.read(key)[0] for key in keys)
    assert (shot.index, shot.start_stamp_ns, shot.size) == (3, start, (80, 60))
    halfway = Trajectory.from_estimates(submap.path).interpolate(np.array([start + 5 * 10**8]))[0]
    np.testing.assert_allclose(shot.T_start_camera, halfway @ T_BASE_CAMERA, atol=1e-6)
    np.testing.assert_allclose(shot.intrinsics, [75.0, 75.0, 39.5, 29.5])
    np.testing.assert_allclose(dense.intrinsics, [75.0, 75.0, 39.75, 29.75])
    np.testing.assert_allclose(dense.T_start_camera, submap.path[1].T @ T_BASE_CAMERA, atol=1e-6)
    assert dense.size == (80, 60)
    assert (dense.depth[0] == 0).all()
    assert (dense.depth[1:, :40] == dense.depth[1, 0]).all()
    assert dense.depth[1, 79] > dense.depth[1, 0] > 0
    assert np.abs(rgb_of(shot.jpeg)[2:8:5, 2::5].astype(int) - image[5:20:10, 5::10]).mean() < 25
    assert np.abs(rgb_of(dense.jpeg).astype(int).mean(axis=(0, 1)) - image.mean(axis=(0, 1))).max() < 4
    assert taker.end_submap(make_submap(5, index=4)) == 1


def test_images_of_a_clock_that_began_anew_are_dropped(taker, make_submap, rng):
    first, second = make_submap(5, index=3), make_submap(5, index=1)
    for submap in (first, second):
        taker.add_picture(submap.start_stamp_ns, T_BASE_CAMERA, picture(rng), None)
    assert taker.dropped == 1
    assert taker.end_submap(second) == 1
    assert taker.end_submap(first) == 0


def test_a_picture_is_made_small_enough_to_be_sent(tmp_path, make_submap):
    taker = ViewTaker(ViewConfig(width=2048, quality=95), ViewFiles(tmp_path / "views", 1e8))
    submap = make_submap(5, index=3)
    noise = np.random.default_rng(4).integers(0, 256, (2048, 2048, 3), dtype=np.uint8)
    taker.add_picture(submap.start_stamp_ns + 1, T_BASE_CAMERA, noise, None)
    taker.add_picture(submap.start_stamp_ns + 2, T_BASE_CAMERA, np.zeros((5000, 320, 3), dtype=np.uint8), None)
    assert taker.end_submap(submap) == 2
    sizes = [taker.files.read(key)[0].size for key in sorted(taker.files.sizes)]
    assert sizes == [(2048, 2048), (80, 1250)]


def test_an_image_that_cannot_be_kept_is_told_and_costs_no_other(taker, make_submap, rng):
    submap = make_submap(5, index=3)
    taker.add_picture(submap.start_stamp_ns + 1, T_BASE_CAMERA, np.zeros((5000, 1, 3), dtype=np.uint8), None)
    stamps = [submap.start_stamp_ns + k * 10**8 for k in (1, 2)]
    for stamp in stamps:
        taker.add_picture(stamp, T_BASE_CAMERA, picture(rng), None)
    (taker.files.path / f"{PICTURE}-2-{stamps[0]}.view").write_bytes(b"another")
    assert taker.end_submap(submap) == 1
    assert [text.rpartition(" ")[2] for text in taker.unkept] == ["be", "away"]
    assert list(taker.files.sizes) == [ViewKey(PICTURE, 2, stamps[1])]
    assert taker.end_submap(make_submap(5, index=4)) == 0
    assert taker.unkept == []


def test_the_oldest_go_when_there_are_too_many_bytes(tmp_path):
    files = ViewFiles(tmp_path / "views", 1000.0)
    for k in range(5):
        files.add(ViewKey(PICTURE, 1, 10 - k), bytes(300))
    assert sorted(k.stamp_ns for k in files.sizes) == [8, 9, 10]  # 6 and 7 are older than what is there
    files.add(ViewKey(DENSE, 2, 1), bytes(300))
    assert [(k.session, k.stamp_ns) for k in sorted(files.sizes)] == [(1, 9), (1, 10), (2, 1)]
    assert len(list((tmp_path / "views").glob("*.view"))) == 3


def test_bytes_are_counted_as_views_come_and_go(tmp_path):
    rng = np.random.default_rng(8)
    files = ViewFiles(tmp_path / "views", 3000.0)
    for k in range(150):
        key = ViewKey(int(rng.integers(1, 3)), int(rng.integers(1, 3)), int(rng.integers(1, 30)))
        choice = rng.integers(4)
        if key in files.sizes and choice == 0:
            files.remove(key)
        elif key in files.sizes and choice == 1 and files.strangers < 2:
            files.set_aside(key)
        elif key in files.sizes or not (files.path / f"{key.kind}-{key.session}-{key.stamp_ns}.view").exists():
            before = set(files.sizes)
            files.add(key, bytes(int(rng.integers(100, 400))))
            gone = before - set(files.sizes)
            assert all((g.session, g.stamp_ns) <= (s.session, s.stamp_ns) for g in gone for s in files.sizes)
        on_disk = sum(file.stat().st_size for file in files.path.iterdir())
        assert on_disk == files.bytes <= 3000, k
    assert files.strangers == 2
    files.close()
    assert ViewFiles(files.path, 3000.0).bytes == on_disk


def test_a_view_is_added_without_going_through_all_others(tmp_path):
    class Unlisted(dict):
        def __iter__(self):
            raise AssertionError("all are listed")

        values = items = keys = __iter__

    files = ViewFiles(tmp_path / "views", 1000.0)
    files.sizes = Unlisted()
    for k in range(5):
        files.add(ViewKey(PICTURE, 1, k), bytes(300))
    assert len(files.sizes) == 3


def test_files_of_another_version_stay_and_count(tmp_path):
    folder = tmp_path / "views"
    folder.mkdir()
    (folder / "1-1-5.view").write_bytes(b"SV\x00" + bytes(900))
    (folder / "notes.txt").write_text("mine")
    files = ViewFiles(folder, 1000.0)
    assert (files.strangers, files.sizes) == (1, {})
    with pytest.raises(ValueError, match="move it away"):
        files.add(ViewKey(PICTURE, 1, 5), b"x")
    files.add(ViewKey(PICTURE, 1, 6), bytes(200))
    assert files.sizes == {}
    assert (folder / "1-1-5.view").exists()
    files.close()
    assert ViewFiles(folder, 1000.0).strangers == 1


def test_the_nearest_image_of_a_kind_and_session_is_taken(tmp_path):
    files = ViewFiles(tmp_path / "views", 1e6)
    for key in (ViewKey(1, 1, 100), ViewKey(1, 1, 200), ViewKey(2, 1, 140), ViewKey(1, 2, 141)):
        files.add(key, b"x")
    assert files.nearest(ViewKey(1, 1, 140), 50) == (1, 1, 100)
    assert files.nearest(ViewKey(1, 1, 160), 50) == (1, 1, 200)
    assert files.nearest(ViewKey(1, 1, 260), 50) is None
    assert files.nearest(ViewKey(1, 3, 140), 50) is None


def test_a_place_is_shown_by_the_nearest_pose_that_looked_at_it():
    def walk(poses):
        return Trajectory(np.arange(1, len(poses) + 1) * 10**9, np.stack(poses))

    turned = make_transform(pose(0.0, np.pi)[:3, :3], [3.0, 0.0, 0.0])
    paths = {"anna": walk([pose(0.0), pose(1.0), pose(2.8)]), "bert": walk([turned, pose(30.0)])}
    assert moment_of(paths, np.array([3.0, 0.2, 0.0])) == ("anna", 2 * 10**9)  # the third is too close
    assert moment_of(paths, np.array([2.5, 0.0, 0.1])) == ("bert", 10**9)
    assert moment_of(paths, np.array([1.0, 3.0, 0.0])) == ("anna", 2 * 10**9)  # nobody looked: the nearest
    with pytest.raises(ValueError, match="no agent has a path"):
        moment_of({}, np.zeros(3))
    with pytest.raises(ValueError, match="cannot be"):
        moment_of(paths, np.array([np.nan, 0.0, 0.0]))
