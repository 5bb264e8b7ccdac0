# SPDX-License-Identifier: Apache-2.0
"""Profiles of a simulated recording: ``ideal`` rendering, or ``real`` with what real rooms and sensors add.

Every effect is a small module of its own with a configuration here; all of them are off in ``ideal``, whose bytes they
leave as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

from slam_core.config import Config, group, parameter
from slam_simulation.rendering.smoke import SmokeConfig
from slam_simulation.sensors.tof_errors import TofErrorConfig
from slam_simulation.world.finishes import FinishConfig
from slam_simulation.world.moving import MovingConfig

PROFILES = ("ideal", "real")


@dataclass(frozen=True)
class RealismConfig(Config):
    """Disturbances that reality adds to the ideal rendering; the defaults add nothing."""

    moving: MovingConfig = group(MovingConfig)
    finishes: FinishConfig = group(FinishConfig)
    smoke: SmokeConfig = group(SmokeConfig)
    tof: TofErrorConfig = group(TofErrorConfig)
    exposure_step_ev: float = parameter(
        0.0, "exposure control moves in steps of so many stops, 0: smoothly", minimum=0.0, maximum=2.0
    )
    readout_ms: float = parameter(
        0.0, "time from the first to the last row of the stereo images; 0: global shutter", unit="ms", minimum=0.0
    )


REAL = RealismConfig(
    moving=MovingConfig(people=1, moved_chairs=1),
    finishes=FinishConfig(dark=0.06, shiny=0.06),
    smoke=SmokeConfig(density=0.02),
    tof=TofErrorConfig(multipath=0.05, wiggling=0.006),
    exposure_step_ev=1.0 / 3.0,
)
"""One person about, a chair that is moved, thin smoke, some dark and some shiny things, a ToF camera as they are."""
REAL_STEREO = {"calibration_pictures": 20, "exposure_ms": 10.0, "gain_jitter": 0.02}
"""Errors that the stereo camera has at least under ``real``."""
