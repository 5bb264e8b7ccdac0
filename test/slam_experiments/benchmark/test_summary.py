# SPDX-License-Identifier: Apache-2.0
"""Median and worst over variants, and the rule by which a change is judged."""

from __future__ import annotations

import pytest

from slam_experiments.benchmark.summary import as_csv, as_markdown, compare, table


def row(recording: str, variant: str, ate_mm: float, program: str = "ours", **figures):
    figures = {"anees_with_truth_errors": 1.0, "sigma_over_ate": 1.0, "coverage": 1.0, "parts": 1} | figures
    return {
        "recording": recording, "variant": variant, "program": program, "run": "alone", "ate_mm": ate_mm, **figures,
    }  # fmt: skip


FAILED = {"recording": "hall", "variant": "c", "program": "ours", "run": "alone", "failed": "no frames"}


def test_median_and_worst():
    rows = [
        row("hall", v, ate, coverage=c, parts=p, ms_per_frame=ms)
        for v, ate, c, p, ms in (("a", 3, 1, 1, 40.2), ("b", 1, 0.5, 2, 90.0), ("c", 2, 1, 1, 30.0))
    ]
    assert table(rows) == [["hall", "ours, alone", "3", "2.0, 3.0", "1.00, 1.00", "1.00, 1.00", "50", "2", "40", ""]]


def test_a_failure_is_the_worst_and_is_counted():
    (line,) = table([row("hall", "a", 1.0), row("hall", "b", 2.0), FAILED])
    assert line[3] == "2.0, inf"
    assert line[-1] == "1"


def test_pages_and_sheets_have_every_case():
    rows = [row("hall", "a", 1.0), FAILED]
    assert as_csv(rows).splitlines()[2] == "hall,c,ours,alone,,,,,,,,,,,,no frames"
    assert as_markdown(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n"


@pytest.mark.parametrize(
    ("after", "holds", "verdicts"),
    [
        ((1.0, 1.0), True, ["same", "same"]),
        ((0.8, 1.09), True, ["better", "worse"]),
        ((0.95, 1.09), False, ["better", "worse"]),  # the mean gets worse
        ((0.5, 1.11), False, ["better", "WORSE than the rule allows"]),  # one gets worse by more than a tenth
    ],
)
def test_rule(after, holds, verdicts):
    before = [row("hall", "a", 1.0), row("attic", "a", 1.0)]
    comparison = compare(before, [row("hall", "a", after[0]), row("attic", "a", after[1])], "ours")
    assert comparison.is_accepted is holds
    assert [change.verdict for change in comparison.changes] == verdicts
    assert comparison.mean == pytest.approx((after[0] * after[1]) ** 0.5)
    assert ("holds" in comparison.conclusion) is holds


def test_only_variants_that_both_have_are_compared_and_only_of_the_program():
    before = [row("hall", "a", 2.0), row("hall", "b", 100.0), row("hall", "a", 1.0, "ORB-SLAM3")]
    after = [row("hall", "a", 1.0), row("hall", "c", 100.0), row("hall", "a", 9.0, "ORB-SLAM3")]
    (change,) = compare(before, after, "ours").changes
    assert (change.variants, change.ratio) == (1, 0.5)
    with pytest.raises(ValueError, match="nothing to compare"):
        compare(before, after, "others")


def test_what_fails_now_breaks_the_rule_and_what_failed_before_is_better():
    works = [row("hall", "c", 1.0)]
    assert not compare(works, [FAILED], "ours").is_accepted
    assert compare([FAILED], works, "ours").is_accepted
    assert compare([FAILED], [FAILED], "ours").changes[0].verdict == "same"
