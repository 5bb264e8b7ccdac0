# SPDX-License-Identifier: Apache-2.0
"""Paths as users write them, and options that name them in several commands."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click


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
