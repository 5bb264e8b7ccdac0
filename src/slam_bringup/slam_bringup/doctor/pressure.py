# SPDX-License-Identifier: Apache-2.0
"""Checks that a barometer tells the pressure of the air in pascals, with a variance that it keeps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ekf_slam_node.odometry.pressure import SCALE_HEIGHT, USUAL_PA
from slam_bringup.doctor.evidence import Evidence
from slam_bringup.doctor.finding import Finding

_FEWEST = 20
_LEAST_HZ = 2.0
_NOISIER = 3.0
"""Noise over that claimed which is a fault."""


def check_pressure(evidence: Evidence) -> Iterator[Finding]:
    """Unit, rate, and noise from reading to reading beside the variance claimed."""
    readings = evidence.pressures
    if len(readings) < _FEWEST:
        return
    topic = evidence.name("pressure")
    pressures = np.array([reading.pressure for reading in readings])
    typical = float(np.median(pressures))
    if not USUAL_PA[0] < typical < USUAL_PA[1]:
        yield Finding(
            "pressure unit",
            f"{topic} tells {typical:.5g} Pa, which is no air that people breathe",
            "FluidPressure is in pascals, absolute: 1013 hPa are 101300",
        )
        return
    seconds = (readings[-1].stamp_ns - readings[0].stamp_ns) * 1e-9
    if seconds > 0.0 and len(readings) / seconds < _LEAST_HZ:
        yield Finding(
            "pressure rate",
            f"{topic} comes {len(readings) / seconds:.1f} times a second",
            f"let its driver publish at {_LEAST_HZ:.0f} Hz or more: lift rides last for seconds",
        )
    claimed = np.array([reading.variance for reading in readings])
    if not np.isfinite(claimed).all() or (claimed <= 0.0).all():
        return
    noise = float(np.median(np.abs(np.diff(pressures))) / 0.6745 / np.sqrt(2.0))
    told = float(np.sqrt(np.median(claimed)))
    if noise > _NOISIER * told:
        per_pascal = SCALE_HEIGHT / typical
        yield Finding(
            "pressure variance",
            f"{topic} claims a standard deviation of {told:.2g} Pa ({told * per_pascal:.2f} m), and its readings "
            f"scatter by {noise:.2g} Pa ({noise * per_pascal:.2f} m)",
            "let the driver fill variance, or leave it 0: ride.sigma_pressure_height counts then",
        )
