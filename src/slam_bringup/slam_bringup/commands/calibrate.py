# SPDX-License-Identifier: Apache-2.0
"""``slam calibrate``: camera_info files with uncertainties from pictures of a board."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

from slam_bags.reading.extrinsics import EXTRINSICS, URDF, extrinsics_text, extrinsics_urdf
from slam_bags.storage.bag_calibration import FILE_NAME
from slam_bringup.jobs.refine import refine, write_refined
from slam_bringup.terminal.console import progress_bar
from slam_bringup.terminal.paths import UserPath, overwrite_option
from slam_calibration.board import Board, parse_board
from slam_calibration.bundle import BundleResult
from slam_calibration.length_error import pair_error, parameter_file
from slam_calibration.lens import DISTORTION_PARAMETERS, parameter_names
from slam_calibration.pictures import BoardViews, find_views, pair_pictures
from slam_calibration.rectification import stereo_infos
from slam_calibration.report import (
    board_poses_figure,
    camera_deviations,
    extrinsics_of,
    residual_figure,
    summary,
    tables,
)
from slam_calibration.rig import calibrate
from slam_core.camera import CameraInfo
from slam_core.camera_info import CameraInfoFile, read_camera_info
from slam_core.geometry import FloatArray, both_halves, make_transform
from slam_core.storage.files import atomic_text
from slam_core.storage.output_folder import OutputFolder
from slam_viewer.report.figures import save_png

CAMERAS = {"mono": ("camera",), "stereo": ("left", "right"), "stereo-tof": ("left", "tof")}
FRAMES = {"left": "stereo_left_optical_frame", "right": "stereo_right_optical_frame", "tof": "tof_optical_frame"}


@click.command()
@click.argument("kind", type=click.Choice([*CAMERAS, "refine"]))
@click.argument("images", nargs=-1, required=True)
@click.option(
    "--board",
    "board_text",
    help="not for refine. chessboard:9x6:0.025 (inner corners, square in m), aprilgrid:6x6:0.088:0.3 (tags, edge in m, "
    "gap over edge) "
    "or charuco:11x8:0.03:0.022 (squares, square and marker in m)",
)
@click.option(
    "--model",
    default="plumb_bob",
    show_default=True,
    help=f"lens model, or one per camera with a comma between: {', '.join(DISTORTION_PARAMETERS)}",
)
@click.option(
    "--left-info",
    type=UserPath(exists=True, dir_okay=False),
    help="stereo-tof: left.yaml of the stereo calibration, so that the extrinsics are those of its rectified frame",
)
@click.option("-o", "--output", required=True, type=UserPath(file_okay=False), help="folder to write")
@overwrite_option("results of other images, or results that were changed since")
def command(
    kind: str,
    images: tuple[str, ...],
    board_text: str | None,
    model: str,
    left_info: Path | None,
    output: Path,
    overwrite: bool,
) -> None:
    """Calibrate one camera (mono), a stereo pair, or a stereo camera's left eye with a ToF camera (stereo-tof).

    IMAGES are files, folders or quoted patterns; for two cameras one folder or pattern each, or all files of the first
    followed by those of the second. With refine IMAGES is a bag: its stereo calibration is corrected by what its own
    pairs show, and the bend of a depth camera's depth, the readout of a rolling shutter and offsets of the clocks of
    the IMU and of the right camera are learnt, for --calibration or beside the bag.
    """
    if kind == "refine":
        _refine(images, output, overwrite)
        return
    if board_text is None:
        raise ValueError(f"calibrate {kind} needs --board, for instance --board chessboard:9x6:0.025")
    names, board = CAMERAS[kind], parse_board(board_text)
    lenses = _lenses(model, len(names))
    results = OutputFolder(output, "calibrate", f"{kind} {' '.join(images)}", overwrite=overwrite)
    files = pair_pictures([str(Path(image).expanduser()) for image in images], len(names))
    with results:
        views = _find(board, files)
        result = calibrate(board.points, views.corners, views.sizes, lenses)
        rectified_left = read_camera_info(left_info).info if left_info is not None else None
        with results.staged() as folder:
            _write(folder, kind, result, board, views, _infos(kind, result, rectified_left))
    click.echo(tables(result, names))
    click.echo(f"written to {output}")


def _refine(bags: tuple[str, ...], output: Path, overwrite: bool) -> None:
    if len(bags) != 1:
        raise ValueError(f"calibrate refine takes one bag, got {len(bags)}")
    results = OutputFolder(output, "calibrate", f"refine {bags[0]}", overwrite=overwrite)
    with results:
        bag = Path(bags[0]).expanduser()
        found = refine(bag)
        with results.staged() as folder:
            write_refined(folder, bag, found)
    click.echo(f"{found.description()}\nwritten to {output}")


def _lenses(model: str, cameras: int) -> list[str]:
    lenses = model.split(",")
    lenses = lenses * cameras if len(lenses) == 1 else lenses
    if len(lenses) != cameras:
        raise ValueError(f"--model names {len(lenses)} lens models for {cameras} cameras: '{model}'")
    for lens in lenses:
        parameter_names(lens)
    return lenses


def _find(board: Board, files: list[list[Path]]) -> BoardViews:
    with progress_bar() as bar:
        task = bar.add_task("finding the board", total=sum(len(view) for view in files))
        return find_views(board, files, lambda: bar.advance(task))


def _write(
    output: Path, kind: str, result: BundleResult, board: Board, views: BoardViews, infos: Sequence[CameraInfo]
) -> None:
    names = CAMERAS[kind]
    for c, (name, info) in enumerate(zip(names, infos, strict=True)):
        CameraInfoFile(info, name, camera_deviations(result, c)).write(output / f"{name}.yaml")
    if len(names) > 1:
        T, covariance = _extrinsics(result, infos)
        frames = FRAMES[names[0]], FRAMES[names[1]]
        atomic_text(output / EXTRINSICS, extrinsics_text(*frames, T, covariance))
        atomic_text(output / URDF, extrinsics_urdf(*frames, T))
    if kind == "stereo":
        error = pair_error(result.rig.cameras, result.covariance)
        atomic_text(output / FILE_NAME, parameter_file(error))
    save_png(output / "residuals.png", residual_figure(result, names))
    save_png(output / "board_poses.png", board_poses_figure(result, board.points, names))
    atomic_text(output / "report.md", f"# Calibration\n\n{tables(result, names)}\n{_picture_table(result, views)}")
    atomic_text(output / "summary.json", json.dumps(summary(result, names), indent=2) + "\n")


def _infos(kind: str, result: BundleResult, rectified_left: CameraInfo | None) -> Sequence[CameraInfo]:
    states = result.rig.cameras
    if kind == "stereo":
        return stereo_infos(states[0].camera, states[1].camera, states[1].T)
    infos = [CameraInfo(state.camera) for state in states]
    if rectified_left is not None:
        infos[0] = CameraInfo(infos[0].camera, rectified_left.R, rectified_left.P)
    return infos


def _extrinsics(result: BundleResult, infos: Sequence[CameraInfo]) -> tuple[FloatArray, FloatArray]:
    """Transform and covariance between the *rectified* optical frames, those that the nodes' images are in."""
    T, covariance = extrinsics_of(result, 1)
    rotate = both_halves(infos[0].R)
    T = make_transform(infos[0].R, np.zeros(3)) @ T @ make_transform(infos[1].R.T, np.zeros(3))
    return T, rotate @ covariance @ rotate.T


def _picture_table(result: BundleResult, views: BoardViews) -> str:
    lines = ["## Pictures", "", "| picture | corners found | used | rms [px] |", "|---|---|---|---|"]
    for files, found, used, residuals in zip(views.files, views.corners, result.views, result.residuals, strict=True):
        for path, f, k, r in zip(files, found, used, residuals, strict=True):
            rms = f"{np.sqrt(np.square(r).sum(axis=1).mean()):.3f}" if len(k) else "-"
            lines.append(f"| {path.name} | {len(f)} | {len(k)} | {rms} |")
    return "\n".join(lines) + "\n"
