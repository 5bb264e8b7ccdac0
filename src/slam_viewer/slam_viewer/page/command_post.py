# SPDX-License-Identifier: Apache-2.0
"""The command post: of every agent the way back out with its uncertainty, and where nobody has looked yet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.plans.navigation import Frontier, Route, frontiers, plan_route, walked
from dense_mapping.plans.storeys import storey_number
from slam_core.estimation.chi_square import ELLIPSE_PROBABILITY, chi_square_bound
from slam_core.geometry import FloatArray
from slam_core.types import PoseEstimate

_NOWHERE_M = 20.0
"""A stretch that nothing ties to the map yet has a standard deviation of a hundred metres."""


@dataclass(frozen=True, eq=False)
class WayOut:
    """An agent's way back to the exit, or None through what was seen.

    ``radius``: the agent stands within so many metres of where the way begins, with 99.5 %.
    """

    agent: str
    route: Route | None
    radius: float

    @property
    def label(self) -> str:
        """The length alone, for the scene."""
        return "" if self.route is None else f"{self.route.length:.1f} m to the exit"

    @property
    def text(self) -> str:
        """Way to the exit and uncertainty, in words."""
        if self.route is None:
            return "no way out through what was seen free or walked on"
        narrow = f", {2 * self.route.clearance:.1f} m wide at its narrowest" if self.route.clearance < 0.5 else ""
        return f"{self.route.length:.1f} m to the exit{narrow}, {radius_text(self.radius)}"


def storey_at(plans: Sequence[FloorPlan], point: FloatArray) -> FloorPlan | None:
    """The plan of the storey that a point (3,) of the map is on: the highest floor below it."""
    number = storey_number(plans, point)
    return None if number is None else plans[number]


def ways_out(
    plans: Sequence[FloorPlan], agents: Mapping[str, PoseEstimate], paths: Mapping[str, FloatArray]
) -> list[WayOut]:
    """The way of each agent to where its path (n, 3) m began; who is on another storey than that gets none.

    Where somebody has walked one can walk, so at worst the way is the one by which the agent came.
    """
    trodden = {id(plan): plan for plan in plans}
    for path in paths.values():
        storeys = [storey_at(plans, step) for step in path]
        for storey in plans:
            own = [step for step, its in zip(path, storeys, strict=True) if its is storey]
            trodden[id(storey)] = walked(trodden[id(storey)], np.array(own).reshape(-1, 3))
    out = []
    for name, pose in agents.items():
        exit_ = paths[name][0]
        plan, target = storey_at(plans, pose.T[:3, 3]), storey_at(plans, exit_)
        same = plan is not None and plan is target
        found = plan_route(trodden[id(plan)], pose.T[:3, 3], exit_) if same else None
        out.append(WayOut(name, found, position_radius(pose)))
    return out


def position_radius(pose: PoseEstimate) -> float:
    """Radius (m) of the circle on the floor that holds the agent with 99.5 %, by the largest axis of its ellipse."""
    largest = max(np.linalg.eigvalsh(pose.covariance[:2, :2])[-1], 0.0)
    return float(np.sqrt(chi_square_bound(ELLIPSE_PROBABILITY, 2) * largest))


def has_place(radius: float) -> bool:
    """True if something ties an agent whose position has this radius (m) to the map."""
    return radius <= _NOWHERE_M


def radius_text(radius: float) -> str:
    """Uncertainty of a position, in words."""
    if not has_place(radius):
        return "position not tied to the map"
    return f"position ±{radius:.2f} m (99.5 %)"


def unseen(plans: Sequence[FloorPlan], most: int = 30) -> list[Frontier]:
    """Borders of what nobody has seen yet, on all storeys, the longest first."""
    return sorted((f for plan in plans for f in frontiers(plan)), key=lambda f: -f.length)[:most]
