# SPDX-License-Identifier: Apache-2.0
"""Text submaps end at one optimum, whichever library solves them and in whichever form."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from text_world import ring

from slam_core.linear_algebra.sparse_cholesky import BACKENDS
from slam_experiments.linear_slam.text_joining import ROWS, TextJoiningConfig, TextJoiningResult, join_text_maps

LIBRARIES = [name for name in BACKENDS if name != "auto"]


@cache
def text_reference(rows: str, dimension: int) -> TextJoiningResult:
    return join_text_maps(ring(40, dimension), dimension, TextJoiningConfig(rows=rows))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("rows", ROWS)
@pytest.mark.parametrize("library", LIBRARIES)
def test_text_submaps_end_at_the_same_optimum_with_every_library(library: str, rows: str, dimension: int) -> None:
    result = join_text_maps(ring(40, dimension), dimension, TextJoiningConfig(rows=rows, solver=library))
    best = text_reference(rows, dimension)
    assert result.solver == library
    assert best.solver == "multifrontal"
    assert result.chi2 == pytest.approx(best.chi2, rel=1e-9)
    assert np.allclose(result.poses, best.poses, atol=1e-5)
