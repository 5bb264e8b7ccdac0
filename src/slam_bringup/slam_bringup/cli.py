# SPDX-License-Identifier: Apache-2.0
"""The ``slam`` command line: a table of names; a command is loaded when it is called, so ``slam --help`` is instant."""

from __future__ import annotations

import gc
import importlib
import sys
from difflib import get_close_matches
from typing import Any

import click

import slam_core.runtime.process_life  # noqa: F401  # its clock starts with the program
from slam_bringup.extras import advice_for
from slam_bringup.registered_commands import registered_commands
from slam_bringup.terminal.console import log_to_terminal, with_verbosity
from slam_core.runtime.blas_threads import use_one_blas_thread
from slam_core.runtime.memory import search_less_garbage, share_one_heap
from slam_core.version import VERSION

# Before NumPy and SciPy are loaded, and for the programs that are started from here.
use_one_blas_thread()

COMMANDS = {
    "run": "offline pipeline: a bag to a map and a trajectory",
    "merge": "finished maps, and bags, of any agents and days to one map",
    "nodes": "the same through the real ROS nodes: starts them, plays the bag, records",
    "demo": "the demo: the real nodes, in one process, on the bag that comes with the program",
    "live": "map live: all nodes in one process, on a camera or on topics",
    "post": "a command post: joins what agents send over a radio link",
    "convert": "a public data set (EuRoC, KITTI, RGB-D) to a bag",
    "anchor": "a finished map in the frame of its building, by points on the floor plan",
    "view": "show a finished run, or the nodes at work, in the browser",
    "play": "publish a bag's topics over ROS",
    "record": "record ROS topics to a bag",
    "register": "align two point clouds (pcd, ply, vtk)",
    "evaluate": "ATE, RPE and NEES of a trajectory against ground truth",
    "doctor": "what is wrong with a recording or a running rig, and what to do",
    "warmup": "compile all kernels once (./slam setup does it)",
    "calibrate": "camera_info with uncertainties from pictures of a board",
}
_IN_EXPERIMENTS = ("simulate", "experiment", "benchmark", "plane", "join")
"""Commands that the package slam_experiments registers, where it is installed."""


class _LazyGroup(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*COMMANDS, *registered_commands()]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in COMMANDS:
            module = f"slam_bringup.commands.{cmd_name}"
        else:
            module, _ = registered_commands().get(cmd_name, ("", ""))
        return with_verbosity(importlib.import_module(module).command) if module else None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        known = COMMANDS if name in COMMANDS or name.startswith("-") else self.list_commands(ctx)
        if name not in known and not name.startswith("-") and not ctx.resilient_parsing:
            if name in _IN_EXPERIMENTS:
                where = "in a checkout ./slam setup does it, elsewhere pip install 'indoor-slam[experiments]'"
                raise ValueError(f"{name} comes with the package slam_experiments, which is not installed: {where}")
            close = get_close_matches(name, dict.fromkeys([*known, *_IN_EXPERIMENTS]))
            ctx.fail(f"No such command '{name}'." + (f" Did you mean {' or '.join(close)}?" if close else ""))
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:  # whatever was loading or at work; a run that can keep something does so before
            from slam_bringup.processes.interrupt import INTERRUPTED

            click.echo("\nstopped", err=True)
            sys.exit(INTERRUPTED)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            registered = {name: text for name, (_, text) in registered_commands().items()}
            formatter.write_dl(list((COMMANDS | registered).items()))


@click.group(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(VERSION, prog_name="slam")
@click.pass_context
def slam(context: click.Context) -> None:
    """Map indoor areas with a stereo camera and a time-of-flight camera."""
    log_to_terminal(context)
    share_one_heap()
    search_less_garbage()


with_verbosity(slam)


def main() -> None:
    """Entry point: a bad value, a file error and a missing extra become one clear line and exit code 2."""
    gc.disable()  # while modules are loaded; the command enables it
    try:
        slam(prog_name="slam")
    except (ValueError, OSError) as error:
        click.echo(f"slam: {error}", err=True)
        sys.exit(2)
    except ModuleNotFoundError as error:
        if (advice := advice_for(error)) is None:
            raise
        click.echo(f"slam: {advice}", err=True)
        sys.exit(2)


if __name__ == "__main__":
    main()
