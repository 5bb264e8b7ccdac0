# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ndt_registration.clouds.quantiles import quantiles, root_quantiles

SHARES = (0.0, 0.13, 0.25, 0.37, 0.5, 0.63, 0.77, 0.9, 0.99, 1.0)


@pytest.mark.parametrize("count", [1, 2, 5, 1000, 4097])
def test_quantiles_are_those_of_numpy_to_the_bit(rng: np.random.Generator, count: int) -> None:
    values = rng.uniform(0.3, 7.0, count)
    assert quantiles(values, SHARES) == np.quantile(values, SHARES).tolist()
    assert root_quantiles(values, SHARES) == np.quantile(np.sqrt(values), SHARES).tolist()


@pytest.mark.parametrize("count", [10, 11])
def test_equal_numbers_zeros_and_numbers_far_apart_have_the_quantiles_of_numpy(
    rng: np.random.Generator, count: int
) -> None:
    values = rng.permutation(np.r_[np.full(count, 2.5), np.zeros(count), 5e-324, 1e300, rng.uniform(1.0, 1.01, count)])
    assert quantiles(values, SHARES) == np.quantile(values, SHARES).tolist()
