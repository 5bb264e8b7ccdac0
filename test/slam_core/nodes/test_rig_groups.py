# SPDX-License-Identifier: Apache-2.0
"""Groups of what the cameras of a rig give: by stamps alone, whatever arrives first, and without one that is silent."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import pytest

from slam_core.nodes.rig_groups import RigGroups

MS = 1_000_000


@dataclass(frozen=True)
class Item:
    stamp_ns: int


def groups_of(rig: RigGroups[Item]) -> list[list[tuple[int, int]]]:
    """Cameras and stamps in ms."""
    return [[(number, item.stamp_ns // MS) for number, item in group] for group in rig.ready()]


@pytest.mark.parametrize("order", itertools.permutations([("a", 100), ("b", 102), ("a", 200), ("b", 201)]))
def test_the_order_of_arrival_changes_nothing(order: tuple[tuple[str, int], ...]) -> None:
    rig = RigGroups[Item](["a", "b"])
    taken = [rig.add(camera, Item(stamp * MS)) for camera, stamp in order]
    sound = all(order.index((c, 100 if c == "a" else 102)) < order.index((c, 200 if c == "a" else 201)) for c in "ab")
    assert all(taken) == sound
    if sound:
        assert groups_of(rig) == [[(0, 100), (1, 102)], [(0, 200), (1, 201)]]


def test_a_camera_of_another_rate_has_groups_of_its_own() -> None:
    rig = RigGroups[Item](["a", "b"])
    for stamp in (0, 100, 200):
        rig.add("a", Item(stamp * MS))
    for stamp in (1, 50, 101, 150, 220):
        rig.add("b", Item(stamp * MS))
    assert groups_of(rig) == [[(0, 0), (1, 1)], [(1, 50)], [(0, 100), (1, 101)], [(1, 150)], [(0, 200)]]
    assert rig.oldest_waiting_ns == 220 * MS
    assert rig.diagnostic == ""


def test_a_camera_without_the_common_trigger_is_left_out_until_the_others_are_gone() -> None:
    rig = RigGroups[Item](["a", "b"], patience=3)
    for stamp in (0, 100, 200):
        rig.add("a", Item(stamp * MS))
        rig.add("b", Item((stamp + 40) * MS))
    assert groups_of(rig) == [[(0, 0)], [(0, 100)], [(0, 200)]]
    assert rig.left_out == 2
    assert rig.diagnostic == "camera b has no common trigger with the others, it is not used"
    for stamp in range(340, 840, 100):
        rig.add("b", Item(stamp * MS))
    assert groups_of(rig)[-1] == [(1, 740)]
    assert rig.diagnostic.startswith("no camera a since 0.200 s")


@pytest.mark.parametrize("ahead", [500, 2000, 2033, -400, -2000])
def test_a_camera_with_another_clock_throws_no_other_out(ahead: int) -> None:
    rig, used, dead = RigGroups[Item](["a", "b", "c"], patience=4), 0, 0
    for stamp in range(0, 6000, 100):
        rig.add("a", Item(stamp * MS))
        rig.add("b", Item((stamp + ahead) * MS)) if stamp + ahead >= 0 else None
        rig.add("c", Item((stamp + 1) * MS)) if stamp < 3000 else None
        for group in groups_of(rig):
            used += group[0][0] == 0
            dead += (2, group[0][1] + 1) in group
        assert sum(map(len, rig._queues.values())) < 25
    rig.give_up()
    used += sum(group[0][0] == 0 for group in rig.ready())
    assert used == 60
    assert dead == 30


def test_a_camera_that_dies_holds_up_a_few_frames_and_comes_back() -> None:
    rig = RigGroups[Item](["a", "b"], patience=3)
    rig.add("a", Item(0))
    rig.add("b", Item(0))
    assert len(groups_of(rig)) == 1
    assert rig.diagnostic == ""
    for stamp in (100, 200, 300):
        rig.add("a", Item(stamp * MS))
    assert groups_of(rig) == []
    rig.add("a", Item(400 * MS))
    assert len(groups_of(rig)) == 4
    assert rig.diagnostic == "no camera b since 0.000 s"
    assert not rig.add("b", Item(300 * MS))  # its frame is over
    rig.add("b", Item(500 * MS))
    rig.add("a", Item(500 * MS))
    assert groups_of(rig) == [[(0, 500), (1, 500)]]
    assert rig.diagnostic == ""


def test_a_camera_that_never_came_is_told_and_not_waited_for() -> None:
    rig = RigGroups[Item](["a", "b"])
    rig.add("a", Item(0))
    assert groups_of(rig) == []
    rig.give_up()
    assert groups_of(rig) == [[(0, 0)]]
    assert rig.diagnostic == "no camera b so far"


def test_names_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="different names"):
        RigGroups[Item](["a", "a"])
    with pytest.raises(ValueError, match="at most 8"):
        RigGroups[Item]([str(k) for k in range(9)])
    with pytest.raises(ValueError, match="no camera 'c'"):
        RigGroups[Item](["a", "b"]).add("c", Item(0))
