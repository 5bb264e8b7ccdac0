# SPDX-License-Identifier: Apache-2.0
"""Numbers come out as they went in, in about as many bits as they are worth."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from slam_radio.packing import symbol_code
from slam_radio.packing.symbol_code import LARGEST, SymbolReader, SymbolWriter


def test_columns_of_all_widths_come_out_in_order(rng):
    bells = np.rint(rng.normal(size=(390, 6)) * [0.0, 0.2, 3.0, 10.0, 25.0, 1.0]).astype(np.int64)
    single = [
        rng.integers(-(2**29), 2**29, 50), np.zeros(9, dtype=np.int64), np.array([5]), np.array([-LARGEST // 2, 0]),
        np.array([0, 0, -(2**14)]), np.rint(4.0 * rng.standard_cauchy(200)).astype(np.int64),
        np.empty(0, dtype=np.int64), np.arange(-255, 256),
    ]  # fmt: skip
    writer = SymbolWriter()
    writer.columns(bells)
    for values in single:
        writer.column(values)
    reader = SymbolReader(writer.bytes())
    np.testing.assert_array_equal(reader.columns(390, 6), bells)
    for values in single:
        np.testing.assert_array_equal(reader.column(len(values)), values)
    reader.require_end()


@pytest.mark.parametrize("sigma", [0.3, 2.0, 20.0])
def test_a_bell_curve_costs_little_more_than_its_entropy(rng, sigma):
    values = np.rint(sigma * rng.normal(size=(4000, 1))).astype(np.int64)
    share = np.unique(values, return_counts=True)[1] / len(values)
    writer = SymbolWriter()
    writer.columns(values)
    assert len(writer.bytes()) < 1.04 * -(share * np.log2(share)).sum() * len(values) / 8 + 8


def test_what_is_too_large_is_refused():
    writer = SymbolWriter()
    with pytest.raises(ValueError, match="symbols reach"):
        writer.columns(np.array([[128]]))
    with pytest.raises(ValueError, match="too large to be sent"):
        writer.column(np.array([LARGEST, 0]))


def test_bytes_of_nobody_give_numbers_or_a_value_error(rng):
    for _ in range(300):
        data = rng.bytes(4 * int(rng.integers(0, 60)))
        try:
            reader = SymbolReader(data)
            assert np.abs(reader.columns(20, 4)).max() <= 127
            reader.column(10)
            reader.require_end()
        except ValueError:
            pass
    with pytest.raises(ValueError, match="groups of 4 bytes"):
        SymbolReader(b"abc")


def test_the_curves_are_the_same_on_every_machine():
    """Only sums, products and quotients: their bits are part of the format."""
    curves = symbol_code._probabilities()
    assert curves.shape == (128, 255)
    assert curves[:, 127].tolist() == [1.0] * 128
    assert [float(curves[k, 128]).hex() for k in (0, 41, 127)] == [
        "0x1.83c977ab2bedep-10",
        "0x1.30600d8a7cf5bp-1",
        "0x1.fffbe106e7431p-1",
    ]


def test_without_the_coder_a_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "constriction", None)
    symbol_code.coder_library.cache_clear()
    with pytest.raises(ValueError, match="pip install constriction"):
        SymbolWriter()
    symbol_code.coder_library.cache_clear()
