# SPDX-License-Identifier: Apache-2.0
"""The landmarks of a submap that its message for the air left out, for who asks for them.

Format, version 2, little endian: ``b"SD"``, u8 version, u32 CRC-32 of the rest; then

==================  ===================================================================================
u8, bytes           length of the agent's name, the name (UTF-8)
u32, u32, u32       session, index, and the CRC-32 in the submap's own message, which this is to be added to
u16, i8, f32        number of landmarks, power of two m of their grid, inflation t of all landmarks together
to the end          the landmarks' columns as in :mod:`slam_radio.packing.light_submap`, with its r and c
==================  ===================================================================================

Version 1 is read too: all ids are one column, the first one too.

Nothing of the submap's message is said again: its Gaussian goes on (``extended`` of
:mod:`slam_radio.packing.compact_gaussian`), by the same common directions.
"""

from __future__ import annotations

import struct

import numpy as np

from slam_core.types import Submap
from slam_radio.packing.byte_reader import ByteReader
from slam_radio.packing.compact_gaussian import MOST_INFLATION, extended
from slam_radio.packing.descriptor_code import encode
from slam_radio.packing.landmark_block import (
    MOST_LANDMARKS,
    LandmarkBlock,
    grid_exponent,
    half_step,
    on_grid,
    shown_sightings,
)
from slam_radio.packing.landmark_choice import choose_landmarks
from slam_radio.packing.light_submap import ENVELOPE, LightSubmap, opened, read, said_version, sealed, unknowns_of
from slam_radio.packing.symbol_code import SymbolReader, SymbolWriter

MAGIC, VERSION, _EARLIER = b"SD", 2, 1
_NAME = "details of a submap"
_NUMBERS, _COUNTS = struct.Struct("<III"), struct.Struct("<Hbf")


def pack_details(submap: Submap, light: LightSubmap, message: bytes) -> bytes | None:
    """The landmarks that a message left out; None where there are none.

    Parameters
    ----------
    submap
        A whole submap.
    light, message
        What is sent of it first, and its bytes.

    Raises
    ------
    ValueError
        If a number is too large for the format.
    """
    block, ids = light.landmarks, submap.landmark_ids
    known = np.array([int(np.nonzero(ids == i)[0][0]) for i in block.ids], dtype=np.int64)
    rows = np.setdiff1d(choose_landmarks(submap, MOST_LANDMARKS), known)
    rows = rows[np.argsort(ids[rows])][: MOST_LANDMARKS - len(known)]
    if not len(rows):
        return None
    covariance = submap.covariance[np.ix_(*2 * [unknowns_of(np.concatenate([known, rows]))])]
    n, k = len(known) + len(rows), np.arange(len(known), len(known) + len(rows))
    exponent = grid_exponent(covariance[6:, 6:].reshape(n, 3, n, 3)[k, :, k, :])
    cells = on_grid(submap.landmarks[rows], exponent)
    rays = np.ldexp(cells.astype(np.float64), exponent) - light.middle
    rounding = max(half_step(exponent), half_step(block.exponent))
    whole = extended(light.gaussian, covariance, rays, rounding)
    further = LandmarkBlock(
        exponent, cells, whole.factors[len(known) :], whole.common[6 + 3 * len(known) :], ids[rows].astype(np.int64),
        shown_sightings(submap.sightings[rows]), encode(submap.descriptors[rows], block.codes.shape[1]),
    )  # fmt: skip
    writer, name = SymbolWriter(), light.agent.encode()
    further.write(writer)
    checksum = ENVELOPE.unpack_from(message)[2]
    return sealed(MAGIC, VERSION, b"".join([
        struct.pack("<B", len(name)), name, _NUMBERS.pack(light.session, light.index, checksum),
        _COUNTS.pack(len(rows), exponent, whole.inflation), writer.bytes(),
    ]))  # fmt: skip


def key_of_details(data: bytes) -> tuple[int, int]:
    """Session and index of the submap that details are of; ``ValueError`` for damaged ones."""
    reader = ByteReader(_opened(data))
    reader.text(reader.number("<B"))
    session, index, _ = reader.numbers(_NUMBERS.format)
    return session, index


def with_details(message: bytes, data: bytes) -> Submap:
    """A submap of the air with the landmarks of its details behind its own.

    Raises
    ------
    ValueError
        If either is damaged or says what cannot be, or the details are of another message.
    """
    light, reader = read(message), ByteReader(_opened(data))
    of = (reader.text(reader.number("<B")), *reader.numbers(_NUMBERS.format))
    if of != (light.agent, light.session, light.index, ENVELOPE.unpack_from(message)[2]):
        raise ValueError(f"details of {of[0]} {of[1]}/{of[2]} are not of this submap's message")
    n, exponent, inflation = reader.numbers(_COUNTS.format)
    block = light.landmarks
    if not 1.0 <= inflation < MOST_INFLATION or not 0 < n <= MOST_LANDMARKS - len(block):
        raise ValueError(f"details of a submap cannot have {n} landmarks and a factor of {inflation}")
    symbols = SymbolReader(reader.bytes())
    rank, width = light.pose_common.shape[1], block.codes.shape[1]
    is_earlier = said_version(data, VERSION, _EARLIER) == _EARLIER
    further = LandmarkBlock.read(symbols, exponent, n, rank, width, has_ids_together=is_earlier)
    symbols.require_end()
    if np.isin(further.ids, block.ids).any():
        raise ValueError("details of a submap have a landmark that its message had")
    rays = further.points - light.middle
    return light.submap(light.gaussian.followed_by(further.factors, rays, further.common, inflation), further)


def _opened(data: bytes) -> bytes:
    return opened(data, MAGIC, said_version(data, VERSION, _EARLIER), _NAME)
