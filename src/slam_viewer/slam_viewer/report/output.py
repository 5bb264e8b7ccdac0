# SPDX-License-Identifier: Apache-2.0
"""The files of a run, the same for ``slam run`` and ``slam nodes``.

``summary.json``, ``trajectory.tum`` (map frame, rig poses), ``trajectory_covariance.csv``, ``landmarks.ply``,
``map.ply`` (dense points), ``mesh.ply`` and ``mesh.glb``, ``floor_plan.yaml`` and ``.pgm`` (Nav2), ``map/`` (loadable
map), ``map.png``, ``report.html``, ``result.mcap`` and ``foxglove_layout.json``. With several agents each has its
own ``trajectory_<agent>.tum``; ``trajectory.tum`` is then the first one's.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.plans.plan_io import plan_names, write_plan
from dense_mapping.reconstruction.surface_io import write_glb, write_mesh, write_points
from slam_core.runtime.memory import leave_libraries, trim_heap
from slam_core.runtime.process_life import command_line, seconds_since_start
from slam_core.storage.files import atomic_text
from slam_core.version import VERSION
from slam_viewer.report.figures import map_figure, save_png
from slam_viewer.report.foxglove import write_layout
from slam_viewer.report.mapped_files import SaveMap, write_mapped
from slam_viewer.report.report import Charts, draw_charts, write_report
from slam_viewer.results import RunResult, summarise


def write_results(
    out: Path,
    result: RunResult,
    save_map: SaveMap | None = None,
    *,
    pictures: bool = True,
    charts: Charts | None = None,
    is_mapped: bool = False,
) -> dict[str, Any]:
    """Write all files of a run into the folder ``out`` (made if absent) and return the summary.

    ``save_map`` is called with the path of ``map/``, before all else. Drawing takes most of the time: without
    ``pictures`` there is no ``map.png`` and no ``report.html``. ``summary.json`` comes last, so that a folder that has
    one is complete. Made before, if so: ``charts`` by :func:`~slam_viewer.report.report.draw_charts`, and
    (``is_mapped``) the files of :func:`~slam_viewer.report.mapped_files.write_mapped`.
    """
    if not is_mapped:
        write_mapped(out, result, save_map)
    (out / "summary.json").unlink(missing_ok=True)
    trim_heap()
    leave_libraries()  # what has drawn; the GLB takes 70 MB for a moment
    write_points(out / "map.ply", result.dense)
    write_mesh(out / "mesh.ply", result.dense)
    write_glb(out / "mesh.glb", result.dense)
    _write_plans(out, result.floor_plans)
    if (out / "result.mcap").is_file():
        write_layout(out / "foxglove_layout.json", out / "result.mcap")
    summary = summarise(result) | _made()
    if pictures:
        save_png(out / "map.png", map_figure(result), dpi=170)
        map_png = (out / "map.png").read_bytes()  # drawn once: it is the dearest of the figures
        write_report(out / "report.html", result, summary | _in_all(result), map_png, charts or draw_charts(result))
    summary |= _in_all(result)
    atomic_text(out / "summary.json", json.dumps(summary, indent=2) + "\n")
    return summary


def _made() -> dict[str, str]:
    """By what, how and when the results were made."""
    return {"version": VERSION, "command": command_line(), "date": time.strftime("%Y-%m-%d %H:%M:%S %z")}


def _in_all(result: RunResult) -> dict[str, float]:
    """The time that the user waits: from the start of the program until now, dense model and files included."""
    total_s = seconds_since_start()
    return {"total_s": total_s, "total_real_time_factor": result.sensor_s / total_s}


def _write_plans(out: Path, plans: tuple[FloorPlan, ...]) -> None:
    """A ``.yaml`` and its image of each storey."""
    for name, plan in zip(plan_names(len(plans)), plans, strict=True):
        write_plan(out / name, plan)
