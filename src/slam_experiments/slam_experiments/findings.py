# SPDX-License-Identifier: Apache-2.0
"""Findings of an experiment: comparisons with the thesis, tables, figures and an answer in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from slam_experiments.job import Job, JobResult
from slam_experiments.thesis import Claim
from slam_viewer.report.figures import save_png


@dataclass(frozen=True)
class Comparison:
    """One quantity beside the thesis's: both in short, the mark it must reach, and whether it does (None: no mark)."""

    quantity: str
    thesis: Claim | str
    ours: str
    mark: str = ""
    met: bool | None = None


@dataclass(frozen=True)
class Table:
    """A table of texts; the first column names the rows."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure with its number in the thesis and a caption."""

    figure: Figure
    number: str
    caption: str


@dataclass(frozen=True, eq=False)
class Findings:
    """Everything that an experiment reports. ``answer``: one paragraph."""

    comparisons: Sequence[Comparison] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    answer: str = ""


@dataclass(frozen=True)
class Experiment:
    """An experiment: what it needs (``jobs(quick)``, by name) and what follows from the results (``report``)."""

    name: str
    sections: str
    title: str
    jobs: Callable[[bool], Mapping[str, Job]] = field(repr=False)
    report: Callable[[Mapping[str, JobResult]], Findings] = field(repr=False)


def as_json(experiment: Experiment, findings: Findings, folder: Path, *, quick: bool) -> dict[str, Any]:
    """The findings as JSON knows them; the pictures are written to ``folder``. A quick run is held to no mark."""
    pictures = []
    for k, picture in enumerate(findings.pictures):
        file = f"{experiment.name}_{k + 1}.png"
        save_png(folder / file, picture.figure, dpi=110)
        pictures.append({"file": file, "number": picture.number, "caption": picture.caption})
    comparisons = [
        asdict(c)
        | {"thesis": str(c.thesis), "quote": c.thesis.quote if isinstance(c.thesis, Claim) else ""}
        | {"met": None if quick or c.met is None else bool(c.met)}  # NumPy's bool is none of JSON's
        for c in findings.comparisons
    ]
    return {
        "name": experiment.name,
        "sections": experiment.sections,
        "title": experiment.title,
        "quick": quick,
        "comparisons": comparisons,
        "tables": [asdict(table) for table in findings.tables],
        "pictures": pictures,
        "answer": findings.answer,
    }
