# SPDX-License-Identifier: Apache-2.0
"""Bounds that each scenario must keep, from ``bags/expected.yaml``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml

from slam_simulation.scenario import SCENARIOS

_KEYS = {"mode", "ate_mm", "end_mm", "anees", "lost"}


def expected() -> dict[str, dict[str, Any]]:
    """The bounds by scenario.

    Raises
    ------
    ValueError
        If the file names something that is no bound.
    OSError
        If the file is missing.
    """
    path = SCENARIOS.with_name("expected.yaml")
    bounds: dict[str, dict[str, Any]] = yaml.safe_load(path.read_text(encoding="utf-8"))
    for name, values in bounds.items():
        if set(values) != _KEYS:
            raise ValueError(f"{path}, {name}: expected the bounds {', '.join(sorted(_KEYS))}, found {list(values)}")
    return bounds


def violations(scenario: str, summary: Mapping[str, Any]) -> list[str]:
    """Values of a run's ``summary.json`` outside of the scenario's bounds, in words; empty if there are none."""
    bounds = expected()[scenario]
    agents = summary.get("agents") or {"": summary}
    lost = sum("LOST" in event for event in summary["events"])
    found = [] if lost <= bounds["lost"] else [f"lost {lost} times, at most {bounds['lost']}"]
    low, high = bounds["anees"]
    for name, agent in agents.items():
        for key, value in (("ate_mm", agent["ate_rmse_m"]), ("end_mm", agent["end_error_m"])):
            if not 1e3 * value <= bounds[key]:
                found.append(f"{name} {key} {1e3 * value:.1f}, at most {bounds[key]:g}".strip())
        if agent["anees"] is not None and not low <= agent["anees"] <= high:
            found.append(f"{name} ANEES {agent['anees']:.2f}, {low:g} to {high:g}".strip())
    return found
