# SPDX-License-Identifier: Apache-2.0
"""Submaps that come in another order than they were made, or not at all."""

from __future__ import annotations

from sjsam_node.session.submap_order import SubmapOrder, gap_text

A, B = ("a", 0), ("b", 7)


def test_what_comes_in_order_is_let_through_for_each_agent_and_session() -> None:
    order = SubmapOrder[str]()
    assert [order.add((*chain, k), f"{chain[0]}{k}") for k in range(2) for chain in (A, B)] == [
        ["a0"],
        ["b0"],
        ["a1"],
        ["b1"],
    ]
    assert order.add((*A, 0), "again") == ["again"]
    assert not order.missing()
    assert not order.should_ask(0.0)


def test_what_follows_a_gap_waits_until_the_gap_is_filled() -> None:
    order = SubmapOrder[str]()
    order.add((*A, 0), "a0")
    assert order.add((*A, 3), "a3") == order.add((*A, 4), "a4") == []
    assert order.missing() == {A: range(1, 3)}
    assert order.should_ask(10.0)
    assert not order.should_ask(11.0)  # once
    assert order.add((*A, 1), "a1") == ["a1"]
    assert order.overdue(11.0) == {}
    assert order.add((*A, 2), "a2") == ["a2", "a3", "a4"]
    assert not order.should_ask(12.0)
    assert order.overdue(100.0) == {}


def test_what_nobody_sends_is_given_up() -> None:
    order = SubmapOrder[str]([("a", 0, 2), ("a", 0, 1)])
    assert order.add((*A, 3), "a3") == ["a3"]  # follows what an earlier life had
    order.add((*A, 6), "a6")
    order.add((*B, 1), "b1")
    assert order.should_ask(0.0)
    assert order.overdue(60.0) == {A: range(4, 6), B: range(0, 1)}
    assert order.give_up() == ["a6", "b1"]
    assert order.add((*A, 7), "a7") == ["a7"]
    assert order.add((*A, 9), "a9") == []
    assert order.should_ask(61.0)  # another gap is asked for again
    assert "submaps 4 to 5 of agent 'a'" in gap_text("a", range(4, 6))
