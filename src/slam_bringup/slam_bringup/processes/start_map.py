# SPDX-License-Identifier: Apache-2.0
"""A map of an earlier run that nodes begin with: to go on in it, or to be located in it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sjsam_node.session.map_session import MapSession
from slam_bringup.pipeline.configuration import SystemConfig


@dataclass(frozen=True)
class StartMap:
    """The map in ``folder``, with its number of ``submaps`` and a ``session`` that none of its agents has had."""

    folder: Path
    localize_only: bool
    submaps: int
    session: int

    @classmethod
    def read(cls, config: SystemConfig, folder: Path | None, *, localize_only: bool) -> StartMap | None:
        """The map in ``folder``, None without one; ValueError if it holds no map, or an empty one."""
        if folder is None:
            return None
        with MapSession(config.sjsam) as session:
            session.load(folder, len).result()
            return cls(folder, localize_only, session.known, session.next_session)

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Parameters of the nodes by executable."""
        return {
            "sjsam": {"initial_map": str(self.folder), "localize_only": self.localize_only},
            "ekf_slam": {"session": self.session},
        }
