# SPDX-License-Identifier: Apache-2.0
"""Extras of the distribution ``indoor-slam``: what an installation may lack, and how to get it.

One wheel holds all packages. An extra brings the requirements of some commands; without it these end with one line.
"""

from __future__ import annotations

import importlib.util

EXTRA_OF = {"rclpy": "ros", "dask": "scale", "distributed": "scale", "filterpy": "experiments"}
"""Extra that brings a module."""
GET_ROS = "source an installation, use ./slam of a checkout, or pip install 'indoor-slam[ros]'"


def has_ros() -> bool:
    """True where this Python has ROS 2."""
    return importlib.util.find_spec("rclpy") is not None


def require_ros(purpose: str) -> None:
    """Refuse to go on without ROS 2.

    Raises
    ------
    ValueError
        If there is none; it says how to get it.
    """
    if not has_ros():
        raise ValueError(f"{purpose} needs ROS 2 Jazzy: {GET_ROS}")


def advice_for(error: ModuleNotFoundError) -> str | None:
    """One line on a module that is missing, or None for one that no extra brings."""
    name = (error.name or "").partition(".")[0]
    extra = EXTRA_OF.get(name)
    return extra and f"the package {name} is missing: pip install 'indoor-slam[{extra}]', or ./slam setup in a checkout"
