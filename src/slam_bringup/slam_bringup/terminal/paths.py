# SPDX-License-Identifier: Apache-2.0
"""Paths as users write them, and options that name them in several commands."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from slam_bags.reading.rig_cameras import RigCameras
from slam_bags.reading.rig_file import read_rig_cameras

_RIG = "slam_bringup.rig"


class UserPath(click.Path):
    """A path with ``~`` for the home folder, also where the shell does not replace it (``--output=~/x``)."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options, path_type=Path)

    def convert(self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path, with the checks that the options ask for."""
        return super().convert(os.path.expanduser(value), param, ctx)


def overwrite_option(what: str) -> Any:
    """The flag ``--overwrite``; ``what`` says what it replaces."""
    return click.option("--overwrite", is_flag=True, help=f"replace {what}; what slam did not write always stays")


def calibration_option() -> Any:
    """The option ``--calibration``, which may be repeated."""
    return click.option(
        "--calibration", "calibrations", multiple=True, metavar="FOLDER", type=UserPath(exists=True, file_okay=False),
        help="cameras as slam calibrate wrote them into FOLDER, instead of their camera infos (may be repeated)",
    )  # fmt: skip


def _keep_rig(context: click.Context, _: click.Parameter, path: Path | None) -> None:
    if path is not None:
        context.meta[_RIG] = read_rig_cameras(path)


def rig_option() -> Any:
    """The option ``--rig``, which :func:`rig_cameras` gives."""
    return click.option(
        "--rig", type=UserPath(exists=True, dir_okay=False), expose_value=False, callback=_keep_rig, metavar="FILE",
        help="rig.yaml: cameras of one rig, by the topics of each (docs/several_cameras.md) [by the tree of frames]",
    )  # fmt: skip


def rig_cameras() -> RigCameras:
    """The cameras of the command line's ``--rig``; empty without."""
    given: RigCameras = click.get_current_context().meta.get(_RIG, RigCameras())
    return given
