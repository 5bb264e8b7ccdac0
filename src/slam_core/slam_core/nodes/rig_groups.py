# SPDX-License-Identifier: Apache-2.0
"""Features or scans of the cameras of one rig, in any order, as groups of one moment in the order of their stamps.

    front -> features or scans --> those whose stamps belong together -> one group
    back --> features or scans --^

Cameras need not have one rate: what has no counterpart is a group of its own. A camera that falls silent holds the
others up for a few frames only, and takes part again when it comes back. One whose stamps never are those of the first
camera that is heard has no common trigger with it: it is left out, and that is told.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from typing import Generic, TypeVar

from slam_core.nodes.awaited_streams import PATIENCE, AwaitedStreams, Stamped
from slam_core.nodes.synchronizer import PAIRING_TOLERANCE_S
from slam_core.rig_features import MOST_CAMERAS

_ALONE = 2
"""Frames of a camera without the common trigger, beyond ``patience`` and unheard the others, after which it is used."""


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
        self._patience = patience
        self._tolerance_ns = round(PAIRING_TOLERANCE_S * 1e9)
        self._awaited = AwaitedStreams([_stream(camera) for camera in cameras], patience)
        self.clear()

    def clear(self) -> None:
        """Forget what waits, and wait for all cameras anew."""
        self._awaited.clear()
        self._queues: dict[str, deque[T]] = {camera: deque() for camera in self._cameras}
        self._in_step: set[str] = set()
        self._unheard: Counter[str] = Counter()
        self._out_of_step: Counter[str] = Counter()
        self._newest_frame_ns = -self._tolerance_ns
        self._done_ns = -1

    def restart(self, camera: str) -> None:
        """Forget what waits of one camera, whose clock has jumped back; ValueError if the rig has no such camera."""
        self._require(camera)
        self._queues[camera].clear()
        self._awaited.forget(_stream(camera))

    def add(self, camera: str, item: T) -> bool:
        """Take what one camera gives; False if they come too late, after the frame that they belong to.

        Raises
        ------
        ValueError
            If the rig has no such camera.
        """
        self._require(camera)
        queue, stamp = self._queues[camera], item.stamp_ns
        if stamp <= self._done_ns or (queue and stamp <= queue[-1].stamp_ns):
            return False
        queue.append(item)
        self._awaited.heard(_stream(camera), stamp)
        if not self._in_step or camera in self._in_step:
            self._unheard = Counter({camera: self._unheard[camera] + 1})
            self._count_frame(stamp)
        else:
            self._wait_out_of_step(camera)
        return True

    def _require(self, camera: str) -> None:
        if camera not in self._queues:
            raise ValueError(f"the rig has no camera '{camera}', only {', '.join(self._cameras)}")

    def ready(self) -> Iterator[list[tuple[int, T]]]:
        """The groups that need wait for no camera, oldest first: numbers of cameras, and what they gave."""
        while (oldest := self.oldest_waiting_ns) is not None and not self._awaited.must_wait(oldest):
            for camera in self._cameras:
                if self._in_step and camera not in self._in_step:
                    self._drop(camera, before_ns=oldest - self._tolerance_ns)
            heads = {camera: queue[0].stamp_ns for camera, queue in self._queues.items() if queue}
            last = min(heads.values()) + self._tolerance_ns
            together = [camera for camera, stamp in heads.items() if stamp <= last]
            parts = [(self._cameras.index(camera), self._queues[camera].popleft()) for camera in together]
            self._done_ns = max(item.stamp_ns for _, item in parts)
            self._use(together)
            yield parts

    def _count_frame(self, stamp_ns: int) -> None:
        """Note a frame of the cameras that are in step, unless one of them has had it."""
        if stamp_ns > self._newest_frame_ns + self._tolerance_ns:
            self._newest_frame_ns = stamp_ns
            self._awaited.frame(stamp_ns)

    def _use(self, cameras: Sequence[str]) -> None:
        """Count cameras as in step from now on; frames of others make nobody wait or too late."""
        if self._in_step.issuperset(cameras):
            return
        self._in_step.update(cameras)
        self._awaited.forget_frames()
        self._newest_frame_ns = self._done_ns
        for stamp in sorted(item.stamp_ns for camera in self._in_step for item in self._queues[camera]):
            self._count_frame(stamp)

    def _wait_out_of_step(self, camera: str) -> None:
        """Keep a few frames of a camera that may yet have the trigger; all others gone, not only over, it is used."""
        self._unheard[camera] += 1
        queue = self._queues[camera]
        if len(queue) >= max(self._patience, 2):  # fewer than make others count as silent
            self._drop(camera, before_ns=queue[1].stamp_ns)
        if self._unheard[camera] > self._patience + _ALONE:
            self._use([camera])
            self._awaited.give_up(queue[-1].stamp_ns)

    def _drop(self, camera: str, before_ns: int) -> None:
        """Leave out what a camera without the common trigger gave before a moment."""
        queue = self._queues[camera]
        while queue and queue[0].stamp_ns < before_ns:
            queue.popleft()
            self._out_of_step[camera] += 1

    @property
    def left_out(self) -> int:
        """Number of frames left out of cameras without a common trigger."""
        return self._out_of_step.total()

    def give_up(self) -> None:
        """Stop waiting for the cameras that are behind, until they are heard again."""
        stamps = [queue[-1].stamp_ns for queue in self._counted() if queue]
        if stamps:
            self._awaited.give_up(max(stamps))

    @property
    def oldest_waiting_ns(self) -> int | None:
        """Stamp of the oldest that waits for another camera."""
        return min((queue[0].stamp_ns for queue in self._counted() if queue), default=None)

    def _counted(self) -> list[deque[T]]:
        """Queues of the cameras in step, of all before the first group."""
        return [queue for camera, queue in self._queues.items() if not self._in_step or camera in self._in_step]

    @property
    def diagnostic(self) -> str:
        """Names of the cameras that have fallen silent or have no common trigger with the first, or ""."""
        apart = [camera for camera in self._cameras if self._out_of_step[camera] and camera not in self._in_step]
        told = [f"camera {camera} has no common trigger with the others, it is not used" for camera in apart]
        return "; ".join([*filter(None, [self._awaited.diagnostic()]), *told])


def _stream(camera: str) -> str:
    return f"camera {camera}"
