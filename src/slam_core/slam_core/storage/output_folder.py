# SPDX-License-Identifier: Apache-2.0
"""A folder of results in which only what this program wrote is ever replaced or removed.

    with OutputFolder(path, "run", source=bag) as output:  # ValueError if the folder is not ours
        with output.staged() as folder:                    # whatever is put there moves to path when all is done
            ...

``.slam.json`` lists what was written, with digests. A folder that has files but no list is refused. Results of the same
command on the same source are replaced; other results, or files changed since they were written, only with
``overwrite``. Files that a user added stay, and a program killed at any moment leaves the old results or the new ones;
the file ``last`` (``summary.json``) is absent in between. What a killed program was making ready (``.slam.*.part``) is
removed by the next one on the same machine; of another machine nobody can tell here if it has ended, so that stays.
"""

from __future__ import annotations

import json
import os
import socket
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Any, Self

from slam_core.storage.files import digest, naming, read_json, remove

MANIFEST = ".slam.json"
LOGS = "logs"
_OWN_PREFIX = ".slam."
_STAGING = ".slam.{pid}.{token}.{host}.part"
"""Name of a folder in which results are made ready: workers on several machines may have the same process id."""


@dataclass(frozen=True)
class Manifest:
    """Files of ours in a folder. ``files``: relative name to digests that mark it as unchanged; none: any content."""

    command: str
    source: str
    files: dict[str, list[str]] = field(default_factory=dict)

    @classmethod
    def read(cls, folder: Path) -> Manifest | None:
        """The list of a folder; None where there is none. ValueError if it is damaged or names files elsewhere."""
        path = folder / MANIFEST
        if not path.is_file():
            return None
        try:
            content: dict[str, Any] = read_json(path)
            files = {str(name): [str(d) for d in digests] for name, digests in content["files"].items()}
            manifest = cls(str(content["command"]), str(content["source"]), files)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} is damaged, so what is ours in {folder} is not known: choose another") from error
        if any(PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts for name in manifest.files):
            raise ValueError(f"{path} names files outside of {folder}: choose another folder")
        return manifest

    def write(self, folder: Path) -> None:
        """Write the list, whole or not at all."""
        content = {"program": "slam", "command": self.command, "source": self.source, "files": self.files}
        temporary = folder / _part_name()
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        os.replace(temporary, folder / MANIFEST)


