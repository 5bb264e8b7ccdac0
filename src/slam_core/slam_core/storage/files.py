# SPDX-License-Identifier: Apache-2.0
"""Files that are either whole or absent, written under a temporary name and then renamed; users' files, read with care.

Nothing here removes a folder that is not known to be ours: who replaces one says how to recognise it.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any

MOST_BYTES = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
"""Largest file that is read at once: half of the machine's memory."""

MOST_TEXT = 2**26
"""Largest JSON file; a YAML file, which takes a hundred times as long, is a quarter of it at most."""


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
        with naming(path):
            yield temporary
            _require_replaceable(path, may_replace)
            replace(temporary, path)
    finally:
        remove(temporary)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Have an OSError of the block that names no file, as that of a full disk, name ``path``."""
    try:
        yield
    except OSError as error:
        name_file(error, path)
        raise


def name_file(error: BaseException, path: Path) -> None:
    """Have an OSError that names no file name ``path``; any other error stays as it is."""
    if isinstance(error, OSError):
        error.filename = error.filename or str(path)


def state_folder(path: str, namespace: str) -> Path:
    """Folder of what a node keeps from start to start: the same wherever the node is started.

    A relative path is one below ``$XDG_STATE_HOME/indoor_slam`` (``~/.local/state/indoor_slam``) and the namespace.
    """
    given = Path(path).expanduser()
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return given if given.is_absolute() else state / "indoor_slam" / namespace.strip("/") / given


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
    """SHA-256 of a regular file's bytes, hexadecimal."""
    with _open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_bytes(path: Path, at_most: int = MOST_BYTES) -> bytes:
    """Content of a regular file.

    Raises
    ------
    ValueError
        If it has more than ``at_most`` bytes, or is a pipe, a device or a folder: reading may never end.
    OSError
        If it cannot be opened.
    """
    with _open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > at_most:
            raise ValueError(f"{path} has {size} bytes, more than the {at_most} that such a file may have")
        return file.read(size)


def read_text(path: Path, at_most: int = MOST_BYTES, errors: str = "strict") -> str:
    """Text of a regular file in UTF-8, with or without a byte-order mark; raises as :func:`read_bytes`."""
    return read_bytes(path, at_most).decode("utf-8-sig", errors)


def read_json(path: Path, at_most: int = MOST_TEXT) -> Any:
    """Value of a JSON file; ValueError if it is none, too large or nested too deeply."""
    try:
        return json.loads(read_text(path, at_most))
    except RecursionError:
        raise ValueError(f"{path}: nested too deeply to be a file of ours") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not JSON: {error}") from error


def read_yaml(path: Path, at_most: int = MOST_TEXT // 4) -> Any:
    """Value of a YAML file, None if it is empty; ValueError if it is none, too large or nested too deeply."""
    import yaml  # 20 ms, which most who write files need not spend

    try:
        return yaml.safe_load(read_text(path, at_most))
    except RecursionError:
        raise ValueError(f"{path}: nested too deeply to be a file of ours") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not YAML: {str(error).splitlines()[0]}") from error


class PathLock:
    """Keeps ``path`` for this process, until it is released or the process ends, however it does.

    What is locked is a file ``.NAME.lock`` beside it, which holds the number of the process.

    Raises
    ------
    ValueError
        If another process, or another lock of this one, keeps the path, or nothing can be written beside it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path.with_name(f".{path.name}.lock")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            while not self._try():
                pass
        except BlockingIOError:
            owner = read_text(self._path, 100, errors="replace").strip() or "unknown"
            raise ValueError(f"{path} is in use by another process, number {owner}") from None
        except OSError as error:
            raise ValueError(f"{path} cannot be written: {error}") from error

    def _try(self) -> bool:
        """Lock the file; False if another process has removed it meanwhile."""
        self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not self._path.exists() or not os.path.samestat(os.fstat(self._file), self._path.stat()):
                os.close(self._file)
                return False
        except BlockingIOError:
            os.close(self._file)
            raise
        os.truncate(self._file, 0)
        os.write(self._file, f"{os.getpid()}\n".encode())
        return True

    def release(self) -> None:
        """Let others have the path; nothing is left beside it."""
        if self._file >= 0:
            self._path.unlink(missing_ok=True)
            os.close(self._file)
            self._file = -1


@contextmanager
def _open_regular(path: Path) -> Iterator[BufferedReader]:
    """Open a file for reading, without waiting for a pipe's other end; ValueError where there is no regular file."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise ValueError(f"{path} is {'a folder' if path.is_dir() else 'a pipe or a device'}: a file is needed")
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        yield file


def _require_replaceable(path: Path, may_replace: Callable[[Path], bool]) -> None:
    if path.is_dir() and any(path.iterdir()) and not may_replace(path):
        raise ValueError(f"{path} is a folder with other files in it, which would be lost: choose another name")
