# SPDX-License-Identifier: Apache-2.0
"""Files that are either whole or absent: written under a temporary name, then renamed.

Nothing here removes a folder that is not known to be ours: who replaces one says how to recognise it.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path


def _never(_path: Path) -> bool:
    return False


@contextmanager
def atomic_path(path: Path, may_replace: Callable[[Path], bool] = _never) -> Iterator[Path]:
    """A temporary path beside ``path`` that becomes ``path`` when the block ends well, and vanishes when it does not.

    The block may make a file or a folder of it. A file replaces a file. A folder replaces a folder that is empty or
    that ``may_replace`` says is ours.

    Raises
    ------
    ValueError
        Before and after the block, if what is at ``path`` would have to be removed and is not ours.
    """
    _require_replaceable(path, may_replace)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part{path.suffix}")
    remove(temporary)
    try:
        yield temporary
        _require_replaceable(path, may_replace)
        replace(temporary, path)
    finally:
        remove(temporary)


def atomic_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 with Unix line ends, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def replace(new: Path, path: Path) -> None:
    """Rename ``new`` to ``path``; what was there is put aside first and removed last, so that one of them survives."""
    old = path.with_name(f".{path.name}.{os.getpid()}.old")
    folder_is_there = path.is_dir() and not path.is_symlink()
    if folder_is_there and new.is_file():
        raise ValueError(f"{path} is a folder; a file cannot take its place")
    if folder_is_there:
        os.replace(path, old)
    os.replace(new, path)
    remove(old)


def remove(path: Path) -> None:
    """Remove a file, a link or a folder with all in it; nothing happens if there is none."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def digest(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _require_replaceable(path: Path, may_replace: Callable[[Path], bool]) -> None:
    if path.is_dir() and any(path.iterdir()) and not may_replace(path):
        raise ValueError(f"{path} is a folder with other files in it, which would be lost: choose another name")
