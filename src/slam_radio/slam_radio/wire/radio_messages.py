# SPDX-License-Identifier: Apache-2.0
"""The small messages of a link: pose, correction and acknowledgement, and the envelope of a submap.

Little endian throughout.

===============  =============================================================================================
pose             30 bytes: i64 stamp ns; 3 x f32 position m; 3 x i16 rotation vector in pi/32767; 2 x f16
                 standard deviations of position (m) and rotation (rad), the same along all axes, which cover the
                 pose's covariance in every direction
correction       32 bytes: i64 stamp ns; 3 x f32 position m, 3 x f32 rotation vector of T_map_odom
acknowledgement  b"SA", u8 version, u32 CRC-32 of the rest; then ranges of 3 x u32: session, first index, the
                 index behind the last
want             as an acknowledgement, with b"SW": submaps whose details the post lacks, all of them; none: no ranges
none             as an acknowledgement, with b"SN": submaps of these whose details the agent cannot tell
submap           u32: the lowest index of this session that its agent still has to send; then a submap for the
                 air (:mod:`slam_radio.packing.light_submap`)
===============  =============================================================================================
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable

import numpy as np

from slam_core.geometry import FloatArray, is_rigid_transform, make_transform, so3_exp, so3_log
from slam_core.types import PoseEstimate
from slam_radio.wire.index_ranges import Range

POSE = struct.Struct("<q3f3h2e")
CORRECTION = struct.Struct("<q6f")
MOST_RANGES = 64
"""Ranges of one acknowledgement."""
_ACKNOWLEDGEMENT = struct.Struct("<2sBI")
_RANGE = struct.Struct("<III")
_FLOOR = struct.Struct("<I")
_MAGIC, _WANT_MAGIC, _NONE_MAGIC, _VERSION = b"SA", b"SW", b"SN", 1
_TURN = np.pi / 32767
_LEAST_SIGMA, _LARGEST_SIGMA = 1e-4, 6e4
_FARTHEST_M = 1e6


def pack_pose(pose: PoseEstimate) -> bytes:
    """The 30 bytes of a pose with covariance."""
    turn = np.rint(so3_log(pose.T[:3, :3]) / _TURN)
    return POSE.pack(pose.stamp_ns, *pose.T[:3, 3], *(int(v) for v in turn), *_sigmas(pose.covariance))


def unpack_pose(data: bytes) -> PoseEstimate:
    """Inverse of :func:`pack_pose`; ValueError for bytes that are none."""
    if len(data) != POSE.size:
        raise ValueError(f"a pose has {POSE.size} bytes, got {len(data)}")
    stamp, x, y, z, a, b, c, position, rotation = POSE.unpack(data)
    if not (0.0 < position <= _LARGEST_SIGMA and 0.0 < rotation <= _LARGEST_SIGMA):
        raise ValueError(f"a pose has standard deviations of {position} m and {rotation} rad")
    covariance = np.diag(np.repeat([position, rotation], 3) ** 2)
    return PoseEstimate(_stamp(stamp), _transform([x, y, z], _TURN * np.array([a, b, c])), covariance)


def pack_correction(stamp_ns: int, T_map_odom: FloatArray) -> bytes:
    """The 32 bytes of a correction."""
    return CORRECTION.pack(stamp_ns, *T_map_odom[:3, 3], *so3_log(T_map_odom[:3, :3]))


def unpack_correction(data: bytes) -> tuple[int, FloatArray]:
    """Stamp and T_map_odom; ValueError for bytes that are none."""
    if len(data) != CORRECTION.size:
        raise ValueError(f"a correction has {CORRECTION.size} bytes, got {len(data)}")
    stamp, *numbers = CORRECTION.unpack(data)
    return _stamp(stamp), _transform(numbers[:3], np.array(numbers[3:]))


def pack_acknowledgement(ranges: Iterable[Range]) -> bytes:
    """An acknowledgement of the first :data:`MOST_RANGES` of some ranges."""
    return _pack_ranges(_MAGIC, ranges)


def unpack_acknowledgement(data: bytes) -> list[Range]:
    """The ranges of an acknowledgement; ValueError if it is damaged."""
    return _unpack_ranges(_MAGIC, data, "an acknowledgement")


def pack_want(ranges: Iterable[Range]) -> bytes:
    """The first :data:`MOST_RANGES` ranges of submaps whose details the post lacks."""
    return _pack_ranges(_WANT_MAGIC, ranges)


def unpack_want(data: bytes) -> list[Range]:
    """Inverse of :func:`pack_want`; ValueError if it is damaged."""
    return _unpack_ranges(_WANT_MAGIC, data, "a want")


def pack_none(ranges: Iterable[Range]) -> bytes:
    """The first :data:`MOST_RANGES` ranges of submaps whose details the agent does not have."""
    return _pack_ranges(_NONE_MAGIC, ranges)


def unpack_none(data: bytes) -> list[Range]:
    """Inverse of :func:`pack_none`; ValueError if it is damaged."""
    return _unpack_ranges(_NONE_MAGIC, data, "a none")


def _pack_ranges(magic: bytes, ranges: Iterable[Range]) -> bytes:
    body = b"".join(_RANGE.pack(*entry) for entry in list(ranges)[:MOST_RANGES])
    return _ACKNOWLEDGEMENT.pack(magic, _VERSION, zlib.crc32(body)) + body


def _unpack_ranges(magic: bytes, data: bytes, name: str) -> list[Range]:
    body = data[_ACKNOWLEDGEMENT.size :]
    if len(data) < _ACKNOWLEDGEMENT.size or len(body) % _RANGE.size or len(body) > MOST_RANGES * _RANGE.size:
        raise ValueError(f"{name} cannot have {len(data)} bytes")
    if _ACKNOWLEDGEMENT.unpack_from(data) != (magic, _VERSION, zlib.crc32(body)):
        raise ValueError(f"not {name} of version {_VERSION}, or damaged")
    ranges = [(session, first, end) for session, first, end in _RANGE.iter_unpack(body)]
    if any(first >= end for _, first, end in ranges):
        raise ValueError(f"{name} has an empty range")
    return ranges


def pack_submap(floor: int, light: bytes) -> bytes:
    """A submap for the air with the lowest index that is still to be sent."""
    return _FLOOR.pack(floor) + light


def unpack_submap(data: bytes) -> tuple[int, bytes]:
    """Lowest index that is still to come, and the submap for the air."""
    if len(data) < _FLOOR.size:
        raise ValueError(f"a submap cannot have {len(data)} bytes")
    return _FLOOR.unpack_from(data)[0], data[_FLOOR.size :]


def _sigmas(covariance: FloatArray) -> tuple[float, float]:
    """Standard deviations s, r for which diag(s^2, r^2) - covariance is positive semidefinite, rounded up."""
    position, rotation = (max(np.linalg.eigvalsh(covariance[k, k])[-1], 0.0) for k in (slice(0, 3), slice(3, 6)))
    scale = np.sqrt(np.maximum(np.repeat([position, rotation], 3), _LEAST_SIGMA**2))
    share = max(1.0, float(np.linalg.eigvalsh(covariance / np.outer(scale, scale))[-1]))
    if not (np.sqrt(share) * scale < _LARGEST_SIGMA).all():
        raise ValueError(f"a pose is too uncertain to be sent: {scale[0]:g} m, {scale[3]:g} rad")
    up = [np.nextafter(np.float16(np.sqrt(share) * scale[k]), np.float16(np.inf)) for k in (0, 3)]
    return float(up[0]), float(up[1])


def _stamp(stamp_ns: int) -> int:
    if stamp_ns < 0:
        raise ValueError(f"a stamp of {stamp_ns} ns cannot be")
    return stamp_ns


def _transform(position: list[float], turn: FloatArray) -> FloatArray:
    numbers = np.concatenate([position, turn])
    if not np.isfinite(numbers).all() or np.abs(numbers[:3]).max() > _FARTHEST_M or np.abs(turn).max() > 2.0 * np.pi:
        raise ValueError(f"a pose of the radio cannot be: {numbers.tolist()}")
    T = make_transform(so3_exp(turn), numbers[:3])
    if not is_rigid_transform(T):
        raise ValueError(f"a pose of the radio cannot be: {numbers.tolist()}")
    return T
