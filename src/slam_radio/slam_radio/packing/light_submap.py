# SPDX-License-Identifier: Apache-2.0
"""A submap for the air: what joining needs, in about six kilobytes, and no surer than the submap itself.

    data = pack(submap, LightConfig())
    light = unpack(data)            # a Submap, with fewer landmarks

Format, version 2, little endian. A message is

==========  ==========================================================================================
``b"SL"``   two bytes
u8          version
u32         CRC-32 of the rest
u16         length of the rest once it is inflated
bytes       the rest, deflated (RFC 1950)
==========  ==========================================================================================

The rest, with n landmarks in the order of their ids, r common directions, c bytes a descriptor and k poses:

==================  ===================================================================================
u8, bytes           length of the agent's name, the name (UTF-8)
u32, u32, u8        session, index, 1 if it follows the submap before
i64, i64            stamps of start and end, ns
u16, u8             n, r
u16, u16, u8        dimension of descriptors, c, k
6 x f32             tangent of the end pose: translation m, rotation rad
6 x f32             box of the landmarks: lowest corner, size (m)
n x 3 x u16         positions, in 65535ths of the box
(21 + 6n) x f16     Cholesky factors of the unknowns' own blocks, mm and mrad: all low bytes, then all high bytes
f32                 inflation t
(6 + 3n) x r x i8   common directions U, in 127ths (:mod:`slam_radio.packing.compact_gaussian`)
n x varint          ids, each less the one before (LEB128)
n x u8              sightings, at most 255
n x c x i8          descriptors (:mod:`slam_radio.packing.descriptor_code`)
k x (i64, 6 x f32,  poses of the path: stamp, tangent of T_start_rig, and the factor by which the end pose's
f16)                covariance covers the pose's own
==================  ===================================================================================

Deflate begins a new block for each kind of numbers, so that each has Huffman codes of its own.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, boxminus, boxplus, is_rigid_transform
from slam_core.types import PoseEstimate, Submap
from slam_radio.packing.byte_reader import ByteReader, read_varints, write_varints
from slam_radio.packing.compact_gaussian import MOST_INFLATION, CompactGaussian, compact_gaussian
from slam_radio.packing.descriptor_code import decode, encode
from slam_radio.packing.landmark_choice import choose_landmarks

MAGIC, VERSION = b"SL", 2
MOST_BYTES = 2**17
"""Largest message: 65535 bytes that deflate did not make smaller, and their envelope."""
_ENVELOPE = struct.Struct("<2sBIH")
_COUNTS = struct.Struct("<HBHHB")
_CELLS = 65535


@dataclass(frozen=True)
class LightConfig(Config):
    """Size of a submap for the air."""

    landmarks: int = parameter(128, "landmarks that are sent of a submap", minimum=3, maximum=200)
    rank: int = parameter(8, "directions in which the errors of a submap's unknowns are said to be common",
                          minimum=1, maximum=64)  # fmt: skip
    poses: int = parameter(4, "poses of the path that are sent of a submap", minimum=2, maximum=255)


def pack(submap: Submap, config: LightConfig | None = None) -> bytes:
    """The submap as a message.

    Parameters
    ----------
    submap
        A whole submap.
    config
        How much of it is sent.

    Raises
    ------
    ValueError
        If its covariance is not positive definite, or nearly so, or a number is too large for the format.
    """
    config = config or LightConfig()
    rows = choose_landmarks(submap, config.landmarks)
    points, box, step = _positions(submap.landmarks[rows])
    unknowns = np.concatenate([np.arange(6), (6 + 3 * rows[:, None] + np.arange(3)).ravel()])
    gaussian = compact_gaussian(submap.covariance[np.ix_(unknowns, unknowns)], config.rank, float(step.max(initial=0)))
    codes = encode(submap.descriptors[rows])
    path = _key_poses(submap, gaussian.end_covariance(), config.poses)
    name = submap.agent.encode()
    if len(name) > 255:
        raise ValueError(f"an agent's name may have 255 bytes, '{submap.agent[:20]}...' has {len(name)}")
    kinds = (
        b"".join([
            struct.pack("<B", len(name)), name,
            struct.pack("<IIB", submap.session, submap.index, submap.follows_previous),
            struct.pack("<qq", submap.start_stamp_ns, submap.end_stamp_ns),
            _COUNTS.pack(len(rows), gaussian.common.shape[1], submap.descriptors.shape[1], codes.shape[1], len(path)),
            _tangent(submap.end_pose), box.astype("<f4").tobytes(), points.astype("<u2").tobytes(),
        ]),
        *_byte_planes(gaussian.blocks),
        struct.pack("<f", gaussian.inflation) + gaussian.common.tobytes(),
        write_varints(np.diff(submap.landmark_ids[rows], prepend=0)),
        np.minimum(submap.sightings[rows], 255).astype(np.uint8).tobytes(),
        codes.tobytes(),
        b"".join(struct.pack("<q", stamp) + _tangent(T) + np.float16(factor).tobytes() for stamp, T, factor in path),
    )  # fmt: skip
    rest = b"".join(kinds)
    if len(rest) > 0xFFFF:
        raise ValueError(f"a submap for the air may have 65535 bytes, this one has {len(rest)}: send fewer landmarks")
    body = _deflated(kinds)
    return _ENVELOPE.pack(MAGIC, VERSION, zlib.crc32(body), len(rest)) + body


def unpack(data: bytes) -> Submap:
    """The submap of a message, with the landmarks that were sent.

    Raises
    ------
    ValueError
        If the message is damaged, of another version, or says what cannot be.
    """
    reader = ByteReader(_rest(data))
    agent = reader.text(reader.number("<B"))
    session, index, follows = reader.numbers("<IIB")
    start, end = reader.numbers("<qq")
    n, r, dimension, width, k = reader.numbers(_COUNTS.format)
    end_pose = _pose(reader.floats("<f4", (6,)))
    box = reader.floats("<f4", (2, 3))
    cells = reader.array("<u2", (n, 3))
    blocks = _from_byte_planes(reader.array("u1", (2, 21 + 6 * n)))
    (inflation,) = reader.numbers("<f")
    common = reader.array("i1", (6 + 3 * n, r))
    ids = np.cumsum(read_varints(reader, n))
    sightings = reader.array("u1", (n,)).astype(np.int32)
    codes = reader.array("i1", (n, width))
    path = [(*reader.numbers("<q"), _pose(reader.floats("<f4", (6,))), *reader.floats("<f2", (1,))) for _ in range(k)]
    reader.require_end()
    if (
        not 1.0 <= inflation < MOST_INFLATION
        or follows > 1
        or len(np.unique(ids)) != n
        or (box[1] < 0).any()
        or end < start
    ):
        raise ValueError("a submap for the air holds numbers that cannot be")
    gaussian = CompactGaussian(blocks, common, inflation)
    gaussian.require_positive()
    covariance = gaussian.covariance()
    if any(not 0.0 <= factor < np.inf for _, _, factor in path):
        raise ValueError("a submap for the air has a pose with a negative covariance")
    poses = [PoseEstimate(stamp, T, max(factor, _LEAST_FACTOR) * covariance[:6, :6]) for stamp, T, factor in path]
    return Submap(
        agent=agent, index=index, start_stamp_ns=start, end_stamp_ns=end, end_pose=end_pose,
        landmarks=box[0] + cells / _CELLS * box[1], covariance=covariance, landmark_ids=ids, sightings=sightings,
        descriptors=decode(codes, dimension), path=tuple(poses), follows_previous=bool(follows), session=session,
    )  # fmt: skip


_LEAST_FACTOR = 1e-6
"""Covariance of the first pose, which is exact, over that of the end pose: keeps it positive definite."""


def _deflated(kinds: tuple[bytes, ...]) -> bytes:
    """One stream of several kinds of numbers, each in blocks of its own."""
    deflater = zlib.compressobj(9)
    parts = [deflater.compress(kind) + deflater.flush(zlib.Z_PARTIAL_FLUSH) for kind in kinds]
    return b"".join(parts) + deflater.flush()


def _byte_planes(values: npt.NDArray[np.float16]) -> tuple[bytes, bytes]:
    """The low bytes of numbers, and their high bytes: sign, exponent and what is alike."""
    planes = values.astype("<f2").view(np.uint8).reshape(-1, 2)
    return planes[:, 0].tobytes(), planes[:, 1].tobytes()


def _from_byte_planes(planes: npt.NDArray[np.uint8]) -> npt.NDArray[np.float16]:
    """Inverse of :func:`_byte_planes`, of planes (2, n).

    Raises
    ------
    ValueError
        If one is not finite.
    """
    values = np.ascontiguousarray(planes.T).view("<f2")[:, 0].astype(np.float16)
    if not np.isfinite(values).all():
        raise ValueError("a submap for the air holds numbers that are not finite")
    return values


def _rest(data: bytes) -> bytes:
    if len(data) < _ENVELOPE.size:
        raise ValueError(f"a submap for the air has at least {_ENVELOPE.size} bytes, got {len(data)}")
    magic, version, checksum, length = _ENVELOPE.unpack_from(data)
    body = data[_ENVELOPE.size :]
    if magic != MAGIC or version != VERSION:
        raise ValueError(f"not a submap for the air of version {VERSION}: begins with {bytes(data[:3])!r}")
    if zlib.crc32(body) != checksum:
        raise ValueError("a submap for the air is damaged: its checksum does not fit")
    inflater = zlib.decompressobj()
    try:
        rest = inflater.decompress(body, length + 1)
    except zlib.error as error:
        raise ValueError(f"a submap for the air is damaged: {error}") from error
    if len(rest) != length or not inflater.eof:
        raise ValueError(f"a submap for the air must inflate to {length} bytes")
    return rest


def _positions(landmarks: FloatArray) -> tuple[npt.NDArray[np.uint16], FloatArray, FloatArray]:
    """Positions in 65535ths of their box, the box (2, 3) of corner and size, and half a step (3,) m."""
    low = landmarks.min(axis=0, initial=np.inf) if len(landmarks) else np.zeros(3)
    high = landmarks.max(axis=0, initial=-np.inf) if len(landmarks) else np.zeros(3)
    box = np.array([np.nextafter(low.astype(np.float32), -np.inf), high - low], dtype=np.float32).astype(np.float64)
    box[1] = np.nextafter((high - box[0]).astype(np.float32), np.float32(np.inf))
    step = box[1] / _CELLS
    cells = np.rint((landmarks - box[0]) / np.maximum(step, 1e-12))
    return np.clip(cells, 0, _CELLS).astype(np.uint16), box, 0.5 * step


def _key_poses(submap: Submap, end_covariance: FloatArray, most: int) -> list[tuple[int, FloatArray, float]]:
    """Stamps, poses and covariance factors of some poses of the path, spread over its time; the ends are among them."""
    path = submap.path
    if len(path) > most:
        path = tuple(path[i] for i in np.unique(np.linspace(0, len(path) - 1, most).round().astype(np.int64)))
    L = np.linalg.inv(np.linalg.cholesky(end_covariance))
    out = []
    for p in path:
        factor = float(np.linalg.eigvalsh(L @ p.covariance @ L.T)[-1])
        up = np.nextafter(np.float16(min(max(factor, 0.0), 6e4)), np.float16(np.inf))
        out.append((p.stamp_ns, p.T, float(up)))
    return out


def _tangent(T: FloatArray) -> bytes:
    return np.asarray(boxminus(T, np.eye(4)), dtype="<f4").tobytes()


def _pose(tangent: FloatArray) -> FloatArray:
    T = boxplus(np.eye(4), tangent)
    if not is_rigid_transform(T):
        raise ValueError("a submap for the air has a pose that is none")
    return T
