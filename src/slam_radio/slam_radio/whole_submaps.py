# SPDX-License-Identifier: Apache-2.0
"""Whole submaps of an agent on its disk, beside the messages that were made of them: details are packed from these."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.storage.files import atomic_path
from slam_core.types import Float32Array, Submap
from slam_radio.index_ranges import Key
from slam_radio.packing.light_submap import LightSubmap, read

_NAME = re.compile(r"(\d{1,10})-(\d{1,10})\.npz")


class WholeSubmaps:
    """A folder of whole submaps without their paths: ``sizes`` has their keys and bytes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.mkdir(parents=True, exist_ok=True)
        found = {_NAME.fullmatch(file.name): file for file in path.iterdir()}
        self.sizes: dict[Key, int] = {(int(m[1]), int(m[2])): file.stat().st_size for m, file in found.items() if m}

    @property
    def total(self) -> int:
        """Bytes of all."""
        return sum(self.sizes.values())

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

    def _file(self, key: Key) -> Path:
        return self.path / f"{key[0]}-{key[1]}.npz"


def _rounded_up(covariance: FloatArray) -> Float32Array:
    """A covariance in single precision that is not surer: its variances are larger by what rounding may take away."""
    out = covariance.astype(np.float32)
    rows = np.arange(len(out))
    out[rows, rows] = np.nextafter(out[rows, rows] * np.float32(1.0 + len(out) * 2.0**-23), np.float32(np.inf))
    return out
