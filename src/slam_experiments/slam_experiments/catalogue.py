# SPDX-License-Identifier: Apache-2.0
"""All experiments, in the order of the thesis."""

from __future__ import annotations

from slam_experiments.experiments import (
    association,
    calibration,
    dense,
    features,
    filtering,
    fusion,
    joining,
    planar,
    registration,
    survey,
)
from slam_experiments.findings import Experiment

EXPERIMENTS: dict[str, Experiment] = {
    experiment.name: experiment
    for module in (planar, survey, calibration, features, association, filtering, dense, joining, registration, fusion)
    for experiment in module.EXPERIMENTS
}


def listing() -> str:
    """A line for each experiment: its name and its title."""
    return "\n".join(f"  {e.name:18}{e.title}" for e in EXPERIMENTS.values())


def chosen(names: tuple[str, ...]) -> list[Experiment]:
    """The experiments of these names, or every one for "all".

    Raises
    ------
    ValueError
        If there is no name, or no experiment of a name; the message lists those there are.
    """
    if not names:
        raise ValueError(f"name experiments, or say all:\n{listing()}")
    unknown = [name for name in names if name not in (*EXPERIMENTS, "all")]
    if unknown:
        raise ValueError(f"no experiment {', '.join(unknown)}; say all, or name some of:\n{listing()}")
    return list(EXPERIMENTS.values()) if "all" in names else [EXPERIMENTS[name] for name in dict.fromkeys(names)]
