# SPDX-License-Identifier: Apache-2.0
"""End of a run on the terminal: one line where something went wrong, and the exit code."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from slam_bringup.processes.interrupt import INTERRUPTED

FAILED = 1
"""Exit code of a run that an error has ended; its results are written."""

DEGRADED = 3
"""Exit code of a run that lost too much (:mod:`slam_viewer.verdict`); its results are written."""


def end_run(summary: dict[str, Any], out: Path, *, stopped: bool) -> None:
    """Say what went wrong, also with ``-q``, and end with the exit code that tells it; return where all went well."""
    if summary["failure"]:
        click.echo(f"slam: {summary['failure']}; {out} holds what was mapped until then", err=True)
        sys.exit(FAILED)
    if summary["degraded"]:
        why = "; ".join(summary["degraded"])
        click.echo(f"slam: DEGRADED: {why}; {out} holds the results, slam doctor looks at the recording", err=True)
    if stopped:
        sys.exit(INTERRUPTED)
    if summary["degraded"]:
        sys.exit(DEGRADED)
