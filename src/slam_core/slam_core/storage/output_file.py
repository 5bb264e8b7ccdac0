# SPDX-License-Identifier: Apache-2.0
"""A JSON file of results that says which command wrote it, so that no other file is ever replaced."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slam_core.storage.files import atomic_text, read_json

_KEY = "written_by"


class OutputFile:
    """The file ``path`` for the results of ``command`` on ``source``.

    A file of the same command and source is replaced, another one of ours only with ``overwrite``.

    Raises
    ------
    ValueError
        If there is a file that must not be replaced.
    """

    def __init__(self, path: Path, command: str, source: str, *, overwrite: bool = False) -> None:
        self._path = path
        self._writer = {"program": "slam", "command": command, "source": source}
        writer = _writer_of(path) if path.exists() else self._writer
        if not writer:
            raise ValueError(f"{path} was not written by slam: choose another name")
        if writer != self._writer and not overwrite:
            whose = f"{writer.get('command')} {writer.get('source')}"
            raise ValueError(f"{path} holds the results of 'slam {whose}': choose another name, or say --overwrite")

    def write(self, content: Mapping[str, Any]) -> None:
        """Write the file, whole or not at all."""
        atomic_text(self._path, json.dumps({**content, _KEY: self._writer}, indent=2) + "\n")


def _writer_of(path: Path) -> dict[str, str]:
    """Name of the command that wrote a file; empty if it was not this program."""
    try:
        writer = read_json(path)[_KEY]
        return dict(writer) if writer["program"] == "slam" else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}
