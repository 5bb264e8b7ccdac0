# SPDX-License-Identifier: Apache-2.0
"""Whole numbers in about as many bits as they are worth, by the range coder of ``constriction``.

A *column* is a group of numbers of one kind, which share a model: one of 128 bell curves, named by a byte. Of wide
columns the low bits go out as they are, so that 255 symbols suffice. The curves are made by sums, products and
quotients alone, which IEEE 754 rounds alike on every machine: both ends have the same to the last bit.

Both classes have the same calls in the same order: what the writer is given, the reader returns.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from slam_core.types import AnyArray

IntArray = npt.NDArray[np.int64]

ADVICE = "submaps for the air need the range coder, which is not installed: pip install constriction"
LARGEST = 2**30
"""Numbers of a column are smaller than this."""
_MOST = 127
"""Symbols reach from -127 to 127."""
_SCALES = 64
_SMALLEST, _GROWTH = 0.1, 1.12
"""Width of the narrowest curve in symbols, and the ratio of one to the next."""
_SQUARINGS = (1, 3)
"""Tails of the two shapes: the curve is (1 + x^2 / (2 p s^2))^-p with p = 2, heavy, and p = 8, nearly a Gaussian."""
_HALF = 2**15


class SymbolWriter:
    """Takes columns of numbers; ``bytes`` are those that a :class:`SymbolReader` reads."""

    def __init__(self) -> None:
        self._coder: Any = coder_library().stream.queue.RangeEncoder()

    def columns(self, values: IntArray) -> None:
        """Columns (n, k) of numbers around zero, from -127 to 127, each with a curve of its own."""
        if not len(values):
            return
        if np.abs(values).max(initial=0) > _MOST:
            raise ValueError(f"symbols reach from -{_MOST} to {_MOST}, got {np.abs(values).max()}")
        k = values.shape[1]
        counts = np.bincount((values + _MOST + 255 * np.arange(k)).ravel(), minlength=255 * k).reshape(k, 255)
        curves = np.argmax(_logarithms() @ counts.T, axis=0)
        self._even(curves, 2 * _SCALES)
        symbols = np.asfortranarray(values + _MOST, dtype=np.int32)
        for j, curve in enumerate(curves.tolist()):
            self._coder.encode(np.ascontiguousarray(symbols[:, j]), _models()[curve])

    def column(self, values: IntArray) -> None:
        """One column (n,) of any numbers below :data:`LARGEST`: its median, its low bits, and the rest."""
        if not len(values):
            return
        centre = int(np.sort(values)[len(values) // 2])
        spread = values - centre
        if max(abs(centre), int(np.abs(spread).max())) >= LARGEST:
            raise ValueError(f"a number of {np.abs(values).max()} steps is too large to be sent")
        low = max(int(np.abs(spread).max()).bit_length() - 7, 0)
        low += int((spread >> low).min() < -_MOST)
        self._even(np.array([centre // _HALF + _HALF, centre % _HALF]), 2 * _HALF)
        self._even(np.array([low]), 32)
        self.columns((spread >> low)[:, None])
        for shift, bits in _chunks(low):
            self._even((spread >> shift) & ((1 << bits) - 1), 1 << bits)

    def bytes(self) -> bytes:
        """All that was written."""
        return bytes(self._coder.get_compressed().astype("<u4").tobytes())

    def _even(self, values: AnyArray, size: int) -> None:
        self._coder.encode(np.ascontiguousarray(values, dtype=np.int32), coder_library().stream.model.Uniform(size))


class SymbolReader:
    """Returns the columns that a :class:`SymbolWriter` took; bytes of no writer give any numbers, or ``ValueError``."""

    def __init__(self, data: bytes) -> None:
        if len(data) % 4:
            raise ValueError(f"coded numbers come in groups of 4 bytes, got {len(data)}")
        self._coder: Any = coder_library().stream.queue.RangeDecoder(np.frombuffer(data, "<u4").astype(np.uint32))

    def columns(self, n: int, k: int) -> IntArray:
        """Columns (n, k) of numbers from -127 to 127."""
        values = np.empty((n, k), dtype=np.int64)
        if not n:
            return values
        for j, curve in enumerate(self._even(k, 2 * _SCALES).tolist()):
            values[:, j] = self._decoded(_models()[curve], n)
        return values - _MOST

    def column(self, n: int) -> IntArray:
        """One column (n,) of any numbers."""
        if not n:
            return np.empty(0, dtype=np.int64)
        high, rest = self._even(2, 2 * _HALF).tolist()
        low = int(self._even(1, 32)[0])
        values = self.columns(n, 1)[:, 0] << low
        for shift, bits in _chunks(low):
            values |= self._even(n, 1 << bits) << shift
        return np.asarray(values + ((high - _HALF) * _HALF + rest))

    def require_end(self) -> None:
        """Raise ``ValueError`` if numbers are left, as far as their coder can tell."""
        if not self._coder.maybe_exhausted():
            raise ValueError("a message holds more coded numbers than it says")

    def _even(self, n: int, size: int) -> IntArray:
        return self._decoded(coder_library().stream.model.Uniform(size), n)

    def _decoded(self, model: Any, n: int) -> IntArray:
        try:
            return np.asarray(self._coder.decode(model, n), dtype=np.int64)
        except AssertionError as error:
            raise ValueError(f"coded numbers are damaged: {error}") from error


def _chunks(low: int) -> list[tuple[int, int]]:
    """Shift and number of low bits that go out as they are, at most 16 at once."""
    return [(shift, min(16, low - shift)) for shift in range(0, low, 16)]


@cache
def _probabilities() -> npt.NDArray[np.float64]:
    """The curves (128, 255)."""
    squares = np.arange(-_MOST, _MOST + 1, dtype=np.float64) ** 2
    curves, scale = [], _SMALLEST
    for _ in range(_SCALES):
        for squarings in _SQUARINGS:
            power = 1.0 / (1.0 + squares / (2.0 * 2**squarings * scale * scale))
            for _ in range(squarings):
                power = power * power
            curves.append(power)
        scale *= _GROWTH
    return np.array(curves)


@cache
def _logarithms() -> npt.NDArray[np.float64]:
    """Logarithms of the curves' probabilities as the coder has them; only the writer's choice depends on them."""
    p = _probabilities()
    return np.asarray(np.log(p / p.sum(axis=1, keepdims=True) + 2.0**-24))


@cache
def _models() -> list[Any]:
    categorical = coder_library().stream.model.Categorical
    return [categorical(curve, perfect=False) for curve in _probabilities()]


@cache
def coder_library() -> Any:
    """The package constriction; ``ValueError`` that says what to install where it is not."""
    try:
        import constriction
    except ImportError as error:
        raise ValueError(ADVICE) from error
    return constriction
