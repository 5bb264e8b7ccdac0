# SPDX-License-Identifier: Apache-2.0
"""``experiments.html``: one self-contained page with every experiment's comparisons, tables and figures."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from slam_core.storage.files import atomic_text
from slam_experiments.answers import answers
from slam_experiments.catalogue import EXPERIMENTS

_PREAMBLE = """\
# Experiments

The thesis's experiments on simulated rooms of its sizes, with ground truth, beside the thesis's own figures. Made by
`slam experiment all -o OUT`, which writes this page as `OUT/experiments.md` with its figures in `OUT/experiments.html`;
do not edit. Times of frames and submaps are wall times with other work beside them, all others processor times.
"""


def write_page(path: Path, findings: Sequence[Mapping[str, Any]]) -> None:
    """Write the page; pictures lie beside it and are embedded, so that it needs no other file and no network."""
    template = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
        resources.files("slam_experiments").joinpath("experiments.html.j2").read_text(encoding="utf-8")
    )
    marks = [c["met"] for entry in findings for c in entry["comparisons"] if c["met"] is not None]
    html = template.render(
        experiments=[_with_pictures(entry, path.parent) for entry in findings],
        questions=answers({entry["name"]: entry for entry in findings}),
        met=sum(marks),
        marks=len(marks),
        quick=any(entry["quick"] for entry in findings),
    )
    atomic_text(path, html + "\n")


def write_markdown(path: Path, findings: Sequence[Mapping[str, Any]]) -> None:
    """The comparisons and tables as a page of the documentation."""
    lines = [_PREAMBLE, *_summary(findings)]
    for found in answers({entry["name"]: entry for entry in findings}):
        lines += [f"**{found['question']}** {found['answer']}", ""]
    for entry in findings:
        lines += [f"## {entry['title']} ({entry['sections']})", "", f"`slam experiment {entry['name']} -o OUT`", ""]
        lines += [entry["answer"], ""] if entry["answer"] else []
        met = {None: "", True: "met", False: "**not met**"}
        rows = [[c["quantity"], c["thesis"], c["ours"], c["mark"], met[c["met"]]] for c in entry["comparisons"]]
        lines += _markdown_table(("quantity", "thesis", "ours", "mark", ""), rows)
        for table in entry["tables"]:
            lines += [f"{table['title']}:", "", *_markdown_table(table["header"], table["rows"])]
    lines += _claims(findings)
    atomic_text(path, "\n".join(lines).rstrip() + "\n")


def _summary(findings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Number of the marks met, the names of the others, and the experiments that were not run."""
    marks = [(entry, c) for entry in findings for c in entry["comparisons"] if c["met"] is not None]
    missed = [f"{entry['name']}: {c['quantity']} ({c['ours']}, mark {c['mark']})" for entry, c in marks if not c["met"]]
    lines = []
    if marks:
        met = len(marks) - len(missed)
        lines += [
            f"{met} of {len(marks)} marks are met. Not met: {'; '.join(missed) or 'none'}. The marks are ours, and so"
            " are the rooms: scenarios of profile `ideal`, without much of what makes real recordings hard.",
            "",
        ]
    if absent := [name for name in EXPERIMENTS if name not in {entry["name"] for entry in findings}]:
        lines += [f"Not part of this run: {', '.join(absent)}.", ""]
    return lines


def _claims(findings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Every claim of the thesis with its words and what stands against it; sections stand behind the claims."""
    rows = [
        [c["thesis"], f'"{c["quote"]}"', c["quantity"], c["ours"], f"`slam experiment {entry['name']} -o OUT`"]
        for entry in findings
        for c in entry["comparisons"]
        if c["quote"]
    ]
    table = _markdown_table(("claim (section)", "quote", "quantity", "ours", "command"), rows)
    return ["## Claims of the thesis", "", *table] if rows else []


def _markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    cells = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |" for row in cells] + [""]


def _with_pictures(entry: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    pictures = []
    for picture in entry["pictures"]:
        data = base64.b64encode((folder / picture["file"]).read_bytes()).decode()
        pictures.append({**picture, "data": f"data:image/png;base64,{data}"})
    return {**entry, "pictures": pictures}
