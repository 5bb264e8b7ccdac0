# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam_core.nodes.synchronizer import StampSynchronizer


def make(topics: tuple[str, ...] = ("a", "b"), **options: int) -> tuple[StampSynchronizer[str], list]:
    sets: list = []
    return StampSynchronizer[str](topics, lambda stamp, items: sets.append((stamp, items)), **options), sets


def test_a_set_is_complete_with_its_last_item() -> None:
    pairing, sets = make(("a", "b", "c"))
    for topic in "bca":
        assert sets == []
        pairing.add(topic, 5, f"{topic}5")
    assert sets == [(5, ("a5", "b5", "c5"))]
    assert pairing.unpaired == 0


def test_what_lost_its_partner_is_counted_once_the_next_set_is_complete() -> None:
    pairing, sets = make()
    for topic, stamp in (("a", 1), ("a", 2), ("b", 2), ("b", 3), ("a", 4), ("b", 4)):
        pairing.add(topic, stamp, f"{topic}{stamp}")
    assert [stamp for stamp, _ in sets] == [2, 4]
    assert pairing.unpaired == 2
    assert pairing.waiting == {"a": 0, "b": 0}


def test_exact_means_exact() -> None:
    pairing, sets = make()
    pairing.add("a", 100, "a")
    pairing.add("b", 101, "b")
    assert sets == []


def test_a_tolerance_takes_the_nearest_and_the_first_topics_stamp() -> None:
    pairing, sets = make(tolerance_ns=10)
    pairing.add("a", 100, "a100")
    pairing.add("a", 112, "a112")
    pairing.add("b", 109, "b109")
    assert sets == [(112, ("a112", "b109"))]
    assert pairing.unpaired == 1


def test_the_queue_is_bounded() -> None:
    pairing, _ = make(depth=3)
    for stamp in range(10):
        pairing.add("a", stamp, "")
    assert pairing.waiting["a"] == 3
    assert pairing.unpaired == 7


def test_clearing_counts_what_waited() -> None:
    pairing, _ = make()
    pairing.add("a", 1, "")
    pairing.clear()
    pairing.add("b", 1, "")
    assert pairing.unpaired == 1


@given(st.permutations([(topic, stamp) for topic in "abc" for stamp in range(6)]))
def test_any_interleaving_that_keeps_each_topics_order_gives_every_set(order: list[tuple[str, int]]) -> None:
    ordered = []
    nxt = dict.fromkeys("abc", 0)
    for topic, _ in order:
        ordered.append((topic, nxt[topic]))
        nxt[topic] += 1
    pairing, sets = make(("a", "b", "c"))
    for topic, stamp in ordered:
        pairing.add(topic, stamp, f"{topic}{stamp}")
    assert [stamp for stamp, _ in sets] == list(range(6))
    assert pairing.unpaired == 0


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="-1 ns"):
        make(tolerance_ns=-1)


def test_sets_of_a_clock_that_has_jumped_back_are_not_taken_for_leftovers() -> None:
    sets: list[int] = []
    pairs = StampSynchronizer[str](["a", "b"], lambda stamp, _: sets.append(stamp))
    for stamp in (1000, 10):
        pairs.add("a", stamp, "a")
    for stamp in (1000, 10):
        pairs.add("b", stamp, "b")
    assert (sets, pairs.unpaired) == ([1000, 10], 0)


def test_an_info_without_its_image_is_no_loss() -> None:
    sets: list[int] = []
    pairs = StampSynchronizer[str](["image", "info"], lambda stamp, _: sets.append(stamp), companions=["info"])
    for stamp in (1, 2, 3):
        pairs.add("info", stamp, "info")
    pairs.add("image", 3, "image")
    assert sets == [3]
    assert pairs.unpaired == 0
    pairs.add("image", 4, "image")
    pairs.add("image", 5, "image")
    pairs.add("info", 5, "info")
    assert pairs.unpaired == 1
