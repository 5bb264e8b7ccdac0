# SPDX-License-Identifier: Apache-2.0
"""The thesis's five questions (1.5), answered from the figures of the experiments that were run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Entries = Mapping[str, Mapping[str, Any]]


def answers(entries: Entries) -> list[dict[str, str]]:
    """Each question with its answer; those whose experiments were not run are left out."""
    found = []
    for question, answer in _QUESTIONS.items():
        try:
            found.append({"question": question, "answer": answer(entries)})
        except KeyError:  # an experiment that was not asked for
            continue
    return found


def _ours(entries: Entries, name: str, quantity: str) -> str:
    """Our value of the first quantity that begins so."""
    for comparison in entries[name]["comparisons"]:
        if comparison["quantity"].startswith(quantity):
            return str(comparison["ours"])
    raise KeyError(quantity)


def _cell(entries: Entries, name: str, row: str, column: str, table: int = 0) -> str:
    """A cell of an experiment's table, by the names of its row and column."""
    found = entries[name]["tables"][table]
    for cells in found["rows"]:
        if cells[0] == row:
            return str(cells[list(found["header"]).index(column)])
    raise KeyError(row)


def _techniques(entries: Entries) -> str:
    time, consistency = (_ours(entries, "one_filter", q) for q in ("time per frame", "ANEES"))
    end, loop = _ours(entries, "figure_eight", "end error"), _ours(entries, "five_rooms", "loop")
    growth = _ours(entries, "survey", "growth of a step")
    return (
        f"Over two rooms a frame takes {time} at the end of one filter; the ANEES of one filter and of joined submaps"
        f" are {consistency}. On the same planar worlds a step's time grows as {growth} of the landmarks (one EKF,"
        f" joined submaps). By joined submaps the figure eight ends {end} off; five rooms, which the thesis could not"
        f" merge: {loop}."
    )


def _laser_camera(entries: Entries) -> str:
    ate = {mode: _ours(entries, "modes", f"ATE, {mode}") for mode in ("stereo", "tof", "replace", "fuse")}
    return (
        f"In the small room the ATE of the stereo camera alone is {ate['stereo']}, of the laser camera alone"
        f" {ate['tof']}, of stereo features with the laser camera's depth {ate['replace']}, with both depths weighted"
        f" by their variances {ate['fuse']}. The smallest: {_ours(entries, 'modes', 'best of the four')}."
    )


def _motion(entries: Entries) -> str:
    sweep, fireman = (_cell(entries, *place, "ATE mm") for place in (("sweep", "sweep"), ("fireman", "fireman_10hz")))
    return (
        f"ATE {sweep} mm in a slow sweep of 90 degrees, {fireman} mm when a fireman looks round at will,"
        f" {_ratio(fireman, sweep)}. At 5 instead of 10 frames a second he is {_ours(entries, 'fireman', '5hz')}."
    )


def _robot(entries: Entries) -> str:
    names = ("workshop_rig", "workshop_handheld")
    ate = [_cell(entries, name, name, "ATE mm") for name in names]
    end = [_ours(entries, name, "end error") for name in names]
    return (
        f"Round the workshop the ATE is {ate[0]} mm on a rig and {ate[1]} mm in the hand, {_ratio(ate[1], ate[0])}; the"
        f" end is {end[0]} and {end[1]} off."
    )


def _registration(entries: Entries) -> str:
    ndt, points, planes = (
        _ours(entries, "registration", name) for name in ("NDT", "ICP, point to point", "ICP, point to plane")
    )
    share = "20"
    times = [_cell(entries, "registration", share, f"{method} ms", 2) for method in ("NDT", "ICP")]
    return (
        f"With one setting NDT registers all scans in {ndt} motions, ICP in {points} (point to point) and {planes} (to"
        f" planes); with {share} % of the points NDT takes {times[0]} ms and ICP to planes {times[1]} ms,"
        f" {_ratio(times[1], times[0])}. As odometry, drift and largest error of height: NDT"
        f" {_ours(entries, 'scan_trajectory', 'NDT')}; ICP {_ours(entries, 'scan_trajectory', 'ICP')}."
    )


def _ratio(ours: str, other: str) -> str:
    """Two figures compared in words."""
    return f"{float(ours) / float(other):.1f} times as much"


_QUESTIONS: Mapping[str, Callable[[Entries], str]] = {
    "Which SLAM techniques are suitable for making large high-quality maps of indoor environments?": _techniques,
    "How can the laser camera complement the stereo camera?": _laser_camera,
    "What is the quality of the map if the cameras are moved systematically, compared to randomly?": _motion,
    "What is the quality of the map if the cameras are mounted to a robot, compared to handheld?": _robot,
    "How do the two laser scan registration methods compare?": _registration,
}
