# SPDX-License-Identifier: Apache-2.0
"""Quantiles of the chi-square distribution, without the half second that loading all of SciPy's distributions takes."""

from __future__ import annotations

from functools import lru_cache

ELLIPSE_PROBABILITY = 0.995
"""Share of the probability inside every ellipse and ellipsoid that is shown, as in the thesis's figures."""


@lru_cache(maxsize=4096)
def chi_square_bound(probability: float, freedom: int) -> float:
    """Bound that a chi-square variable with ``freedom`` degrees of freedom stays below with this probability."""
    from scipy.special import gammaincinv  # 0.2 s, which programs without any gate need not spend

    return float(2.0 * gammaincinv(0.5 * freedom, probability))
