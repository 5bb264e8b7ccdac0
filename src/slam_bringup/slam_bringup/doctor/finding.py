# SPDX-License-Identifier: Apache-2.0
"""One thing that is wrong with a recording."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A fault, and its remedy.

    check: short name, the same for the same kind of fault. prevents_mapping: whether no map can come of it.
    """

    check: str
    what: str
    advice: str
    prevents_mapping: bool = False

    def __str__(self) -> str:
        return f"{self.check}: {self.what}; {self.advice}"
