# SPDX-License-Identifier: Apache-2.0
"""One new session of a rig for the jump back of its clock, which each of its cameras tells for itself."""

from __future__ import annotations

from collections.abc import Iterable


class RigSessions:
    """Names of the cameras of a rig that have told of the present session."""

    def __init__(self, cameras: Iterable[str]) -> None:
        self._begun = set(cameras)

    def begins(self, camera: str) -> bool:
        """True if the rig begins anew: this camera, which has told of the session before, is the first to tell."""
        is_first = camera in self._begun
        self._begun = {camera} if is_first else self._begun | {camera}
        return is_first
