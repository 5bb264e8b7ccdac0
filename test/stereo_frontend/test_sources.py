# SPDX-License-Identifier: Apache-2.0
"""Pairs from folders and side-by-side videos."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_frontend.sources import FolderSource, SideBySideSource, split_side_by_side


def write(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((20, 30), value, np.uint8))


@pytest.mark.parametrize(
    "names",
    [
        ("left/{}.png", "right/{}.png"),
        ("cam0/data/{}.png", "cam1/data/{}.png"),
        ("{}_0.png", "{}_1.png"),
        ("{}_left.jpg", "{}_right.jpg"),
    ],
)
def test_pairs_are_found_in_order_and_stamped_by_their_names(tmp_path, names):
    for k, stamp in enumerate((1403715273262142976, 1403715273312143104)):
        for name, value in zip(names, (10 + k, 100 + k), strict=True):
            write(tmp_path / name.format(stamp), value)
    pairs = list(FolderSource(tmp_path))
    assert [p.stamp_ns for p in pairs] == [1403715273262142976, 1403715273312143104]
    assert [(int(p.left[0, 0]), int(p.right[0, 0])) for p in pairs] == [(10, 100), (11, 101)]


def test_numbered_images_are_stamped_by_the_rate(tmp_path):
    for side in ("left", "right"):
        for k in range(3):
            write(tmp_path / side / f"{k:06d}.png", k)
    write(tmp_path / "left" / "000003.png", 9)
    assert [p.stamp_ns for p in FolderSource(tmp_path, rate=20.0)] == [0, 50_000_000, 100_000_000]


def test_a_folder_without_pairs_says_what_it_looked_for(tmp_path):
    write(tmp_path / "left" / "1.png", 1)
    with pytest.raises(ValueError, match="no stereo images"):
        FolderSource(tmp_path)


def test_a_side_by_side_frame_is_cut_in_the_middle():
    frame = np.zeros((10, 40, 3), np.uint8)
    frame[:, 20:] = 200
    pair = split_side_by_side(5, frame)
    assert pair.stamp_ns == 5
    assert pair.left.shape == pair.right.shape == (10, 20)
    assert pair.left.max() == 0
    assert pair.right.min() == 200
    frame[:, :20] = (20, 130, 240)
    np.testing.assert_array_equal(split_side_by_side(5, frame).colour(), np.full((10, 20, 3), (240, 130, 20), np.uint8))
    with pytest.raises(ValueError, match="even width"):
        split_side_by_side(0, frame[:, :39])


def test_a_side_by_side_video_gives_its_frames(tmp_path):
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 32))
    if not writer.isOpened():
        pytest.skip("this OpenCV cannot write a video")
    for value in (50, 150):
        writer.write(np.full((32, 64, 3), value, np.uint8))
    writer.release()
    source = SideBySideSource(str(path))
    pairs = list(source)
    source.close()
    assert [p.stamp_ns for p in pairs] == [0, 100_000_000]
    assert [round(float(p.right.mean()), -1) for p in pairs] == [50, 150]


def test_a_missing_camera_is_named():
    with pytest.raises(OSError, match="nothing_here"):
        SideBySideSource("/nothing_here.avi")
