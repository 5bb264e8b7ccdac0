# SPDX-License-Identifier: Apache-2.0
"""Mark of the bags that this program wrote: only these may be replaced.

A folder's are in ``metadata.yaml``; those of a single mcap file are the same text in its record "rosbag2" (MCAP
specification: footer, summary section, metadata index, metadata).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, BinaryIO

import yaml

from slam_bags.storage.bag_calibration import FILE_NAME

OWNER = ("written_by", "slam")
"""Key and value in the custom data of the bag's metadata."""

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _METADATA, _METADATA_INDEX = 0x02, 0x0C, 0x0D
_FOOTER_BYTES = 9 + 20 + len(_MAGIC)


def require_free(path: Path, *, overwrite: bool) -> None:
    """Refuse to write a bag to ``path`` where that would remove anything.

    Raises
    ------
    ValueError
        If something is there; with ``overwrite`` unless it is a bag that this program wrote, with nothing added.
    """
    is_empty_folder = path.is_dir() and path.suffix != ".mcap" and not any(path.iterdir())
    if not path.exists() or is_empty_folder:
        return
    if not overwrite:
        raise ValueError(f"{path} exists: choose another name, or say --overwrite")
    if not is_own_bag(path):
        raise ValueError(f"{path} is not a bag that slam wrote, or other files are with it: choose another name")


def is_own_bag(path: Path) -> bool:
    """True if a folder or mcap file is a bag that this program wrote, and holds nothing else."""
    try:
        if path.is_file():
            return _is_own(yaml.safe_load(_mcap_metadata(path)))
        information = yaml.safe_load((path / "metadata.yaml").read_text(encoding="utf-8"))
        information = information["rosbag2_bagfile_information"]
        return _is_own(information) and _holds_only(path, information)
    except (OSError, ValueError, KeyError, TypeError, struct.error, yaml.YAMLError):
        return False


def _is_own(information: dict[str, Any]) -> bool:
    key, value = OWNER
    return bool((information["custom_data"] or {}).get(key) == value)


def _holds_only(folder: Path, information: dict[str, Any]) -> bool:
    """True for the bag's own files; that of the calibration is as it was written."""
    calibration = information["custom_data"].get(FILE_NAME, "")
    own = [FILE_NAME] if calibration and (folder / FILE_NAME).read_text(encoding="utf-8") == calibration else []
    return {p.name for p in folder.iterdir()} <= {"metadata.yaml", *own, *information["relative_file_paths"]}


def _mcap_metadata(path: Path) -> str:
    """The text of the record "rosbag2"; ValueError if the file has none."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(size - _FOOTER_BYTES)
        opcode, content = _record(file)
        if opcode != _FOOTER:
            raise ValueError(f"{path} does not end as an mcap file does")
        file.seek(struct.unpack_from("<Q", content)[0])
        while file.tell() < size - _FOOTER_BYTES:
            opcode, content = _record(file)
            if opcode == _METADATA_INDEX:
                file.seek(struct.unpack_from("<Q", content)[0])
                return _serialized_metadata(_record(file)[1])
    raise ValueError(f"{path} has no metadata")


def _record(file: BinaryIO) -> tuple[int, bytes]:
    opcode, length = struct.unpack("<BQ", file.read(9))
    return opcode, file.read(length)


def _serialized_metadata(content: bytes) -> str:
    """Value of a metadata record: after its name and the length of a map, strings in turn key and value."""
    name, position = _string(content, 0)
    key, position = _string(content, position + 4)
    value, _ = _string(content, position)
    if (name, key) != ("rosbag2", "serialized_metadata"):
        raise ValueError(f"metadata of {name} hold {key}")
    return value


def _string(content: bytes, position: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, position)
    end = position + 4 + length
    return content[position + 4 : end].decode("utf-8"), end
