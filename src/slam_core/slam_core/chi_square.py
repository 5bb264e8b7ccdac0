# SPDX-License-Identifier: Apache-2.0
"""Quantiles of the chi-square distribution, without the half second that loading all of SciPy's distributions takes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincinv

from slam_core.geometry import FloatArray


def chi_square_quantile(probability: float, freedom: float) -> float:
    """Value that a chi-square variable with ``freedom`` degrees of freedom stays below with this probability."""
    return float(chi_square_quantiles(probability, freedom))


def chi_square_quantiles(probability: float, freedom: npt.ArrayLike) -> FloatArray:
    """The same for several numbers of degrees of freedom (n,)."""
    return np.asarray(2.0 * gammaincinv(0.5 * np.asarray(freedom), probability))
