# SPDX-License-Identifier: Apache-2.0
"""The radio link to an agent in words, and how far the agent may have walked since it was last heard."""

from __future__ import annotations

from slam_radio.wire.link_report import LinkReport
from slam_viewer.page.command_post import has_place, radius_text


def link_text(report: LinkReport) -> str:
    """State of the link and what waits at the agent, as it said last."""
    if report.heard_s_ago is None:
        return "link: not heard yet"
    state = "link: up" if report.is_up else f"link: silent for {report.heard_s_ago:.0f} s"
    backlog = report.backlog
    if backlog is None or not backlog.submaps:
        return state
    wait = "waits" if backlog.submaps == 1 else "wait"
    waits = f"{backlog.submaps} submap{'s' * (backlog.submaps > 1)} {wait}"
    before = "" if report.is_up else "before that "
    return f"{state}, {before}{waits}: {backlog.size / 1e3:.1f} kB, {backlog.seconds:.0f} s"


def link_warning(report: LinkReport) -> str:
    """Complaint that more comes in than the link carries, or ""."""
    backlog = report.backlog
    if backlog is None or not (report.is_up and backlog.is_too_much):
        return ""
    return f"more comes in ({backlog.came:.0f} bytes/s) than the link carries ({backlog.carried:.0f})"


def reach(radius: float, silent_s: float, walking_speed: float) -> float:
    """Radius (m) of the disc that holds an agent: that of its last pose, and what it may have walked in silence."""
    return radius + walking_speed * max(silent_s, 0.0)


def reach_text(radius: float, silent_s: float, walking_speed: float) -> str:
    """The disc in words: ``radius`` (m) of the last pose."""
    if not (silent_s > 0.0 and has_place(radius)):
        return radius_text(radius)
    return f"last {radius_text(radius)}, now within {reach(radius, silent_s, walking_speed):.0f} m of it if walking"
