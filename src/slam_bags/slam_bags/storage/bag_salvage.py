# SPDX-License-Identifier: Apache-2.0
"""Salvage of an mcap file that a killed recorder did not close: its whole records, with an end behind them.

Records are an opcode (1 byte), a length (8 bytes) and the content (MCAP specification, section Records).
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import BinaryIO

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER = struct.Struct("<BQQQI")
_BLOCK = 1 << 20


def is_whole_mcap(path: Path) -> bool:
    """True if the file ends as an mcap file does."""
    with path.open("rb") as file:
        file.seek(0, os.SEEK_END)
        if file.tell() < 2 * len(_MAGIC):
            return False
        file.seek(-len(_MAGIC), os.SEEK_END)
        return file.read() == _MAGIC


def salvage_mcap(source: Path, target: Path) -> int:
    """Copy the whole records of a truncated mcap file and close it with an empty footer; returns the bytes kept."""
    with source.open("rb") as old, target.open("wb") as new:
        end = _end_of_whole_records(old, source.stat().st_size)
        old.seek(0)
        for start in range(0, end, _BLOCK):
            new.write(old.read(min(_BLOCK, end - start)))
        new.write(_FOOTER.pack(0x02, 20, 0, 0, 0) + _MAGIC)
    return end


def _end_of_whole_records(file: BinaryIO, size: int) -> int:
    position = len(_MAGIC)
    while position + 9 <= size:
        file.seek(position)
        opcode, length = struct.unpack("<BQ", file.read(9))
        if opcode == 0x02 or position + 9 + length > size:
            break
        position += 9 + length
    return min(position, size)
