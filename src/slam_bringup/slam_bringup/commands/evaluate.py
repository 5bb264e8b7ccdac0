# SPDX-License-Identifier: Apache-2.0
"""``slam evaluate``: ATE, RPE and NEES of a trajectory against ground truth."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from slam_bringup.terminal.paths import UserPath, overwrite_option
from slam_core.estimation.body_frame import describe
from slam_core.evaluation import ALIGNMENTS, ErrorStatistics, Evaluation, TruthAccuracy, evaluate
from slam_core.geometry import FloatArray
from slam_core.storage.output_file import OutputFile
from slam_core.trajectory import Trajectory, read_covariance_csv, read_trajectory


@click.command()
@click.argument("estimate", type=UserPath(exists=True, dir_okay=False))
@click.argument("ground_truth", type=UserPath(exists=True, dir_okay=False))
@click.option(
    "--align", "alignment", type=click.Choice(ALIGNMENTS), default="se3", show_default=True, help="frame alignment"
)
@click.option(
    "--delta", type=click.IntRange(1), default=1, show_default=True, help="frames between the poses of the RPE"
)
@click.option("--max-difference", default=0.01, show_default=True, help="largest difference of stamps [s]")
@click.option("--interpolate", is_flag=True, help="interpolate ground truth between its poses")
@click.option(
    "--covariance",
    type=UserPath(exists=True, dir_okay=False),
    help="covariances of the estimate; found by itself beside a trajectory.tum",
)
@click.option(
    "--truth-sigma",
    nargs=2,
    type=click.FloatRange(0.0),
    default=(0.0, 0.0),
    show_default=True,
    metavar="M DEG",
    help="standard deviations of ground truth, position [m] and orientation [deg] per axis, for the NEES",
)
@click.option("--align-body", is_flag=True, help="take a constant difference of the two body frames off the truth")
@click.option("-o", "--output", type=UserPath(dir_okay=False), help="write the figures as JSON")
@overwrite_option("figures of other trajectories")
def command(
    estimate: Path,
    ground_truth: Path,
    alignment: str,
    delta: int,
    max_difference: float,
    interpolate: bool,
    covariance: Path | None,
    truth_sigma: tuple[float, float],
    align_body: bool,
    output: Path | None,
    overwrite: bool,
) -> None:
    """ATE, RPE and NEES of the trajectory ESTIMATE against GROUND_TRUTH (TUM, KITTI or EuRoC files)."""
    trajectories = f"{estimate.resolve()} {ground_truth.resolve()}"
    file = OutputFile(output, "evaluate", trajectories, overwrite=overwrite) if output is not None else None
    result = evaluate(
        _with_covariances(
            read_trajectory(estimate), covariance or estimate.with_name(f"{estimate.stem}_covariance.csv")
        ),
        read_trajectory(ground_truth),
        alignment=alignment,
        delta=delta,
        max_difference_s=max_difference,
        interpolate=interpolate,
        accuracy=TruthAccuracy(truth_sigma[0], float(np.radians(truth_sigma[1]))),
        align_body=align_body,
    )
    Console().print(evaluation_table(result))
    if result.body_offset is not None:
        click.echo(_body_note(np.array(result.body_offset), align_body))
    if file is not None:
        file.write(asdict(result))


def _body_note(T_estimate_truth: FloatArray, aligned: bool) -> str:
    difference = f"ground truth is of another body frame: {describe(T_estimate_truth)} from the estimate's"
    return f"{difference}, taken off" if aligned else f"{difference}; try --align-body"


def _with_covariances(trajectory: Trajectory, path: Path) -> Trajectory:
    if not path.is_file():
        return trajectory
    stamps, covariances = read_covariance_csv(path)
    if not np.array_equal(stamps, trajectory.stamps_ns):
        raise ValueError(f"{path} does not have the stamps of the trajectory")
    return Trajectory(trajectory.stamps_ns, trajectory.poses, covariances)


def evaluation_table(result: Evaluation) -> Table:
    """The figures as a table for the console."""
    table = Table(title=f"{result.ate.count} poses over {result.truth_length_m:.2f} m")
    for heading in ("error", "rmse", "mean", "median", "max"):
        table.add_column(heading, justify="left" if heading == "error" else "right")
    rows: list[tuple[str, ErrorStatistics]] = [
        ("ATE m", result.ate),
        ("ATE deg", result.ate_rotation_deg),
        ("RPE m", result.rpe),
        ("RPE deg", result.rpe_rotation_deg),
    ]
    for name, s in rows:
        table.add_row(name, *(f"{v:.5f}" for v in (s.rmse, s.mean, s.median, s.max)))
    table.add_row("end error m", f"{result.end_error_m:.5f}", "", "", f"{result.drift_percent:.2f} %")
    if result.anees is not None:
        table.add_row(
            "ANEES", f"{result.anees:.2f}", "", "", f"95 % in {result.anees_low:.2f}..{result.anees_high:.2f}"
        )
    return table
