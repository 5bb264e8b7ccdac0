# SPDX-License-Identifier: Apache-2.0
"""Jobs that render a scenario to a bag."""

from __future__ import annotations

from pathlib import Path

from slam_experiments.job import RENDERING, Job, Kept

MODULE = "slam_experiments.simulated.rendering"


def rendered(scenario: str, every: int = 1, frames: int | None = None) -> Job:
    """The bag of a scenario: every n-th frame, of the first ``frames`` where that is given."""
    arguments = {"scenario": scenario, "every": every, "frames": frames}
    return Job(f"{MODULE}:render", arguments, (*RENDERING, "slam_experiments.simulated.simulated_bag", "slam_bags"))


def render(folder: Path, before: list[Path], scenario: str, every: int, frames: int | None) -> Kept:
    """Render a scenario to ``folder / bag``."""
    from slam_experiments.simulated.simulated_bag import BagOptions, write_bag
    from slam_simulation import Scenario

    plan = Scenario.load(scenario)
    if frames is not None:
        plan = plan.shortened(frames * every)
    write_bag(plan, folder / "bag", BagOptions(images="jpeg", compact=True, every=every), threads=1)
    return {"scenario": scenario, "frames": plan.frames // every}, {}
