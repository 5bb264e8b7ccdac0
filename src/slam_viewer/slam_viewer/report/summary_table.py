# SPDX-License-Identifier: Apache-2.0
"""The table that a run ends with on the console."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from rich.table import Table

from slam_core.plural import plural
from slam_viewer.results import STOPPED

_SHOWN_EVENTS = 8


def summary_table(summary: dict[str, Any], out: Path) -> Table:
    """The figures of ``summary.json`` that a person wants to see first, and where the rest is."""
    table = Table(title=f"{summary['bag']} ({summary['mode']}, {summary['mapper']})", show_header=False)
    table.add_column(style="bold")
    table.add_column()
    for name, sensors in summary["sensors"].items():
        if sensors:
            table.add_row(f"sensors {name}".strip(), ", ".join(sensors))
    if summary["degraded"]:
        table.add_row("state", "\n".join([summary["state"], *summary["degraded"]]))
    table.add_row("frames", f"{summary['frames']}, {_lost(summary)}")
    for reason, count in summary["dropped_by_reason"].items():
        table.add_row("dropped", f"{count} x {reason}")
    table.add_row("path", f"{summary['path_length_m']:.2f} m")
    submaps = plural(summary["submaps"], "submap")
    if "localization" in summary:
        table.add_row("recognised", f"{summary['loop_closures']} of {submaps} in the map, which stays as it is")
        for name, part in summary["localization"].items():
            table.add_row(f"located {name}".strip(), _located(part))
    else:
        table.add_row("map", f"{plural(summary['landmarks'], 'landmark')}, {submaps}")
    if "features_from" in summary and summary["mode"] == "tof":
        table.add_row("features from", f"{summary['features_from']} images")
    if "localization" not in summary:
        table.add_row("loop closures", str(summary["loop_closures"]))
    for name, part in summary.get("agents", {"": summary}).items():
        table.add_row(f"accuracy {name}".strip(), _accuracy(part))
    if "scan_odometry" in summary:
        table.add_row("scan odometry", _accuracy(summary["scan_odometry"]))
    table.add_row(
        "time",
        f"{summary['sensor_s']:.1f} s of recording mapped in {summary['wall_s']:.1f} s "
        f"({summary['real_time_factor']:.1f} x real time); {summary['total_s']:.1f} s from start to end",
    )
    stages = [f"{name} {s['median']:.1f}" for name, s in summary["stage_ms"].items() if s and s["median"] >= 0.05]
    table.add_row("ms per step", ", ".join(stages))
    if summary["events"]:
        more = len(summary["events"]) - _SHOWN_EVENTS
        table.add_row("events", "\n".join(summary["events"][:_SHOWN_EVENTS] + [f"and {more} more"] * (more > 0)))
    table.add_row("results", str(out))
    report = "" if STOPPED in summary["events"] else "report.html in a browser, "
    table.add_row("to look at", f"slam view {shlex.quote(str(out))}; {report}result.mcap in Foxglove")
    return table


def _located(part: dict[str, float | None]) -> str:
    if part["first_located_s"] is None:
        return "never"
    return f"in {part['located_share']:.0%} of the frames, first after {part['first_located_s']:.1f} s"


def _lost(summary: dict[str, Any]) -> str:
    """The share of what came that was not used, and of the frames at which an agent was lost."""
    dropped = summary["dropped"]
    unused = f"{dropped / max(dropped + summary['frames'], 1):.0%} of the messages not used" if dropped else ""
    lost = [
        f"{name} lost {share:.0%} of the frames".strip() for name, share in summary["lost_share"].items() if share > 0.0
    ]
    return ", ".join(filter(None, [unused, *lost])) or "none dropped"


def _accuracy(part: dict[str, Any]) -> str:
    if "ate_rmse_m" not in part:
        return "no ground truth"
    anees = f", ANEES {part['anees']:.1f} (honest: 1)" if part.get("anees") is not None else ""
    # Poses of an IMU or a marker, say: slam evaluate takes the difference off.
    other = "; truth is of another body frame: slam evaluate --align-body" if part.get("body_offset") else ""
    return (
        f"ATE {part['ate_rmse_m'] * 1000:.1f} mm, end error {part['end_error_m'] * 1000:.1f} mm "
        f"({part['drift_percent']:.2f} %){anees}{other}"
    )
