# SPDX-License-Identifier: Apache-2.0
"""Whole submaps of an agent on its disk, beside the messages that were made of them: details are packed from these."""

from __future__ import annotations

import re
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.storage.files import atomic_path
from slam_core.types import Float32Array, Submap
from slam_radio.packing.light_submap import LightSubmap, read
from slam_radio.wire.index_ranges import Key

_NAME = re.compile(r"(\d{1,10})-(\d{1,10})\.npz")


class WholeSubmaps:
    """A folder of whole submaps without their paths: ``sizes`` has their keys and bytes.

    ``strangers`` has those of files that are of another version, or damaged: they stay where they are until the same
    submap comes anew.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.mkdir(parents=True, exist_ok=True)
        self.sizes: dict[Key, int] = {}
        self.strangers: dict[Key, int] = {}
        for file in sorted(path.iterdir()):
            if match := _NAME.fullmatch(file.name):
                key = int(match[1]), int(match[2])
                (self.sizes if self._is_ours(file, key) else self.strangers)[key] = file.stat().st_size

    @property
    def total(self) -> int:
        """Bytes of all, strangers included."""
        return sum(self.sizes.values()) + sum(self.strangers.values())

    def add(self, key: Key, submap: Submap, message: bytes) -> None:
        """Write a submap and its message, whole or not at all; OSError if that fails."""
        file = self._file(key)
        with atomic_path(file) as temporary, temporary.open("wb") as stream:
            np.savez(
                stream, message=np.frombuffer(message, dtype=np.uint8), covariance=_rounded_up(submap.covariance),
                landmarks=submap.landmarks, landmark_ids=submap.landmark_ids, sightings=submap.sightings,
                descriptors=submap.descriptors,
            )  # fmt: skip
        self.sizes[key] = file.stat().st_size
        self.strangers.pop(key, None)

    def read(self, key: Key) -> tuple[Submap, LightSubmap, bytes]:
        """A submap, what was sent of it, and its message.

        Raises
        ------
        ValueError
            If the file is damaged or gone.
        """
        try:
            with np.load(self._file(key), allow_pickle=False) as arrays:
                message = arrays["message"].tobytes()
                light = read(message)
                submap = Submap(
                    light.agent, light.index, light.start_stamp_ns, light.end_stamp_ns, light.end_pose,
                    arrays["landmarks"], arrays["covariance"].astype(np.float64), arrays["landmark_ids"],
                    arrays["sightings"], arrays["descriptors"], (), light.follows_previous, light.session,
                )  # fmt: skip
        except (OSError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{self._file(key)} cannot be read: {error}") from error
        if (light.session, light.index) != key:
            raise ValueError(f"{self._file(key)} holds submap {light.session}/{light.index}")
        return submap, light, message

    def remove(self, key: Key) -> None:
        """Remove a submap that is there."""
        del self.sizes[key]
        self._file(key).unlink(missing_ok=True)

    def set_aside(self, key: Key) -> None:
        """Look at a submap that cannot be read no more; its file stays, if there is one."""
        del self.sizes[key]
        with suppress(FileNotFoundError):
            self.strangers[key] = self._file(key).stat().st_size

    def _is_ours(self, file: Path, key: Key) -> bool:
        """True if the message in a file is of this version: that is read in a moment, all of a file is not."""
        try:
            with np.load(file, allow_pickle=False) as arrays:
                light = read(arrays["message"].tobytes())
        except (OSError, KeyError, EOFError, TypeError, ValueError, zipfile.BadZipFile):
            return False
        return (light.session, light.index) == key

    def _file(self, key: Key) -> Path:
        return self.path / f"{key[0]}-{key[1]}.npz"


def _rounded_up(covariance: FloatArray) -> Float32Array:
    """A covariance in single precision that is not surer: its variances are larger by what rounding may take away."""
    out = covariance.astype(np.float32)
    rows = np.arange(len(out))
    out[rows, rows] = np.nextafter(out[rows, rows] * np.float32(1.0 + len(out) * 2.0**-23), np.float32(np.inf))
    return out
