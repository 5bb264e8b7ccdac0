# SPDX-License-Identifier: Apache-2.0
"""Decompression of LZF, the format of compressed PCD files (Marc Lehmann's liblzf)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

Bytes = npt.NDArray[np.uint8]


@njit(cache=True, nogil=True)
def _decompress(packed: Bytes, out: Bytes) -> int:
    """Bytes written, -1 for damaged input."""
    i, o = 0, 0
    while i < packed.shape[0]:
        control = int(packed[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > packed.shape[0] or o + length > out.shape[0]:
                return -1
            out[o : o + length] = packed[i : i + length]
            i += length
            o += length
            continue
        length = control >> 5
        if length == 7:
            if i >= packed.shape[0]:
                return -1
            length += int(packed[i])
            i += 1
        if i >= packed.shape[0]:
            return -1
        reference = o - ((control & 31) << 8) - int(packed[i]) - 1
        i += 1
        if reference < 0 or o + length + 2 > out.shape[0]:
            return -1
        for _ in range(length + 2):
            out[o] = out[reference]
            o += 1
            reference += 1
    return o


def lzf_decompress(packed: Bytes, size: int) -> Bytes:
    """The ``size`` bytes that were compressed to ``packed``.

    Raises
    ------
    ValueError
        If the data are damaged.
    """
    out = np.empty(size, np.uint8)
    if _decompress(packed, out) != size:
        raise ValueError("the compressed data are damaged")
    return out
