# SPDX-License-Identifier: Apache-2.0
"""Results of all cases, summed up over the variants, and two of them compared."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Row = Mapping[str, Any]
"""A case: recording, variant, program, run, and its figures, or ``failed``."""

MOST_WORSE = 1.10
"""Ratio of median errors up to which a recording may get worse."""
_LARGEST_RATIO = 10.0
_CASE = ("recording", "variant", "program", "run")
_COLUMNS = (
    *_CASE, "ate_mm", "end_mm", "scale_percent", "sigma_over_ate", "anees",
    "anees_with_truth_errors", "frames", "coverage", "lost", "parts", "ms_per_frame", "failed",
)  # fmt: skip
HEADINGS = (
    "recording", "program", "variants", "ATE mm", "ANEES", "sigma / ATE", "poses %", "parts", "CPU ms", "failed",
)  # fmt: skip
"""Of the table: median and worst over the variants; of processor time per frame the median."""


def table(rows: Sequence[Row]) -> list[list[str]]:
    """Cells under :data:`HEADINGS`, a line for each program on each recording."""
    return [_line(key, group) for key, group in _groups(rows).items()]


def _groups(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        program = f"{row['program']}, {row['run']}" if row["run"] else row["program"]
        groups.setdefault((row["recording"], program), []).append(row)
    return groups


def _line(key: tuple[str, str], rows: Sequence[Row]) -> list[str]:
    failed = sum("failed" in row for row in rows)
    coverage = [100.0 * row.get("coverage", 0.0) for row in rows]
    parts = [row["parts"] for row in rows if "parts" in row]
    ms = _known(rows, "ms_per_frame")
    return [
        *key,
        str(len(rows)),
        _median_and_worst([_ate(row) for row in rows], 1, max),
        _median_and_worst(_known(rows, "anees_with_truth_errors"), 2, max),
        _median_and_worst(_known(rows, "sigma_over_ate"), 2, min),
        f"{min(coverage):.0f}",
        str(max(parts)) if parts else "",
        f"{_median(ms):.0f}" if ms else "",
        str(failed) if failed else "",
    ]


def _known(rows: Sequence[Row], name: str) -> list[float]:
    return [row[name] for row in rows if row.get(name) is not None]


def _ate(row: Row) -> float:
    return float("inf") if "failed" in row else float(row["ate_mm"])


def _median_and_worst(values: list[float], digits: int, worst: Any) -> str:
    if not values:
        return ""
    text = f"{_median(values):.{digits}f}"
    return text if len(values) == 1 else f"{text}, {worst(values):.{digits}f}"


def _median(values: Sequence[float]) -> float:
    """Median; of an even number the mean of the two in the middle, infinite if one of them is."""
    ordered = sorted(values)
    return float(0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]))


def as_markdown(headings: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table as pages have it."""
    rows = [headings, ["---"] * len(headings), *lines]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def as_csv(rows: Sequence[Row]) -> str:
    """Every case on a line."""
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


# ---- before and after
@dataclass(frozen=True)
class Change:
    """Median error of one recording and program before and after, over the variants that both have."""

    recording: str
    program: str
    variants: int
    before_mm: float
    after_mm: float

    @property
    def ratio(self) -> float:
        """After over before, between a tenth and ten; a failure counts as an infinite error."""
        if self.after_mm == self.before_mm:
            return 1.0
        if np.isinf(self.after_mm) or self.before_mm <= 0.0:
            return _LARGEST_RATIO
        return float(np.clip(self.after_mm / self.before_mm, 1.0 / _LARGEST_RATIO, _LARGEST_RATIO))

    @property
    def verdict(self) -> str:
        """Verdict in a word or two."""
        if self.ratio > MOST_WORSE:
            return "WORSE than the rule allows"
        return "same" if self.ratio == 1.0 else "worse" if self.ratio > 1.0 else "better"


@dataclass(frozen=True)
class BeforeAndAfter:
    """All changes of our own program."""

    changes: tuple[Change, ...]

    @property
    def mean(self) -> float:
        """Geometric mean of the ratios."""
        return float(np.exp(np.mean([np.log(change.ratio) for change in self.changes])))

    @property
    def is_accepted(self) -> bool:
        """True if the mean gets better, or nothing changes, and no recording gets worse by more than a tenth."""
        is_same = all(change.ratio == 1.0 for change in self.changes)
        return (self.mean < 1.0 or is_same) and all(change.ratio <= MOST_WORSE for change in self.changes)

    @property
    def conclusion(self) -> str:
        """Conclusion in a line."""
        rule = f"mean below 1 and no recording above {MOST_WORSE:.2f}"
        verdict = "holds" if self.is_accepted else "is BROKEN"
        return f"geometric mean of the ratios {self.mean:.3f}: the rule ({rule}) {verdict}"

    @property
    def lines(self) -> list[list[str]]:
        """Cells under :data:`CHANGE_HEADINGS`."""
        return [
            [
                change.recording, change.program, str(change.variants), f"{change.before_mm:.1f}",
                f"{change.after_mm:.1f}", f"{change.ratio:.3f}", change.verdict,
            ]
            for change in self.changes
        ]  # fmt: skip


CHANGE_HEADINGS = ("recording", "program", "variants", "median ATE mm before", "after", "ratio", "verdict")


def compare(before: Sequence[Row], after: Sequence[Row], program: str) -> BeforeAndAfter:
    """Two results of a program on the cases that both have.

    Raises
    ------
    ValueError
        If they have none in common.
    """
    known = {_name(row): row for row in before if row["program"] == program}
    pairs = in_common(before, after, program)
    changes = []
    for (recording, name), group in _groups(pairs).items():
        old = [_ate(known[_name(row)]) for row in group]
        changes.append(Change(recording, name, len(group), _median(old), _median([_ate(row) for row in group])))
    return BeforeAndAfter(tuple(changes))


def in_common(before: Sequence[Row], after: Sequence[Row], program: str) -> list[Row]:
    """Rows of ``after``, of a program, whose case is in ``before``; neither needs figures. ValueError if none is."""
    known = {_name(row) for row in before if row["program"] == program}
    pairs = [row for row in after if row["program"] == program and _name(row) in known]
    if not pairs:
        raise ValueError("the two results have no recording and variant in common: nothing to compare")
    return pairs


def is_row(value: Any) -> bool:
    """True for a case as ``benchmark.json`` has it: named, and with an error of its trajectory or why there is none."""
    if not isinstance(value, dict) or not all(isinstance(value.get(name), str) for name in _CASE):
        return False
    ate = value.get("ate_mm")
    return "failed" in value or (isinstance(ate, int | float) and not isinstance(ate, bool))


def _name(row: Row) -> tuple[str, str, str]:
    return row["recording"], row["variant"], row["run"]