class OutputFolder:
    """The folder ``path`` for the results of one command; use it in a ``with`` block.

    Parameters
    ----------
    path
        Absent, empty, or with results of ours.
    command
        Name of the command that writes.
    source
        What it works on; results of the same command on the same source may be replaced.
    overwrite
        Replace other results of ours as well, and results that were changed since.
    last
        The file that is moved last: a folder that has it is complete.

    Raises
    ------
    ValueError
        If the folder holds files that are not ours, or results that must not be replaced; nothing is changed then.
    """

    def __init__(
        self, path: Path, command: str, source: Path | str = "", *, overwrite: bool = False, last: str = "summary.json"
    ) -> None:
        self.path = path
        self._last = last
        source = str(source.resolve()) if isinstance(source, Path) else source
        self._old = _require_ours(path, command, source, overwrite)
        results = {name: digests for name, digests in self._old.files.items() if digests}
        self._manifest = Manifest(command, source, results)
        self._made_here = not path.exists()
        self._staging = path / _part_name()
        self.rescued: Path | None = None
        """Results that were given up, as far as :meth:`staged` kept them."""

    def __enter__(self) -> Self:
        self.path.mkdir(parents=True, exist_ok=True)
        self._manifest.write(self.path)
        for leftover in self.path.glob(f"{_OWN_PREFIX}*.part"):
            if _is_abandoned(leftover.name):
                remove(leftover)
        for log in self._old.files.keys() - self._manifest.files.keys():
            _unlink(self.path, log)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        remove(self._staging)
        logs = [p for p in self._logs.glob("*") if p.is_file()] if self._logs.is_dir() else []
        if kind is not None and self._made_here and not logs and _remove_if_empty(self.path):
            return
        self._write(self._known() | {f"{LOGS}/{log.name}": [] for log in logs if log.suffix == ".log"})

    @property
    def logs(self) -> Path:
        """The folder of log files, ``path/logs``; they are written in place."""
        self._logs.mkdir(exist_ok=True)
        return self._logs

    @contextmanager
    def staged(self, rescue: str = "") -> Iterator[Path]:
        """A new folder whose files move into ``path`` when the block ends well, and vanish when it does not.

        A user who gives up (KeyboardInterrupt) keeps the file or folder named ``rescue`` if it is there; what must be
        whole has to come there by a rename.
        """
        remove(self._staging)
        self._staging.mkdir()
        with naming(self.path):
            try:
                yield self._staging
            except KeyboardInterrupt:
                if rescue and (self._staging / rescue).exists():
                    self._rescue(rescue)
                raise
            self._commit()

    def _rescue(self, name: str) -> None:
        self.rescued, self._made_here = free_name(self.path / name), False
        os.replace(self._staging / name, self.rescued)
        found = [f for f in (self.rescued, *sorted(self.rescued.rglob("*"))) if f.is_file()]
        self._write(self._manifest.files | {str(f.relative_to(self.path)): [digest(f)] for f in found})

    @property
    def _logs(self) -> Path:
        return self.path / LOGS

    def _commit(self) -> None:
        """The list first, so that everything is known as ours at any moment; the last file last."""
        new = {str(f.relative_to(self._staging)): digest(f) for f in sorted(self._staging.rglob("*")) if f.is_file()}
        old = self._known()
        self._keep_apart_if_taken([name for name in new if _is_taken(self.path, name, is_ours=name in old)])
        both = {name: [*old.get(name, []), *([new[name]] if name in new else [])] for name in {**old, **new}}
        self._write(both)
        for name in sorted(old.keys() - new.keys() | {self._last}, key=self._in_order, reverse=True):
            _unlink(self.path, name)
        for name in sorted(new, key=self._in_order):
            (self.path / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(self._staging / name, self.path / name)
        self._write({name: [value] for name, value in new.items()})

    def _in_order(self, name: str) -> tuple[bool, str]:
        return name == self._last, name

    def _keep_apart_if_taken(self, taken: list[str]) -> None:
        if not taken:
            return
        kept = free_name(self.path / "results")
        os.replace(self._staging, kept)
        raise ValueError(f"{self.path / taken[0]} was not written by slam and stays: the results are in {kept}")

    def _known(self) -> dict[str, list[str]]:
        """Files of ours, with those that another worker has written for the same command meanwhile."""
        own, there = self._manifest, Manifest.read(self.path)
        if there is None or (there.command, there.source) != (own.command, own.source):
            return dict(own.files)
        return {name: list(dict.fromkeys([*there.files.get(name, []), *own.files.get(name, [])]))
                for name in {**there.files, **own.files}}  # fmt: skip

    def _write(self, files: dict[str, list[str]]) -> None:
        self._manifest = Manifest(self._manifest.command, self._manifest.source, files)
        self._manifest.write(self.path)


def free_name(path: Path) -> Path:
    """``path``, or the first of ``<stem>_1``, ``<stem>_2``, ... that does not exist."""
    candidate, number = path, 0
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{path.stem}_{number}{path.suffix}")
    return candidate


def _require_ours(path: Path, command: str, source: str, overwrite: bool) -> Manifest:
    """The list of what is in ``path``, empty where there is nothing; ValueError if that must not be replaced."""
    if path.exists() and not path.is_dir():
        raise ValueError(f"{path} is a file, a folder is to be written: choose another name")
    nearest = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ValueError(f"cannot write to {path}: {nearest} is not a folder that you may write to")
    manifest = Manifest.read(path)
    if manifest is None:
        foreign = sorted(p.name for p in path.iterdir() if not p.name.startswith(_OWN_PREFIX)) if path.exists() else []
        if foreign:
            raise ValueError(f"{path} holds files that slam did not write ({_few(foreign)}): choose another folder")
        return Manifest(command, source)
    if overwrite or not any(manifest.files.values()):
        return manifest
    if (manifest.command, manifest.source) != (command, source):
        whose = f"{manifest.command} {manifest.source}".strip()
        raise ValueError(f"{path} holds the results of 'slam {whose}': choose another folder, or say --overwrite")
    if changed := [name for name in manifest.files if not _is_unchanged(path, name, manifest.files[name])]:
        raise ValueError(
            f"{path} holds results that were changed since ({_few(changed)}): choose another folder, or say --overwrite"
        )
    return manifest


def _is_unchanged(folder: Path, name: str, digests: list[str]) -> bool:
    file = folder / name
    if file.is_symlink():
        return False
    return not digests or not file.exists() or (file.is_file() and digest(file) in digests)


def _is_taken(folder: Path, name: str, *, is_ours: bool) -> bool:
    """True if a file of that name cannot be put there without touching what is not ours."""
    file, parents = folder / name, [folder / p for p in PurePosixPath(name).parents if str(p) != "."]
    in_the_way = file.is_dir() or any(p.is_symlink() or p.is_file() for p in parents)
    return in_the_way or (os.path.lexists(file) and not is_ours)


def _unlink(folder: Path, name: str) -> None:
    """Remove one of our files, and the folders that it leaves empty."""
    file = folder / name
    if any((folder / p).is_symlink() for p in PurePosixPath(name).parents) or file.is_dir():
        return
    file.unlink(missing_ok=True)
    for parent in [folder / p for p in PurePosixPath(name).parents if str(p) != "."]:
        if not parent.is_dir() or any(parent.iterdir()):
            break
        parent.rmdir()


def _remove_if_empty(folder: Path) -> bool:
    """Remove a folder in which nothing but our own list is; False where there is more, which stays with the list."""
    logs = folder / LOGS
    if logs.is_dir() and not any(logs.iterdir()):
        logs.rmdir()
    if any(path.name != MANIFEST for path in folder.iterdir()):
        return False
    (folder / MANIFEST).unlink(missing_ok=True)
    folder.rmdir()
    return True


def _part_name() -> str:
    """Name of what is not complete yet, of this process alone."""
    return _STAGING.format(pid=os.getpid(), token=uuid.uuid4().hex[:8], host=socket.gethostname())


def _is_abandoned(name: str) -> bool:
    """True if what has such a name was left by a process of this machine that has ended."""
    pid, _, rest = name.removeprefix(_OWN_PREFIX).removesuffix(".part").partition(".")
    host = rest.partition(".")[2]
    return host in ("", socket.gethostname()) and not _is_running(pid)


def _is_running(pid: str) -> bool:
    try:
        os.kill(int(pid), 0)
    except (ProcessLookupError, ValueError):
        return False
    except PermissionError:
        return True
    return True


def _few(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
