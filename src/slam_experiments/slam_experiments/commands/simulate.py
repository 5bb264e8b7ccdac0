# SPDX-License-Identifier: Apache-2.0
"""``slam simulate``: renders a scenario to a bag with ground truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from slam_bags.storage.bag_owner import require_free
from slam_bringup.terminal.console import progress_bar
from slam_bringup.terminal.paths import UserPath, overwrite_option
from slam_experiments.simulated.simulated_bag import IMAGE_FORMATS, BagOptions, write_bag
from slam_simulation import Scenario
from slam_simulation.sensors.profiles import PROFILES


@click.command()
@click.argument("scenario")
@click.option("-o", "--output", required=True, type=UserPath(), help="the bag to write (folder or .mcap)")
@click.option("--every", type=click.IntRange(1), default=1, show_default=True, help="take only every n-th frame")
@click.option("--frames", type=click.IntRange(1), help="render only the first frames")
@click.option("--seed", type=click.IntRange(0), help="another seed than the scenario's: same plan, other building")
@click.option(
    "--profile",
    type=click.Choice(PROFILES),
    default="real",
    show_default=True,
    help="real: with calibration errors, exposure steps, blur, people, ToF errors and haze; ideal: without",
)
@click.option("--storage", type=click.Choice(("mcap", "sqlite3")), default="mcap", show_default=True, help="bag format")
@click.option("--images", type=click.Choice(IMAGE_FORMATS), default="raw", show_default=True, help="stereo images")
@click.option("--compact", is_flag=True, help="ToF images in 16 bits, no intensity")
@click.option("--rectified", is_flag=True, help="rectified stereo images (image_rect) instead of raw ones")
@click.option("--truth", is_flag=True, help="also store the true depth of the left image")
@click.option("--wheels", is_flag=True, help="wheel odometry too, with 1 % of slip unless the scenario says otherwise")
@click.option("--position", is_flag=True, help="positions in the building's frame too, 10 % of them 5 m off")
@click.option("--pressure", is_flag=True, help="air pressure of a barometer too")
@click.option(
    "--threads", type=click.IntRange(1), help="threads that draw (all processors); the bag does not depend on it"
)
@overwrite_option("a bag that slam wrote")
def command(
    scenario: str, output: Path, every: int, frames: int | None, seed: int | None, profile: str | None, storage: str,
    images: str, compact: bool, rectified: bool, truth: bool, wheels: bool, position: bool, pressure: bool,
    threads: int | None, overwrite: bool,
) -> None:  # fmt: skip
    """Render SCENARIO (a YAML file, or the name of one in bags/scenarios) to a bag with ground truth."""
    require_free(output, overwrite=overwrite)
    plan = Scenario.load(scenario)
    plan = plan.with_profile(profile or plan.profile or "real")
    if seed is not None:
        plan = replace(plan, seed=seed)
    if frames is not None:
        plan = plan.shortened(frames)
    for name in ["wheels"] * wheels + ["position"] * position + ["pressure"] * pressure:
        plan = replace(plan, sensors=(*plan.sensors, *{name}.difference(plan.sensors)))
    options = BagOptions(images, compact, truth, rectified, storage, every, overwrite)
    with progress_bar() as progress:
        frames = -(-plan.frames // every) * len(plan.agents) * max(1, len(plan.cameras))
        task = progress.add_task(f"rendering {plan.name}", total=frames)
        write_bag(plan, output, options, threads, lambda: progress.advance(task))
