# SPDX-License-Identifier: Apache-2.0
"""Descriptors in 24 numbers of 81 values: their coordinates along the directions in which SURF-128 descriptors differ.

SURF-128 descriptors fill few of their 128 dimensions: 24 principal directions hold 92 % of their squares. The
directions were found on simulated rooms (``benchmarks/radio/descriptor_basis.py``) and are part of the format.
Descriptors of another kind, whose likeness this would spoil, go out whole, a number for each of theirs. Few of the 81
values are frequent: deflated, a descriptor has about 15 bytes.
"""

from __future__ import annotations

from functools import cache
from importlib import resources

import numpy as np
import numpy.typing as npt

from slam_core.types import Float32Array

Int8Array = npt.NDArray[np.int8]

DIRECTIONS = 24
_STEPS = 40.0
_LEAST_LIKENESS = 0.9
"""Median scalar product of descriptors and their codes below which they go out whole."""


@cache
def basis() -> Float32Array:
    """Orthonormal directions (128, DIRECTIONS)."""
    with resources.files("slam_radio.packing").joinpath("surf128_basis.npy").open("rb") as file:
        return np.asarray(np.load(file, allow_pickle=False), dtype=np.float32)


def encode(descriptors: Float32Array) -> Int8Array:
    """Codes (n, DIRECTIONS), or (n, d) where directions would not do, of unit descriptors (n, d)."""
    if descriptors.shape[1:] == (len(basis()),):
        codes = _steps(descriptors @ basis())
        likeness = np.einsum("nd,nd->n", descriptors, decode(codes, len(basis())))
        if not len(codes) or np.median(likeness) >= _LEAST_LIKENESS:
            return codes
    return _steps(descriptors)


def decode(codes: Int8Array, dimension: int) -> Float32Array:
    """Unit descriptors (n, dimension) of what :func:`encode` made."""
    values = codes.astype(np.float32)
    if codes.shape[1] == DIRECTIONS and dimension == len(basis()):
        values = values @ basis().T
    length = np.linalg.norm(values, axis=1, keepdims=True)
    return np.asarray(values / np.maximum(length, np.finfo(np.float32).tiny), dtype=np.float32)


def _steps(values: Float32Array) -> Int8Array:
    """Rows as multiples of a step of their own: the largest element is 40 steps."""
    largest = np.abs(values).max(axis=1, keepdims=True, initial=np.finfo(np.float32).tiny)
    return np.asarray(np.rint(_STEPS * (values / largest)), dtype=np.int8)
