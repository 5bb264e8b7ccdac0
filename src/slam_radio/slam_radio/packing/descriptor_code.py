# SPDX-License-Identifier: Apache-2.0
"""Descriptors in 24 numbers: their coordinates along the directions in which SURF-128 descriptors differ, in 20ths.

SURF-128 descriptors fill few of their 128 dimensions: 24 principal directions hold 92 % of their squares. The
directions were found on simulated rooms (``benchmarks/radio/descriptor_basis.py``) and are part of the format. A step
of 0.05 adds an error that is as large in each direction as what is left out in the others. Descriptors of another kind,
whose likeness this would spoil, go out whole, a number for each of theirs. Range coded, a descriptor has about 9 bytes.

A decoded descriptor is not simply stretched to unit length: that would make all that are not alike more alike by what
is left out, and landmarks beside each other are then taken for one. What it is short of stands in the other 104
dimensions, as waves of its coordinates: nearly the same for two sightings of a landmark, unrelated for others (random
features of a Gaussian kernel; Rahimi and Recht 2007).
"""

from __future__ import annotations

from functools import cache
from importlib import resources

import numpy as np
import numpy.typing as npt

from slam_core.types import Float32Array

IntArray = npt.NDArray[np.int64]

DIRECTIONS = 24
_STEPS = 20.0
"""Of a coordinate from 0 to 1."""
_WHOLE_STEPS = 100.0
"""The same of a descriptor that goes out whole."""
_LEAST_LIKENESS = 0.9
"""Median scalar product of descriptors and their coordinates' directions below which they go out whole."""
_KERNEL = 0.28
"""Distance of two coordinate vectors of unit length beyond which what is left out is taken as unrelated."""


@cache
def basis() -> Float32Array:
    """Orthonormal directions (128, DIRECTIONS)."""
    with resources.files("slam_radio.packing").joinpath("surf128_basis.npy").open("rb") as file:
        return np.asarray(np.load(file, allow_pickle=False), dtype=np.float32)


def encode(descriptors: Float32Array, width: int = 0) -> IntArray:
    """Codes (n, DIRECTIONS), or (n, d) where directions would not do, of unit descriptors (n, d).

    ``width``: number of columns, where it is decided already.
    """
    if is_of_basis(width or DIRECTIONS, descriptors.shape[1]):
        codes = np.rint(_STEPS * (descriptors @ basis())).astype(np.int64)
        likeness = np.einsum("nd,nd->n", descriptors, _unit(codes.astype(np.float32)) @ basis().T)
        if width or not len(codes) or np.median(likeness) >= _LEAST_LIKENESS:
            return np.asarray(codes)
    return np.asarray(np.rint(_WHOLE_STEPS * descriptors), dtype=np.int64)


def decode(codes: IntArray, dimension: int) -> Float32Array:
    """Unit descriptors (n, dimension) of what :func:`encode` made."""
    values = codes.astype(np.float32)
    if not is_of_basis(codes.shape[1], dimension):
        return _unit(values)
    along = _unit(values)
    length = np.minimum(np.linalg.norm(values, axis=1, keepdims=True) / _STEPS, 1.0)
    beyond = np.cos(along @ _waves() + np.arange(dimension, dtype=np.float32))
    beyond = _unit(beyond - (beyond @ basis()) @ basis().T)
    return np.asarray(length * (along @ basis().T) + np.sqrt(1.0 - length**2) * beyond, dtype=np.float32)


def is_of_basis(width: int, dimension: int) -> bool:
    """True if codes of ``width`` numbers are coordinates of descriptors (n, dimension), False if they are whole."""
    return width == DIRECTIONS and dimension == len(basis())


@cache
def _waves() -> Float32Array:
    """Wave numbers (DIRECTIONS, 128), of the same spread in all directions."""
    count = np.arange(DIRECTIONS * len(basis()), dtype=np.float64).reshape(DIRECTIONS, -1)
    return np.asarray(np.sqrt(2.0) / _KERNEL * np.cos(count**2), dtype=np.float32)


def _unit(values: Float32Array) -> Float32Array:
    length = np.linalg.norm(values, axis=1, keepdims=True)
    return np.asarray(values / np.maximum(length, np.finfo(np.float32).tiny), dtype=np.float32)
