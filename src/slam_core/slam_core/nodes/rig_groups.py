# SPDX-License-Identifier: Apache-2.0
"""Features or scans of the cameras of one rig, in any order, as groups of one moment in the order of their stamps.

    front -> features or scans --> those whose stamps belong together -> one group
    back --> features or scans --^

Cameras need not have one rate: what has no counterpart is a group of its own. A camera that falls silent holds the
others up for a few frames only, and takes part again when it comes back. One whose stamps never are those of the first
camera that is heard has no common trigger with it: it is left out, and that is told.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Generic, Protocol, TypeVar

from slam_core.nodes.awaited_streams import PATIENCE, AwaitedStreams
from slam_core.nodes.synchronizer import PAIRING_TOLERANCE_S
from slam_core.rig_features import MOST_CAMERAS

_ALONE = 2
"""Groups in a row of cameras without the common trigger alone, after which these are used."""


class Stamped(Protocol):
    """Anything of one moment."""

    @property
    def stamp_ns(self) -> int:
        """Header stamp, ns."""
        ...


T = TypeVar("T", bound=Stamped)


class RigGroups(Generic[T]):
    """Groups of what has stamps no farther apart than those of a stereo pair may be.

    Parameters
    ----------
    cameras
        Names of the cameras.
    patience
        Frames that may wait for a camera before they go on without it.

    Raises
    ------
    ValueError
        If a name is given twice or there are too many.
    """

    def __init__(self, cameras: Sequence[str], patience: int = PATIENCE) -> None:
        if len(set(cameras)) < len(cameras) or len(cameras) > MOST_CAMERAS:
            raise ValueError(f"cameras must be at most {MOST_CAMERAS} different names, got {', '.join(cameras)}")
        self._cameras = tuple(cameras)
        self._tolerance_ns = round(PAIRING_TOLERANCE_S * 1e9)
        self._awaited = AwaitedStreams([_stream(camera) for camera in cameras], patience)
        self.clear()

    def clear(self) -> None:
        """Forget what waits, and wait for all cameras anew."""
        self._awaited.clear()
        self._queues: dict[str, deque[T]] = {camera: deque() for camera in self._cameras}
        self._in_step: set[int] = set()
        self._in_a_row = 0
        self._out_of_step: dict[int, int] = {}
        self._newest_frame_ns = -self._tolerance_ns
        self._done_ns = -1

    def add(self, camera: str, item: T) -> bool:
        """Take what one camera gives; False if they come too late, after the frame that they belong to.

        Raises
        ------
        ValueError
            If the rig has no such camera.
        """
        if camera not in self._queues:
            raise ValueError(f"the rig has no camera '{camera}', only {', '.join(self._cameras)}")
        queue, stamp = self._queues[camera], item.stamp_ns
        if stamp <= self._done_ns or (queue and stamp <= queue[-1].stamp_ns):
            return False
        queue.append(item)
        self._awaited.heard(_stream(camera), stamp)
        if stamp > self._newest_frame_ns + self._tolerance_ns:
            self._newest_frame_ns = stamp
            self._awaited.frame(stamp)
        return True

    def ready(self) -> Iterator[list[tuple[int, T]]]:
        """The groups that need wait for no camera, oldest first: numbers of cameras, and what they gave."""
        while True:
            stamps = [queue[0].stamp_ns for queue in self._queues.values() if queue]
            if not stamps or self._awaited.must_wait(min(stamps)):
                return
            last = min(stamps) + self._tolerance_ns
            parts = [
                (k, queue.popleft())
                for k, queue in enumerate(self._queues.values())
                if queue and queue[0].stamp_ns <= last
            ]
            self._done_ns = max(item.stamp_ns for _, item in parts)
            if used := self._in_step_with_first(parts):
                yield used

    def _in_step_with_first(self, parts: list[tuple[int, T]]) -> list[tuple[int, T]]:
        """Parts of a group whose cameras have shared a stamp with the first camera that is heard."""
        numbers = {number for number, _ in parts}
        if not self._in_step or numbers & self._in_step:
            self._in_step |= numbers
        self._in_a_row = 0 if numbers & self._in_step else self._in_a_row + 1
        if self._in_a_row > _ALONE:  # all others are gone, not only over
            self._in_step |= numbers
        for number in numbers - self._in_step:
            self._out_of_step[number] = self._out_of_step.get(number, 0) + 1
        return [(number, item) for number, item in parts if number in self._in_step]

    @property
    def left_out(self) -> int:
        """Number of frames left out of cameras without a common trigger."""
        return sum(self._out_of_step.values())

    def give_up(self) -> None:
        """Stop waiting for the cameras that are behind, until they are heard again."""
        stamps = [queue[-1].stamp_ns for queue in self._queues.values() if queue]
        if stamps:
            self._awaited.give_up(max(stamps))

    @property
    def oldest_waiting_ns(self) -> int | None:
        """Stamp of the oldest that waits for another camera."""
        return min((queue[0].stamp_ns for queue in self._queues.values() if queue), default=None)

    @property
    def diagnostic(self) -> str:
        """Names of the cameras that have fallen silent or have no common trigger with the first, or ""."""
        apart = [camera for k, camera in enumerate(self._cameras) if k in self._out_of_step and k not in self._in_step]
        told = [f"camera {camera} has no common trigger with the others, it is not used" for camera in apart]
        return "; ".join([*filter(None, [self._awaited.diagnostic()]), *told])


def _stream(camera: str) -> str:
    return f"camera {camera}"
