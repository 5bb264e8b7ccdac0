# SPDX-License-Identifier: Apache-2.0
"""Commands that other installed packages register at ``slam``.

A distribution names a table in the entry point group ``slam.commands``: command to (module that holds its ``command``,
one line of help). The table is light; the module is loaded when the command is called.
"""

from __future__ import annotations

import importlib
import logging
import os
import sys
from collections.abc import Iterator
from functools import cache

_GROUP = "[slam.commands]"
_LOG = logging.getLogger(__name__)


@cache
def registered_commands() -> dict[str, tuple[str, str]]:
    """Module and help of each command, by name.

    Read from ``entry_points.txt`` here: ``importlib.metadata`` reads the same, and takes 60 ms of ``slam --help`` to be
    loaded and to read what it does not need; this takes 4 ms.
    """
    commands: dict[str, tuple[str, str]] = {}
    for entry in dict.fromkeys(_entries()):
        module, _, name = entry.partition(":")
        try:
            commands |= getattr(importlib.import_module(module), name)
        except ImportError as error:  # what is left of a package that is gone
            _LOG.debug("commands of %s: %s", module, error)
    return commands


def _entries() -> Iterator[str]:
    """``module:name`` of every table."""
    for folder in dict.fromkeys(sys.path):
        try:
            names = sorted(name for name in os.listdir(folder or ".") if name.endswith((".dist-info", ".egg-info")))
        except OSError:
            continue
        for name in names:
            try:
                with open(os.path.join(folder, name, "entry_points.txt"), encoding="utf-8") as file:
                    group = file.read().partition(_GROUP)[2].partition("\n[")[0]
            except OSError:
                continue
            yield from (line.partition("=")[2].strip() for line in group.splitlines() if "=" in line)
