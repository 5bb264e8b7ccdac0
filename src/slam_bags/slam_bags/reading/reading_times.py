# SPDX-License-Identifier: Apache-2.0
"""Times of a first reading of a bag, for a second one of some of its images alone: most of the time is unpacking."""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from slam_bags.reading.readings import DepthReading, ImuReading, Reading, StereoReading
from slam_core.geometry import FloatArray
from slam_core.nodes.synchronizer import PAIRING_TOLERANCE_S

Stamps = npt.NDArray[np.int64]
Span = tuple[int, int]
_JOINED_NS = 20_000_000
"""Images recorded within this time are read together."""


class ReadingTimes:
    """Stamps of readings and times at which their images were recorded, ns, and what accelerometers read.

    Attributes
    ----------
    is_whole
        The bag was read to its end and has an index, so that parts of it can be read alone.
    count
        Number of readings.
    """

    def __init__(self) -> None:
        self.is_whole = False
        self.count = 0
        self._stamps: dict[tuple[str, type[Reading]], array[int]] = defaultdict(lambda: array("q"))
        self._images: dict[str, array[int]] = defaultdict(lambda: array("q"))
        self._forces: dict[str, dict[str, tuple[array[int], array[float]]]] = defaultdict(dict)

    def add_image(self, agent: str, stamp_ns: int, recorded_ns: int) -> None:
        """Take the stamp and the time of recording of an image."""
        self._images[agent].extend((stamp_ns, recorded_ns))

    def add(self, reading: Reading) -> None:
        """Take a reading."""
        self.count += 1
        if isinstance(reading, ImuReading):
            sample = reading.sample
            stamps, forces = self._forces[reading.agent].setdefault(sample.frame_id, (array("q"), array("d")))
            stamps.append(sample.stamp_ns)
            forces.extend(sample.linear_acceleration.tolist())
        elif isinstance(reading, StereoReading | DepthReading):
            self._stamps[reading.agent, type(reading)].append(reading.stamp_ns)

    def stamps(self, agent: str, kind: type[Reading]) -> Stamps:
        """Stamps (n,) of an agent's readings of a kind of camera, in their order."""
        return np.array(self._stamps[agent, kind], dtype=np.int64)

    def forces(self, agent: str) -> list[tuple[str, Stamps, FloatArray]]:
        """Frame of an agent's IMU, stamps (n,) and specific forces (n, 3) m/s2; one for each frame."""
        return [
            (frame, np.array(stamps, dtype=np.int64), np.array(forces).reshape(-1, 3))
            for frame, (stamps, forces) in self._forces[agent].items()
        ]

    def spans(self, wanted: Mapping[str, Stamps]) -> list[Span]:
        """Times of recording, from the first until before the second, of the images of readings ``wanted`` by agent."""
        times = [self._recorded(agent, np.sort(stamps)) for agent, stamps in wanted.items() if len(stamps)]
        recorded = np.sort(np.concatenate([np.empty(0, np.int64), *times]))
        if not len(recorded):
            return []
        first = np.flatnonzero(np.diff(recorded, prepend=recorded[0] - 2 * _JOINED_NS) > _JOINED_NS)
        last = np.append(first[1:], len(recorded)) - 1
        return [(int(a), int(b) + 1) for a, b in zip(recorded[first], recorded[last], strict=True)]

    def _recorded(self, agent: str, wanted: Stamps) -> Stamps:
        """Times of recording of the images within the pairing tolerance of sorted stamps."""
        stamps, recorded = np.array(self._images[agent], dtype=np.int64).reshape(-1, 2).T
        after = np.searchsorted(wanted, stamps).clip(0, len(wanted) - 1)
        gap = np.minimum(np.abs(wanted[after] - stamps), np.abs(stamps - wanted[np.maximum(after - 1, 0)]))
        return np.asarray(recorded[gap <= round(PAIRING_TOLERANCE_S * 1e9)])
