# SPDX-License-Identifier: Apache-2.0
"""``slam anchor``: a finished map in the frame of its building, by points that are the same on the floor plan."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from slam_bringup.jobs.anchoring import ANCHOR, anchor_map, parse_pair, read_pairs, report, write_anchored, write_page
from slam_bringup.terminal.paths import UserPath, overwrite_option
from slam_viewer.anchor.building_plan import read_building_plan
from slam_viewer.anchor.map_from_above import MapFromAbove

_POSITIVE = click.FloatRange(min=0.0, min_open=True)


@click.command()
@click.argument("out", type=UserPath(exists=True, file_okay=False))
@click.argument("plan", type=UserPath(exists=True, dir_okay=False))
@click.option(
    "--at", "given", multiple=True, metavar="X,Y=U,V", help="metres in the map = pixels on the plan (repeated)"
)
@click.option("--points", type=UserPath(exists=True, dir_okay=False), help="YAML with a list of such points")
@click.option(
    "--resolution", type=_POSITIVE, metavar="M_PER_PX", help="of the plan; without it, it comes from the points"
)
@click.option(
    "--sigma-px", type=_POSITIVE, default=3.0, show_default=True, help="standard deviation of a point on the plan, px"
)
@click.option(
    "--sigma-m", type=_POSITIVE, default=0.05, show_default=True, help="standard deviation of a point in the map, m"
)
@click.option(
    "--storey", type=click.IntRange(0), default=0, show_default=True, help="floor plan of the map, from the lowest"
)
@click.option("-o", "--output", type=UserPath(file_okay=False), help="folder to write instead of OUT")
@overwrite_option("results of slam anchor that were changed since")
def command(
    out: Path, plan: Path, given: tuple[str, ...], points: Path | None, resolution: float | None, sigma_px: float,
    sigma_m: float, storey: int, output: Path | None, overwrite: bool,
) -> None:  # fmt: skip
    """Place the map of OUT in the frame of its building, by two or more points that the image PLAN shows too.

    OUT is a finished run or its folder map; PLAN a PNG, PGM or JPG, or a map_server YAML that names one. Pixels count
    from the upper left corner. Without points a page is written on which they are clicked.
    """
    pairs = [parse_pair(text, sigma_px) for text in given] + (read_pairs(points, sigma_px) if points else [])
    building, mapped = read_building_plan(plan, resolution), MapFromAbove.read(out, storey)
    folder = output or mapped.folder
    if output is None and not (folder / "summary.json").is_file():
        raise ValueError(f"{out} is a map without a run around it, which only a map may be in: say -o FOLDER")
    if not pairs:
        page = write_page(folder, mapped, building, _typed(out, plan, resolution, storey, output))
        click.echo(f"no points were given: open {page} in a browser, click them, and run the command that it shows")
        return
    anchored = anchor_map(mapped, building, pairs, sigma_m)
    names = write_anchored(folder, mapped, anchored, overwrite=overwrite)
    click.echo(report(anchored))
    click.echo(f"{folder / ANCHOR}, with {', '.join(names[1:])}")


def _typed(out: Path, plan: Path, resolution: float | None, storey: int, output: Path | None) -> str:
    """The command line to put the points behind."""
    words = ["slam", "anchor", str(out), str(plan)]
    words += ["--resolution", f"{resolution:g}"] if resolution is not None else []
    words += ["--storey", str(storey)] if storey else []
    words += ["-o", str(output)] if output is not None else []
    return shlex.join(words)
