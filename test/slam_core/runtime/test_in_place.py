# SPDX-License-Identifier: Apache-2.0
"""Kernels that only fill arrays."""

from __future__ import annotations

import numpy as np
import pytest
from numba.core.errors import NumbaError

from slam_core.runtime.in_place import in_place


@in_place()
def _add_rows(image, total):  # type: ignore[no-untyped-def]
    for y in range(len(image)):
        _add(image[y], total)


@in_place()
def _add(row, total):  # type: ignore[no-untyped-def]
    for x in range(len(row)):
        total[x] += row[x]


@in_place()
def _doubled(row):  # type: ignore[no-untyped-def]
    return 2.0 * row


def test_views_are_taken_without_counting_references() -> None:
    total = np.zeros(3)
    _add_rows(np.arange(12.0).reshape(4, 3), total)
    np.testing.assert_array_equal(total, [18.0, 22.0, 26.0])
    for kernel in (_add, _add_rows):
        kernel.recompile()  # what numba has kept cannot be looked into
    (compiled,) = _add_rows.overloads.values()
    assembly = compiled.library.get_asm_str()
    assert "_add_rows" in assembly
    assert "NRT_" not in assembly


def test_a_kernel_that_makes_an_array_is_not_compiled() -> None:
    with pytest.raises(NumbaError):
        _doubled(np.ones(3))
