"""Pairing by nearest stamp: order, tolerance, no waiting for ever, and the same pairs however streams interleave."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from slam_core.nearest_partner import NearestPartner

MS = 1_000_000


def run(events, **options):
    pairs = []
    pairing = NearestPartner(lambda stamp, a, b: pairs.append((stamp // MS, b)), **options)
    for kind, ms in events:
        (pairing.add_main if kind == "main" else pairing.add_partner)(ms * MS, ms)
    pairing.flush()
    return pairs, pairing


def test_the_nearest_partner_is_chosen_before_or_after():
    pairs, _ = run([("p", 0), ("main", 30), ("p", 40), ("main", 60), ("p", 90), ("main", 89)])
    assert pairs == [(30, 40), (60, 40), (89, 90)]


def test_partners_too_far_away_or_missing_give_none():
    pairs, pairing = run([("p", 0), ("main", 51), ("p", 300), ("main", 310)])
    assert pairs == [(51, None), (310, 300)]
    assert pairing.alone == 1


def test_a_silent_partner_does_not_hold_the_stream_up():
    pairs = []
    pairing = NearestPartner(lambda stamp, a, b: pairs.append(b), max_wait_ns=500 * MS)
    for ms in range(0, 1000, 100):
        pairing.add_main(ms * MS, ms)
    assert pairs == [None] * 4


@given(st.randoms(use_true_random=False), st.integers(1, 30), st.integers(1, 30))
def test_interleaving_does_not_matter(random, mains, partners):
    main = sorted(random.sample(range(400), mains))
    partner = sorted(random.sample(range(400), partners))
    results = []
    for _ in range(3):
        order = ["main"] * len(main) + ["p"] * len(partner)
        random.shuffle(order)
        streams = {"main": iter(main), "p": iter(partner)}
        results.append(run([(kind, next(streams[kind])) for kind in order])[0])
    assert results[0] == results[1] == results[2]
