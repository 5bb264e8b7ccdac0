# SPDX-License-Identifier: Apache-2.0
"""``slam join``: joins text submaps of the Linear SLAM format, 2D and 3D."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from sjsam_node.joint_problem.robust import LOSSES
from slam_bringup.terminal.console import progress_bar
from slam_bringup.terminal.paths import UserPath, overwrite_option
from slam_core.config import from_mapping
from slam_core.storage.files import atomic_text, read_yaml
from slam_core.storage.output_folder import OutputFolder
from slam_experiments.linear_slam.joined_map import draw_joined
from slam_experiments.linear_slam.text_joining import ROWS, TextJoiningConfig, TextJoiningResult, join_text_maps
from slam_experiments.linear_slam.text_maps import TextMap, find_maps, read_maps, write_covariances, write_values


@click.command("join")
@click.argument("folder", metavar="DIR", type=UserPath(exists=True, file_okay=False))
@click.option("-o", "--output", metavar="OUT", required=True, type=UserPath(file_okay=False))
@click.option(
    "--rows",
    type=click.Choice(ROWS),
    default=TextJoiningConfig().rows,
    show_default=True,
    help="joint: each submap's full information; block: each landmark alone (Algorithm 4)",
)
@click.option(
    "--robust", type=click.Choice(LOSSES), help="loss of what closes a loop: what the rest contradicts is left out"
)
@click.option(
    "--config",
    "config_file",
    metavar="FILE",
    type=UserPath(exists=True, dir_okay=False),
    help="YAML with parameters of the joining",
)
@overwrite_option("results of other submaps, or results that were changed since")
def command(
    folder: Path, output: Path, rows: str, robust: str | None, config_file: Path | None, overwrite: bool
) -> None:
    """Join the submaps localmap_<k>.txt in DIR.

    OUT gets summary.json, poses.txt, features.txt, their covariances (poses_covariance.txt, features_covariance.txt:
    the id, then the matrix row by row, in the frame of the first pose) and map.png.
    """
    values = {**_yaml(config_file), "rows": rows}
    try:
        config = from_mapping(TextJoiningConfig, values if robust is None else {**values, "robust.loss": robust})
    except ValueError as error:
        raise ValueError(f"{config_file}: {error}" if config_file else str(error)) from error
    results = OutputFolder(output, "join", folder, overwrite=overwrite)
    began = time.perf_counter()
    maps, dimension = read_maps(find_maps(folder))
    with results:
        with progress_bar() as bar:
            task = bar.add_task("joining", total=len(maps))
            result = join_text_maps(
                maps, dimension, config, lambda done, total: bar.update(task, completed=done, total=total)
            )
        summary = _summary(result, maps, dimension, rows, time.perf_counter() - began)
        with results.staged() as staged:
            _write(staged, result, summary)
    click.echo(json.dumps(summary))
    if not result.converged:
        click.echo(f"slam: not converged after {result.iterations} iterations: chi2 may not be the lowest", err=True)


def _yaml(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    values = read_yaml(path) or {}
    if not isinstance(values, dict):
        raise ValueError(f"{path}: expected a mapping of parameters, got {type(values).__name__}")
    return values


def _summary(
    result: TextJoiningResult, maps: Sequence[TextMap], dimension: int, rows: str, wall_s: float
) -> dict[str, Any]:
    return {
        "chi2": result.chi2, "degrees_of_freedom": _degrees_of_freedom(result, maps), "submaps": len(maps),
        "features": len(result.feature_ids), "wall_s": round(wall_s, 3),
        "poses": len(result.pose_ids), "dimension": dimension, "rows": rows, "chi2_chained_start": result.start_chi2,
        "start": result.start, "iterations": result.iterations, "converged": result.converged, "solver": result.solver,
        "dropped": result.dropped,
    }  # fmt: skip


def _degrees_of_freedom(result: TextJoiningResult, maps: Sequence[TextMap]) -> int | None:
    """Values of all submaps less the unknowns, the first pose being given; None where closures were left out."""
    if result.dropped:
        return None
    observed = sum(len(submap.information) for submap in maps)
    return int(observed - (result.poses.size - result.poses.shape[1] + result.features.size))


def _write(output: Path, result: TextJoiningResult, summary: dict[str, Any]) -> None:
    write_values(output / "poses.txt", result.pose_ids.tolist(), result.poses)
    write_covariances(output / "poses_covariance.txt", result.pose_ids.tolist(), result.pose_covariances)
    write_values(output / "features.txt", result.feature_ids.tolist(), result.features)
    write_covariances(output / "features_covariance.txt", result.feature_ids.tolist(), result.feature_covariances)
    draw_joined(output / "map.png", result)
    atomic_text(output / "summary.json", json.dumps(summary, indent=2) + "\n")
