# SPDX-License-Identifier: Apache-2.0
"""``slam register``: align two clouds and print one JSON object; with ``-o``, a picture before and after."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from ndt_registration.clouds.cloud import finite_points
from ndt_registration.clouds.cloud_io import read_cloud
from ndt_registration.registration import RegistrationConfig, RegistrationResult, register
from slam_bringup.terminal.paths import UserPath, overwrite_option
from slam_core.config import from_mapping
from slam_core.geometry import (
    FloatArray,
    make_transform,
    rotation_from_euler,
    so3_log,
    transform_from_pose7,
    transform_points,
)
from slam_core.storage.files import atomic_text, read_text, read_yaml
from slam_core.storage.output_folder import OutputFolder

NOT_REGISTERED = 1
"""Exit code where the clouds could not be registered; the result is printed and written all the same."""
PICTURE_POINTS = 8000
UNIT_RATIO = 20.0
"""Clouds whose extents differ by more are hardly in the same unit."""


@click.command()
@click.argument("source", type=UserPath(exists=True, dir_okay=False))
@click.argument("target", type=UserPath(exists=True, dir_okay=False))
@click.option("--method", type=click.Choice(["ndt", "icp", "icp_plane"]), default="ndt", show_default=True)
@click.option(
    "--initial-guess",
    help="T_target_source: x y z, x y z yaw pitch roll (m, deg), x y z qx qy qz qw, 16 numbers, or a file of them",
)
@click.option(
    "--config", "config_file", type=UserPath(exists=True, dir_okay=False), help="YAML with RegistrationConfig values"
)
@click.option("-o", "--output", type=UserPath(), help="folder for result.json and registration.png")
@click.option("--json", "as_json", is_flag=True, help="print JSON on a terminal as well")
@overwrite_option("results of other clouds, or results that were changed since")
def command(
    source: Path,
    target: Path,
    method: str,
    initial_guess: str | None,
    config_file: Path | None,
    output: Path | None,
    as_json: bool,
    overwrite: bool,
) -> None:
    """Align SOURCE to TARGET (pcd, ply, vtk; lines of numbers in csv, txt, xyz; a LaserScan's yaml).

    Clouds without z, or of one height only, are aligned in the plane: x, y and yaw.
    Prints a table on a terminal and one JSON object elsewhere. Ends with exit code 1 if the clouds were not registered.
    """
    values = read_yaml(config_file) or {} if config_file else {}
    config = from_mapping(RegistrationConfig, {**values, "method": method})
    source_points, target_points = _both_alike(_read(source), _read(target))
    guess = parse_guess(initial_guess) if initial_guess else None
    folder = _output_folder(output, source, target, overwrite)
    result = register(source_points, target_points, guess, config)
    text = json.dumps(result_as_json(result), indent=2)
    if as_json or not sys.stdout.isatty():
        click.echo(text)
    else:
        Console().print(result_table(result))
    if not result.converged:
        advice = next_step(source_points, target_points, config, guessed=guess is not None)
        click.echo(f"slam register: not registered: {result.reason}. {advice}", err=True)
    if folder is not None:
        with folder, folder.staged() as staged:
            atomic_text(staged / "result.json", text + "\n")
            draw_before_after(staged / "registration.png", source_points, target_points, result)
    if not result.converged:
        sys.exit(NOT_REGISTERED)


def _output_folder(output: Path | None, source: Path, target: Path, overwrite: bool) -> OutputFolder | None:
    if output is None:
        return None
    clouds = f"{source.resolve()} {target.resolve()}"
    return OutputFolder(output, "register", clouds, overwrite=overwrite, last="result.json")


def _read(path: Path) -> FloatArray:
    """Finite points (n, 3) of a file, (n, 2) where it has no z or but one."""
    points = read_cloud(path)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        raise ValueError(f"{path}: no finite points")
    is_flat = points.shape[1] == 3 and np.ptp(points[:, 2]) == 0.0
    return points[:, :2] if is_flat else points


def _both_alike(source: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    if source.shape[1] != target.shape[1]:
        raise ValueError("one cloud is in the plane and the other in space: give both with z, or both without")
    return source, target


def next_step(source: FloatArray, target: FloatArray, config: RegistrationConfig, *, guessed: bool) -> str:
    """Advice where two clouds (n, 3) could not be registered."""
    sizes = [float(np.ptp(cloud, axis=0).max()) for cloud in (source, target)]
    if max(sizes) > UNIT_RATIO * min(sizes):
        return f"The source spans {sizes[0]:.3g} m and the target {sizes[1]:.3g} m: are both in metres?"
    if guessed:
        return "Try without --initial-guess, or check that it takes the source's coordinates to the target's."
    reach, angle = config.search.max_translation, config.search.max_rotation_deg
    return (
        f"If you know the pose roughly, give --initial-guess; the search went as far as {reach:g} times the target's "
        f"median range and {angle:g} deg (search.max_translation and search.max_rotation_deg of --config)."
    )


def result_as_json(result: RegistrationResult) -> dict[str, object]:
    """The result as plain values."""
    return {
        "T_target_source": result.T_target_source.tolist(),
        "covariance": result.covariance.tolist(),
        "converged": result.converged,
        "iterations": result.iterations,
        "score": result.score,
        "overlap": result.overlap,
        "inlier_rmse": result.inlier_rmse,
        "degenerate": list(result.degenerate),
        "reason": result.reason,
    }


def result_table(result: RegistrationResult) -> Table:
    """The pose with its standard deviations, and how well the clouds agree."""
    table = Table(title="registered" if result.converged else f"not registered: {result.reason}")
    for heading in ("", "x", "y", "z"):
        table.add_column(heading, justify="left" if not heading else "right")
    deviations = np.sqrt(np.diag(result.covariance))
    angles = np.degrees(so3_log(result.T_target_source[:3, :3]))
    table.add_row("translation m", *(f"{v:.4f}" for v in result.T_target_source[:3, 3]))
    table.add_row("standard deviation m", *(f"{v:.4f}" for v in deviations[:3]))
    table.add_row("rotation vector deg", *(f"{v:.4f}" for v in angles))
    table.add_row("standard deviation deg", *(f"{v:.4f}" for v in np.degrees(deviations[3:])))
    table.add_row("overlap", f"{result.overlap:.0%}", "inlier rmse m", f"{result.inlier_rmse:.4f}")
    return table


def parse_guess(text: str) -> FloatArray:
    """T (4, 4) of the numbers in ``text``, or in the file of that name.

    Raises
    ------
    ValueError
        If there are not 3, 6, 7 or 16 finite numbers.
    """
    path = Path(text)
    content = read_text(path) if len(text) < 255 and path.is_file() else text
    try:
        values = np.array([float(word) for word in content.replace(",", " ").split()])
    except ValueError as error:
        raise ValueError(f"initial guess '{text}' is neither numbers nor a file of numbers") from error
    if not all(math.isfinite(v) for v in values):
        raise ValueError(f"initial guess '{text}' must be finite")
    if len(values) == 16:
        return values.reshape(4, 4)
    if len(values) == 7:
        return transform_from_pose7(values)
    if len(values) in (3, 6):
        angles = np.deg2rad(values[3:]) if len(values) == 6 else np.zeros(3)
        return make_transform(rotation_from_euler(*angles), values[:3])
    raise ValueError(f"initial guess must be 3, 6, 7 or 16 numbers, got {len(values)}")


def draw_before_after(path: Path, source: FloatArray, target: FloatArray, result: RegistrationResult) -> None:
    """Picture of both clouds as given and registered, along the two axes in which the target is widest."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    source, target = finite_points(source), finite_points(target)
    figure = Figure(figsize=(14, 7))
    FigureCanvasAgg(figure)
    axes = sorted(np.argsort(np.ptp(target, axis=0))[-2:])
    moved = transform_points(result.T_target_source, source)
    titles = ("before", f"after: {'converged' if result.converged else 'not converged'}")
    for k, (title, cloud) in enumerate(zip(titles, (source, moved), strict=True)):
        panel = figure.add_subplot(1, 2, k + 1, aspect="equal", title=title)
        for points, colour, name in ((target, "tab:blue", "target"), (cloud, "tab:red", "source")):
            shown = points[:: max(1, len(points) // PICTURE_POINTS)]
            panel.plot(shown[:, axes[0]], shown[:, axes[1]], ".", color=colour, markersize=1.0, label=name)
        panel.set_xlabel(f"{'xyz'[axes[0]]} [m]")
        panel.set_ylabel(f"{'xyz'[axes[1]]} [m]")
        panel.legend(markerscale=8)
    figure.tight_layout()
    figure.savefig(path, format="png", dpi=110)
