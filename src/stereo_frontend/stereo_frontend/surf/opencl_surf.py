# SPDX-License-Identifier: Apache-2.0
"""SURF as OpenCL kernels (``surf_detector.cl``, ``surf_descriptor.cl``): GPU-SURF of the thesis (3.2).

The compiled kernels of :mod:`stereo_frontend.surf.surf_detector`, ``surf_descriptor`` and ``surf_pair`` are the oracle.
The same picture gives the same bytes on the same device. :class:`stereo_frontend.surf.surf_device.SurfDevice` chooses
the device; this module needs pyopencl.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from threading import Lock
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import pyopencl as cl
import pyopencl.tools

from slam_core.geometry import FloatArray
from slam_core.types import AnyArray, ByteArray, Float32Array
from stereo_frontend.keypoints import MOST_KEYPOINTS
from stereo_frontend.surf import surf_descriptor, surf_detector, surf_pair
from stereo_frontend.surf.surf_hessian import FILTER_SIZES

_GROUP = 64
"""Work items of a group; the descriptor has two numbers for each."""
_TILE = (16, 4)
_MACROS = {
    "GROUP": _GROUP,
    **dict(zip(("SMALLEST", "SMALLER", "LARGER", "LARGEST"), FILTER_SIZES, strict=True)),
    "STEP": surf_detector.STEP,
    **dict(zip(("BORDER_SMALLER", "BORDER_LARGER"), surf_detector.BORDERS, strict=True)),
    "SAMPLES": surf_descriptor.SAMPLES,
    "TURNED_CORNERS": surf_descriptor.TURNED_CORNERS,
    "DISC_RADIUS": surf_descriptor.DISC_RADIUS,
    "DIRECTIONS": surf_descriptor.DIRECTIONS,
}
_SOURCES = ("surf_detector.cl", "surf_descriptor.cl")
_KERNELS = (
    "enlarge", "halve", "sum_rows", "sum_columns", "fill_layers", "find_maxima",
    "describe_upright", "describe_oriented",
)  # fmt: skip
Array = TypeVar("Array", bound=AnyArray)
DEVICE_ERRORS = (cl.Error, MemoryError)
"""Errors of a device that has no memory left, has vanished, or cannot compile the kernels."""


def is_gpu(device: Any) -> bool:
    """True for a GPU, False for OpenCL on the CPU and the like."""
    return bool(device.type & cl.device_type.GPU)


def known_devices() -> list[Any]:
    """All OpenCL devices of this machine, GPUs first."""
    try:
        devices = [device for platform in cl.get_platforms() for device in platform.get_devices()]
    except cl.Error:  # no platform at all
        devices = []
    return sorted(devices, key=is_gpu, reverse=True)


def find_device(name: str = "") -> Any:
    """First GPU; or the first device of any kind whose name, or whose platform's, contains ``name`` in any case.

    Raises
    ------
    LookupError
        If there is none; the message names those that there are.
    """
    devices = known_devices()
    for device in devices:
        names = f"{device.name}\n{device.platform.name}".lower()
        if name.lower() in names if name else is_gpu(device):
            return device
    known = ", ".join(device.name.strip() for device in devices) or "none"
    raise LookupError(f"no OpenCL device is {f'named {name!r}' if name else 'a GPU'}; known: {known}")


@dataclass(frozen=True, eq=False)
class _Picture:
    """Pixels on the device, uint8 (height, width)."""

    pixels: Any
    width: np.int32
    height: np.int32

    def __iter__(self) -> Iterator[Any]:
        return iter((self.pixels, self.width, self.height))


class OpenClSurf:
    """Finds and describes SURF keypoints on one device. Calls of several threads take turns.

    Parameters
    ----------
    device
        A ``pyopencl.Device``.
    double
        Sum wavelets in double precision, as the CPU does; by default where the device can.

    Raises
    ------
    DEVICE_ERRORS
        By all calls, where the device fails.
    """

    def __init__(self, device: Any, *, double: bool | None = None) -> None:
        context = cl.Context([device])
        self._queue = cl.CommandQueue(context)
        self._memory: Any = cl.tools.MemoryPool(cl.tools.ImmediateAllocator(self._queue))
        source = "\n".join(files(__package__).joinpath(name).read_text(encoding="utf-8") for name in _SOURCES)
        macros = _MACROS | {"DOUBLE": int(bool(device.double_fp_config) if double is None else double)}
        program = cl.Program(context, source).build([f"-D{name}={value}" for name, value in macros.items()])
        self._kernels = {name: cl.Kernel(program, name) for name in _KERNELS}
        self._weights = self._uploaded(surf_descriptor.region_weights())
        self._pair_weights = self._uploaded(surf_descriptor.region_weights(surf_pair.SAMPLES, surf_pair.WEIGHT_SIGMA))
        self._lock, self._room = Lock(), MOST_KEYPOINTS

    def find(self, image: ByteArray, *, doubled: bool, octaves: int, threshold: float) -> Float32Array:
        """Keypoints above ``threshold``, rows (n, 4) of u, v, scale, response, as and in the order that the CPU has.

        As there the first octave is that of the image, or where ``doubled`` of it enlarged twice, whose pixels are the
        unit of u, v and scale; there are at most ``MOST_KEYPOINTS``, the first.
        """
        with self._lock:
            while True:
                found, keys, number = self._found(image, doubled, octaves, threshold)
                if number <= self._room:
                    return found[np.argsort(keys)[:MOST_KEYPOINTS]]
                self._room = number  # which of them had room is chance: again, with room for all

    def describe(self, image: ByteArray, places: FloatArray, *, upright: bool) -> Float32Array:
        """SURF-128 (n, 128) of places (n, 3): u, v and scale, px."""
        if not upright:
            return self._described("describe_oriented", image, places, self._weights)
        samples = np.int32(surf_descriptor.SAMPLES), np.float32(1.0), self._weights
        return self._described("describe_upright", image, places, *samples)

    def describe_for_pair(self, image: ByteArray, places: FloatArray) -> Float32Array:
        """Descriptors (n, 128) of the same places, for matching within a stereo pair."""
        samples = np.int32(surf_pair.SAMPLES), np.float32(surf_pair.STEP), self._pair_weights
        return self._described("describe_upright", image, places, *samples)

    def _found(
        self, image: ByteArray, doubled: bool, octaves: int, threshold: float
    ) -> tuple[Float32Array, npt.NDArray[np.uint32], int]:
        """Keypoints with the keys of their order, of those that had room; and how many there are."""
        count = self._uploaded(np.zeros(1, np.uint32))
        found, keys = self._memory(16 * self._room), self._memory(4 * self._room)
        pixel, first_key = 1, 0
        for picture in self._octaves(self._picture(image), doubled, octaves):
            sums, size = self._integral(picture), (picture.width, picture.height)
            layers = self._memory(2 * 4 * int(picture.width) * int(picture.height))
            self._run_tiles("fill_layers", size, sums, *size, layers)
            numbers = np.float32(threshold), np.float32(pixel), np.uint32(first_key), np.uint32(self._room)
            self._run_tiles("find_maxima", size, sums, layers, *size, *numbers, count, found, keys)
            pixel, first_key = 2 * pixel, first_key + 2 * int(picture.width) * int(picture.height)
        number = int(self._downloaded(count, np.empty(1, np.uint32))[0])
        stored = min(number, self._room)
        return (
            self._downloaded(found, np.empty((stored, 4), np.float32)),
            self._downloaded(keys, np.empty(stored, np.uint32)),
            number,
        )

    def _octaves(self, image: _Picture, doubled: bool, octaves: int) -> Iterator[_Picture]:
        """Pictures of the octaves, each half as large as the one before."""
        picture = self._resized("enlarge", image, 2 * image.width, 2 * image.height) if doubled else image
        for octave in range(octaves):
            yield picture
            if octave == 0 and doubled:
                picture = image
            elif octave < octaves - 1:
                picture = self._resized("halve", picture, picture.width // 2, picture.height // 2)

    def _resized(self, kernel: str, picture: _Picture, width: np.int32, height: np.int32) -> _Picture:
        out = _Picture(self._memory(int(width) * int(height)), width, height)
        self._run_tiles(kernel, (width, height), *picture, out.pixels)
        return out

    def _integral(self, picture: _Picture) -> Any:
        """Integral image, uint32 (height + 1, width + 1)."""
        columns, height = picture.width + 1, picture.height
        sums = self._memory(4 * int(columns) * (int(height) + 1))
        self._run("sum_rows", (int(height) * _GROUP,), (_GROUP,), picture.pixels, picture.width, sums)
        wide, pieces = _TILE
        self._run("sum_columns", (_rounded_up(columns, wide), pieces), _TILE, sums, columns, height)
        return sums

    def _described(self, kernel: str, image: ByteArray, places: FloatArray, *arguments: Any) -> Float32Array:
        out = np.empty((len(places), surf_descriptor.DIMENSION), np.float32)
        if len(places) == 0:
            return out
        with self._lock:
            picture, there = self._picture(image), self._memory(out.nbytes)
            sums = self._integral(picture)
            where = self._uploaded(places.astype(np.float32)), *arguments, there
            self._run(kernel, (len(places) * _GROUP,), (_GROUP,), sums, picture.width, picture.height, *where)
            return self._downloaded(there, out)

    def _picture(self, image: ByteArray) -> _Picture:
        height, width = image.shape
        return _Picture(self._uploaded(image), np.int32(width), np.int32(height))

    def _uploaded(self, values: AnyArray) -> Any:
        there: Any = self._memory(values.nbytes)
        cl.enqueue_copy(self._queue, there, np.ascontiguousarray(values))
        return there

    def _downloaded(self, there: Any, out: Array) -> Array:
        if out.size:
            cl.enqueue_copy(self._queue, out, there)
        return out

    def _run_tiles(self, kernel: str, size: tuple[np.int32, np.int32], *arguments: Any) -> None:
        """One work item for each pixel of an image (width, height)."""
        across, down = (_rounded_up(side, tile) for side, tile in zip(size, _TILE, strict=True))
        self._run(kernel, (across, down), _TILE, *arguments)

    def _run(self, kernel: str, items: tuple[int, ...], group: tuple[int, ...], *arguments: Any) -> None:
        self._kernels[kernel](self._queue, items, group, *arguments)


def _rounded_up(number: np.int32, unit: int) -> int:
    return -(-int(number) // unit) * unit
