# SPDX-License-Identifier: Apache-2.0
"""Surfaces that cameras dislike: dark ones, which give a ToF camera little light, and shiny ones with highlights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, parameter
from slam_simulation.world.surface_table import Look, SurfaceTable

_DARKER, _DARKER_INFRARED, _GLOSS = 0.35, 0.2, 0.4


@dataclass(frozen=True)
class FinishConfig(Config):
    """Shares of the surfaces with an unfriendly finish."""

    dark: float = parameter(0.0, "share of surfaces that are dark, in the infrared even more", minimum=0.0, maximum=1.0)
    shiny: float = parameter(0.0, "share of surfaces with strong highlights", minimum=0.0, maximum=1.0)


def finished(table: SurfaceTable, config: FinishConfig, seed: int) -> SurfaceTable:
    """The world with some of its surfaces darker and some shinier, chosen by the seed; lamps stay as they are."""
    if config.dark == 0.0 and config.shiny == 0.0:
        return table
    look = table.look.copy()
    chance = np.random.default_rng([seed, 79]).random((2, len(look)))
    plain = look[:, Look.EMISSION] == 0.0
    dark, shiny = plain & (chance[0] < config.dark), plain & (chance[1] < config.shiny)
    look[dark, Look.BRIGHTNESS] *= _DARKER
    look[dark, Look.INFRARED] *= _DARKER_INFRARED
    look[shiny, Look.GLOSS] += _GLOSS
    return table._replace(look=look)
