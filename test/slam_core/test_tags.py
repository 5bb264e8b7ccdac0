# SPDX-License-Identifier: Apache-2.0
"""Names of the corners of fiducial tags."""

from __future__ import annotations

import numpy as np

from slam_core.tags import LARGEST_TAG, corner_ids, is_tag_corner, square, whole_tags


def test_corners_say_their_tag_and_no_two_are_called_alike() -> None:
    ids = corner_ids([0, 7, 586])
    assert len(np.unique(ids)) == 12
    assert is_tag_corner(ids).all()
    assert not is_tag_corner(np.array([0, 1, 5])).any()
    assert list(whole_tags(ids)) == [0, 7, 586]


def test_a_tag_without_one_of_its_corners_is_left_out_and_corners_come_in_order() -> None:
    ids = np.concatenate([[4, 9], corner_ids([7])[::-1], corner_ids([3])[:3]])
    found = whole_tags(ids)
    assert list(found) == [7]
    np.testing.assert_array_equal(ids[found[7]], corner_ids([7]))


def test_the_largest_tag_passes_a_32_bit_float() -> None:
    ids = corner_ids([LARGEST_TAG - 1])
    np.testing.assert_array_equal(ids.astype(np.float32).astype(np.int64), ids)


def test_a_square_has_its_size_and_looks_along_z() -> None:
    corners = square(0.2)
    np.testing.assert_allclose(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1), 0.2)
    assert np.cross(corners[1] - corners[0], corners[3] - corners[0])[2] < 0.0  # clockwise, as one reads it
