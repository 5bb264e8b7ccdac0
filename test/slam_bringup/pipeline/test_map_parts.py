# SPDX-License-Identifier: Apache-2.0
"""Parts of a map that nothing ties together are named by agent and submap."""

from __future__ import annotations

from slam_bringup.pipeline.map_parts import parts_in_words


def test_parts_are_named_by_their_submaps() -> None:
    one = [(0, "one", k) for k in (0, 1, 2, 5)]
    assert parts_in_words([*one, (0, "two", 3), (7, "three", 0), (7, "three", 1)]) == (
        "one 0-2, 5 with two 3; three 0-1"
    )
    assert parts_in_words([(3, "", 1), (0, "", 0)]) == "submaps 1; submaps 0"


def test_a_map_in_one_piece_has_no_parts() -> None:
    assert parts_in_words([(0, "one", 0), (0, "two", 0)]) == ""
    assert parts_in_words([]) == ""
