# SPDX-License-Identifier: Apache-2.0
"""``report.html``: one self-contained page with the figures and tables of a run."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib.figure import Figure

from dense_mapping.plans.plan_io import plan_names
from slam_core.evaluation import Evaluation
from slam_core.storage.files import atomic_text
from slam_viewer.report.agent_figures import motion_figure, side_view, sigma_figure
from slam_viewer.report.figures import error_figure, features_figure, floor_plan_figure, png, timing_figure
from slam_viewer.report.scene3d import scene_page
from slam_viewer.report.structure_figures import sparsity_figure, submaps_figure
from slam_viewer.results import AgentResult, RunResult
from stereo_frontend.frame_log import LoggedFrame

_AGENT_CHARTS: dict[str, Callable[[AgentResult], Figure | None]] = {
    "errors": error_figure,
    "sigmas": sigma_figure,
    "motion": motion_figure,
    "features": features_figure,
}
_PICTURES = 6
_DISHONEST = 1.6
"""Factor between errors and claimed sigmas from which the report warns."""


@dataclass(frozen=True)
class Charts:
    """Charts as URLs, None where there is nothing to draw: of the map, and of each agent by name."""

    side: str | None
    submaps: str | None
    sparsity: str | None
    agents: list[dict[str, str | None]]


def draw_charts(result: RunResult) -> Charts:
    """The charts of a page, without the map's picture."""
    return Charts(
        _embedded(side_view(result)),
        _embedded(submaps_figure(result.map)),
        _embedded(sparsity_figure(result.map)),
        [{name: _embedded(figure(agent)) for name, figure in _AGENT_CHARTS.items()} for agent in result.agents],
    )


def write_report(path: Path, result: RunResult, summary: dict[str, Any], map_png: bytes, charts: Charts) -> None:
    """Write the page, with the map's picture as it is; it needs no other file and no network."""
    template = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
        resources.files("slam_viewer.report").joinpath("report.html.j2").read_text(encoding="utf-8")
    )
    agents = [
        {
            "name": agent.name,
            "poses": len(agent.trajectory),
            "length": agent.trajectory.length_m,
            "evaluation": agent.evaluation(),
            "verdict": verdict(agent.evaluation()),
            **drawn,
            "pictures": [_picture(frame, agent) for frame in _spread(agent.frames, _PICTURES)],
        }
        for agent, drawn in zip(result.agents, charts.agents, strict=True)
    ]
    html = template.render(
        summary=summary,
        agents=agents,
        map=_as_url(map_png),
        side=charts.side,
        scene=scene_page(result),
        submaps=charts.submaps,
        sparsity=charts.sparsity,
        timing=_embedded(timing_figure(result)),
        plans=[
            (name, _embedded(floor_plan_figure(result, plan)))
            for name, plan in zip(plan_names(len(result.floor_plans)), result.floor_plans, strict=True)
        ],
    )
    atomic_text(path, html)


def _spread(frames: Sequence[LoggedFrame], count: int) -> list[LoggedFrame]:
    """So many of the frames, evenly spread."""
    if not frames:
        return []
    return [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int)).tolist()]


def _picture(frame: LoggedFrame, agent: AgentResult) -> dict[str, str]:
    start = int(agent.filtered.stamps_ns[0]) if len(agent.filtered) else frame.stamp_ns
    seconds = (frame.stamp_ns - start) / 1e9
    return {"url": _as_url(frame.jpeg, "jpeg"), "caption": f"{seconds:.1f} s, {len(frame.features)} features"}


def verdict(evaluation: Evaluation | None) -> str:
    """Judgement of the claimed covariance by ANEES, in words; "" without it."""
    if evaluation is None or evaluation.anees is None:
        return ""
    factor = float(np.sqrt(evaluation.anees))
    if factor > _DISHONEST:
        return f"The errors are {factor:.1f} times what the covariance claims: do not rely on the claimed sigmas."
    if factor < 1.0 / _DISHONEST:
        return f"The errors are {1.0 / factor:.1f} times smaller than the covariance claims: it is too cautious."
    return "The errors are about as large as the covariance claims."


def _embedded(figure: Figure | None) -> str | None:
    if figure is None:
        return None
    return _as_url(png(figure, 150))


def _as_url(image: bytes, kind: str = "png") -> str:
    return f"data:image/{kind};base64," + base64.b64encode(image).decode("ascii")
