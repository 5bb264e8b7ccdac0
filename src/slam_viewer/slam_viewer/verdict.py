# SPDX-License-Identifier: Apache-2.0
"""Judges a finished run by what was lost: a run that lost most of its way must not look like one that succeeded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from slam_core.config import Config, parameter
from slam_core.nodes.stamp_guard import StampFault


@dataclass(frozen=True)
class RunConfig(Config):
    """Limits beyond which a run is DEGRADED (exit code 3)."""

    max_lost_share: float = parameter(
        0.5, "a run is DEGRADED if an agent was lost in more than this share of its frames", minimum=0.0, maximum=1.0
    )
    max_unused_share: float = parameter(
        0.7, "... if more than this share of the messages was not used, not counting those sent twice",
        minimum=0.0, maximum=1.0,
    )  # fmt: skip
    min_located_share: float = parameter(
        0.1, "... if an agent was located (--localize-only) in less than this share of its frames",
        minimum=0.0, maximum=1.0,
    )  # fmt: skip


def faults_of_run(summary: Mapping[str, Any], limits: RunConfig) -> list[str]:
    """Reasons that make the run of a ``summary.json`` DEGRADED, in words; empty if nothing does."""
    faults = [
        f"{_named(agent)}lost in {share:.0%} of the frames (run.max_lost_share: {limits.max_lost_share:.0%})"
        for agent, share in summary["lost_share"].items()
        if share > limits.max_lost_share
    ]
    dropped = {why: n for why, n in summary["dropped_by_reason"].items() if StampFault.DUPLICATE.value not in why}
    number = sum(dropped.values())
    unused = number / max(number + summary["frames"], 1)
    if unused > limits.max_unused_share:
        most = max(dropped, key=lambda why: dropped[why])
        limit = f"run.max_unused_share: {limits.max_unused_share:.0%}"
        faults.append(f"{unused:.0%} of the messages not used ({limit}), most for this: {most}")
    faults += [
        f"{_named(agent)}located in {part['located_share']:.0%} of the frames "
        f"(run.min_located_share: {limits.min_located_share:.0%})"
        for agent, part in summary.get("localization", {}).items()
        if part["located_share"] < limits.min_located_share
    ]
    return faults


def _named(agent: str) -> str:
    return f"agent {agent} " if agent else ""
