# SPDX-License-Identifier: Apache-2.0
"""A picture or a dense key frame of an agent, byte by byte: what the pieces of a view are put together to.

Little endian throughout.

========  =========================================================================================================
envelope  b"SV", u8 version (1), u32 CRC-32 of the rest
head      u8 kind (1 picture, 2 dense key frame); u32 session, u32 index of the submap; i64 stamp ns of the image; i64
          stamp ns at which the submap starts; 6 x f32 T_start_camera: position m and rotation vector rad of the camera
          (z forward) at the stamp, in the frame of the rig at the start of the submap
camera    u16 width, u16 height px; 4 x f32 fx, fy, cx, cy px, all 0 if they are not known (pictures only)
picture   u32 length, a JPEG file of that size, grey or in colour; of a dense key frame the length may be 0
depth     dense key frames only: u32 length of a PNG of depth levels, then that PNG; the rest is a PNG of levels of
          standard deviations (:mod:`slam_radio.views.depth_code`)
========  =========================================================================================================
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import cv2
import numpy as np

from slam_core.geometry import FloatArray, is_rigid_transform, make_transform, so3_exp, so3_log
from slam_core.types import ByteArray
from slam_radio.packing.byte_reader import ByteReader
from slam_radio.packing.light_submap import opened, sealed
from slam_radio.views.depth_code import Levels, pack_levels, unpack_levels

PICTURE, DENSE = 1, 2
KINDS = {PICTURE: "picture", DENSE: "key frame"}
MAGIC, VERSION = b"SV", 1
MOST_BYTES = 2**20
_HEAD = "<BIIqq6f"
_CAMERA = "<HH4f"
MOST_PIXELS = 2048
"""Largest width and height."""
_FARTHEST_M = 1e4
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of a JPEG with the size of the image."""
_SEGMENTS = frozenset((0xC4, 0xCC, 0xDB, 0xDD, *range(0xE0, 0xF0), 0xFE))
"""Markers of a JPEG that may come before it: tables, application data, comments."""


@dataclass(frozen=True, eq=False)
class PlacedImage:
    """A picture (``depth`` and ``steps`` None) or a dense key frame of one moment.

    Attributes
    ----------
    session, index
        Submap in which the image was taken.
    stamp_ns, start_stamp_ns
        Of the image, and of the submap's start.
    T_start_camera
        Pose (4, 4) of the camera's optical frame in that of the rig at the submap's start, m.
    size
        Width and height of the depth image, or of the picture, px.
    intrinsics
        fx, fy, cx, cy in pixels of that size; four zeros if they are not known.
    jpeg
        A picture (height, width[, 3]) as a JPEG file; of a dense key frame it may be empty.
    depth, steps
        Levels of depth and of its standard deviation (height, width), see :mod:`slam_radio.views.depth_code`.
    """

    session: int
    index: int
    stamp_ns: int
    start_stamp_ns: int
    T_start_camera: FloatArray
    size: tuple[int, int]
    intrinsics: tuple[float, float, float, float]
    jpeg: bytes
    depth: Levels | None = None
    steps: ByteArray | None = None

    @property
    def kind(self) -> int:
        """:data:`PICTURE` or :data:`DENSE`."""
        return PICTURE if self.depth is None else DENSE


def pack_view(view: PlacedImage) -> bytes:
    """The bytes of a view.

    Raises
    ------
    ValueError
        If it has too many bytes or pixels to be sent.
    """
    _require_size(*view.size)
    T = view.T_start_camera
    rest = struct.pack(_HEAD, view.kind, view.session, view.index, view.stamp_ns, view.start_stamp_ns,
                       *T[:3, 3], *so3_log(T[:3, :3]))  # fmt: skip
    rest += struct.pack(_CAMERA, *view.size, *view.intrinsics) + struct.pack("<I", len(view.jpeg)) + view.jpeg
    if view.depth is not None and view.steps is not None:
        depth, sigma = pack_levels(view.depth, view.steps)
        rest += struct.pack("<I", len(depth)) + depth + sigma
    data = sealed(MAGIC, VERSION, rest)
    if len(data) > MOST_BYTES:
        raise ValueError(f"a view of {len(data)} bytes is too large to be sent: {MOST_BYTES} are the most")
    return data


def unpack_view(data: bytes) -> PlacedImage:
    """Inverse of :func:`pack_view`.

    Raises
    ------
    ValueError
        If the bytes are damaged, of another version, or hold a pose, a size or an image that cannot be.
    """
    reader = ByteReader(opened(data, MAGIC, VERSION, "view", MOST_BYTES))
    kind, session, index, stamp, start = reader.numbers(_HEAD.removesuffix("6f"))
    pose = reader.floats("<f4", (6,))
    width, height, *_ = reader.numbers("<HH")
    intrinsics = reader.floats("<f4", (4,))
    jpeg = reader.bytes(reader.number("<I"))
    if kind not in KINDS or min(stamp, start) < 0:
        raise ValueError(f"a view of kind {kind} at {stamp} ns in a submap from {start} ns cannot be")
    _require_size(width, height)
    known = (intrinsics[:2] > 0.0).all()
    if not known and (intrinsics.any() or kind == DENSE):
        raise ValueError(f"a camera with focal lengths of {intrinsics[0]} and {intrinsics[1]} px cannot be")
    if jpeg or kind == PICTURE:
        _require_jpeg(jpeg, (width, height))
    depth, steps = None, None
    if kind == DENSE:
        depth_file = reader.bytes(reader.number("<I"))
        depth, steps = unpack_levels(depth_file, reader.bytes(), (height, width))
    reader.require_end()
    fx, fy, cx, cy = intrinsics.tolist()
    T = _pose(pose)
    return PlacedImage(session, index, stamp, start, T, (width, height), (fx, fy, cx, cy), jpeg, depth, steps)


def rgb_of(jpeg: bytes) -> ByteArray:
    """The picture (height, width, 3) uint8 of a JPEG file, red first; ValueError if it is none."""
    image = cv2.imdecode(np.frombuffer(jpeg, dtype=np.uint8), cv2.IMREAD_COLOR) if jpeg else None
    if image is None:
        raise ValueError("a JPEG is damaged")
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)


def _require_size(width: int, height: int) -> None:
    if not (0 < width <= MOST_PIXELS and 0 < height <= MOST_PIXELS):
        raise ValueError(f"a view of {width} x {height} px cannot be")


def _pose(numbers: FloatArray) -> FloatArray:
    if np.abs(numbers[:3]).max() > _FARTHEST_M or np.abs(numbers[3:]).max() > 2.0 * np.pi:
        raise ValueError(f"a pose of a view cannot be: {numbers.tolist()}")
    T = make_transform(so3_exp(numbers[3:]), numbers[:3])
    if not is_rigid_transform(T):
        raise ValueError(f"a pose of a view cannot be: {numbers.tolist()}")
    return T


def _require_jpeg(data: bytes, size: tuple[int, int]) -> None:
    """Raise ``ValueError`` unless a JPEG says that it has this size and can be decoded.

    The size is read first: decoding takes memory by what the file says. Before it only segments that have a length may
    be: a decoder does not skip two bytes after a marker that has none.
    """
    at = 2
    while data[:2] == b"\xff\xd8" and at + 9 < len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker in _FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            if (width, height) == size and rgb_of(data).shape[:2] == size[::-1]:
                return
            break
        if marker not in _SEGMENTS or length < 2:
            break
        at += 2 + length
    raise ValueError(f"not a JPEG of {size[0]} x {size[1]} px")
