# SPDX-License-Identifier: Apache-2.0
"""The rigid transforms between the frames of a rig, from ``tf_static``; a missing one is never identity."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from slam_core.geometry import FloatArray, invert_transform, is_rigid_transform


class FrameTree:
    """Static transforms by (parent, child), looked up along any chain of them."""

    def __init__(self) -> None:
        self._neighbours: dict[str, dict[str, FloatArray]] = {}
        self._parents: dict[str, str] = {}
        self._found: dict[tuple[str, str], FloatArray] = {}

    def add(self, parent: str, child: str, T_parent_child: FloatArray) -> None:
        """Set or replace one transform (4, 4); a frame has one parent, so that an earlier one is forgotten."""
        if not is_rigid_transform(T_parent_child):
            raise ValueError(f"transform {parent} <- {child} is not rigid: {T_parent_child.tolist()}")
        self._found.clear()
        earlier = self._parents.get(child, parent)
        if earlier != parent:
            del self._neighbours[earlier][child], self._neighbours[child][earlier]
        self._parents[child] = parent
        self._neighbours.setdefault(parent, {})[child] = T_parent_child
        self._neighbours.setdefault(child, {})[parent] = invert_transform(T_parent_child)

    def __contains__(self, frame: str) -> bool:
        return frame in self._neighbours

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames, sorted."""
        return tuple(sorted(self._neighbours))

    def root(self, frame: str) -> str:
        """The frame without a parent above ``frame``, perhaps itself; ValueError if the frames form a cycle."""
        passed = [frame]
        while passed[-1] in self._parents:
            passed.append(self._parents[passed[-1]])
            if passed[-1] in passed[:-1]:
                raise ValueError(f"the frames {' -> '.join(passed)} form a cycle")
        return passed[-1]

    def below(self, base: str) -> dict[str, FloatArray]:
        """T_base_frame (4, 4) of every other frame that hangs together with ``base``, sorted by name."""
        found = {}
        for frame in self.frames if base in self else ():
            with suppress(ValueError):
                found[frame] = self.lookup(base, frame)
        return {frame: T for frame, T in found.items() if frame != base}

    def lookup(self, target: str, source: str) -> FloatArray:
        """T_target_source (4, 4).

        Raises
        ------
        ValueError
            If no chain of transforms joins the two frames.
        """
        if (target, source) not in self._found:
            self._found[target, source] = self._looked_up(target, source)
        return self._found[target, source].copy()

    def _looked_up(self, target: str, source: str) -> FloatArray:
        if target == source:
            return np.eye(4)
        reached: dict[str, FloatArray] = {target: np.eye(4)}
        waiting = [target]
        while waiting:
            frame = waiting.pop(0)
            for neighbour, T in self._neighbours.get(frame, {}).items():
                if neighbour not in reached:
                    reached[neighbour] = reached[frame] @ T
                    waiting.append(neighbour)
        if source not in reached:
            known = ", ".join(self.frames) or "none"
            raise ValueError(f"no transform from '{source}' to '{target}' (known frames: {known})")
        return reached[source]
