"""``report.html``: one self-contained page with the figures and tables of a run."""

from __future__ import annotations

import base64
import io
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from matplotlib.figure import Figure

from slam_bringup.pipeline.results import RunResult
from slam_bringup.report.figures import error_figure, features_figure, floor_plan_figure, map_figure, timing_figure
from slam_core.files import atomic_text


def write_report(path: Path, result: RunResult, summary: dict[str, Any]) -> None:
    """Write the page; it needs no other file and no network."""
    template = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
        resources.files("slam_bringup.report").joinpath("report.html.j2").read_text(encoding="utf-8")
    )
    agents = [
        {
            "name": agent.name,
            "poses": len(agent.trajectory),
            "length": agent.trajectory.length_m,
            "evaluation": agent.evaluation(),
            "errors": _embedded(error_figure(agent)),
            "features": _embedded(features_figure(agent)) if len(agent.feature_counts) else None,
        }
        for agent in result.agents
    ]
    html = template.render(
        summary=summary,
        agents=agents,
        map=_embedded(map_figure(result)),
        timing=_embedded(timing_figure(result)),
        plans=[_embedded(floor_plan_figure(result, plan)) for plan in result.floor_plans],
    )
    atomic_text(path, html)


def _embedded(figure: Figure | None) -> str | None:
    if figure is None:
        return None
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
