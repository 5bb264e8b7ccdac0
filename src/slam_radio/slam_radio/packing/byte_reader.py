# SPDX-License-Identifier: Apache-2.0
"""Reads numbers and arrays from bytes that somebody else sent; everything that does not fit is a ``ValueError``."""

from __future__ import annotations

import struct
from math import prod
from typing import Any

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.types import AnyArray


class ByteReader:
    """Bytes and how far they have been read."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def bytes(self, count: int | None = None) -> bytes:
        """The next ``count`` bytes, or all that are left."""
        count = len(self._data) - self._at if count is None else count
        if count > len(self._data) - self._at:
            raise ValueError(f"a message of {len(self._data)} bytes ends too early")
        self._at += count
        return self._data[self._at - count : self._at]

    def text(self, count: int) -> str:
        """Text of ``count`` bytes of UTF-8."""
        try:
            return self.bytes(count).decode()
        except UnicodeDecodeError as error:
            raise ValueError(f"a name is not UTF-8: {error}") from error

    def numbers(self, form: str) -> tuple[Any, ...]:
        """Numbers of a ``struct`` format."""
        return struct.unpack(form, self.bytes(struct.calcsize(form)))

    def number(self, form: str) -> int:
        """One whole number of a ``struct`` format."""
        return int(self.numbers(form)[0])

    def array(self, kind: str, shape: tuple[int, ...]) -> AnyArray:
        """Array of a NumPy type and shape."""
        data = self.bytes(np.dtype(kind).itemsize * prod(shape))
        return np.frombuffer(data, kind).reshape(shape)

    def floats(self, kind: str, shape: tuple[int, ...]) -> FloatArray:
        """Finite floating point numbers as float64."""
        with np.errstate(invalid="ignore"):  # of a signalling NaN, refused below
            values = self.array(kind, shape).astype(np.float64)
        if not np.isfinite(values).all():
            raise ValueError("a message holds numbers that are not finite")
        return values

    def require_end(self) -> None:
        """Raise ``ValueError`` if bytes are left."""
        if self._at != len(self._data):
            raise ValueError(f"a message has {len(self._data) - self._at} bytes too many")
