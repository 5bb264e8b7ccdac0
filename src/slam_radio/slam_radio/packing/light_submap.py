# SPDX-License-Identifier: Apache-2.0
"""A submap for the air: what joining needs, in about four kilobytes, and no surer than the submap itself.

    data = pack(submap, LightConfig())
    light = unpack(data)            # a Submap, with fewer landmarks

Format, version 3, little endian. A message is

==========  ==========================================================================================
``b"SL"``   two bytes
u8          version
u32         CRC-32 of the rest
bytes       the rest
==========  ==========================================================================================

The rest, with n landmarks in the order of their ids, r common directions, c numbers a descriptor and k poses:

==================  ===================================================================================
u8, bytes           length of the agent's name, the name (UTF-8)
u32, u32, u8        session; index; 1 if it follows the submap before, 2 if the path begins at the start,
                    4 if it ends at the end: these two poses are left out
i64, i64            stamps of start and end, ns
u16, u8, i8         n, r, power of two m of the positions' grid
u16, u16, u8        dimension of descriptors, c, k
6 x f32             tangent of the end pose: translation m, rotation rad
21 x f16            lower triangle of the pose's Cholesky factor, mm and mrad
f32                 inflation t (:mod:`slam_radio.packing.compact_gaussian`)
k x (i64, 6 x f32)  poses of the path: stamp, tangent of T_start_rig
f16 each            of each pose of the path, the left out ones too, the factor by which the end pose's
                    covariance covers its own
to the end          columns of numbers, range coded (:mod:`slam_radio.packing.symbol_code`), for r > 0 first
                    the pose's (6, r) of U; then the landmarks': positions x, y, z in steps of the grid,
                    6 of factors, ids, each less the one before, sightings, at most 255,
                    (3n, r) of U, (n, c) of descriptors (:mod:`slam_radio.packing.descriptor_code`)
==================  ===================================================================================
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
from slam_radio.packing.byte_reader import ByteReader
from slam_radio.packing.compact_gaussian import MOST_INFLATION, CompactGaussian, compact_gaussian
from slam_radio.packing.descriptor_code import decode, encode
from slam_radio.packing.landmark_block import LandmarkBlock, grid_exponent, half_step, on_grid, shown_sightings
from slam_radio.packing.landmark_choice import choose_landmarks
from slam_radio.packing.symbol_code import IntArray, SymbolReader, SymbolWriter

MAGIC, VERSION = b"SL", 3
MOST_BYTES = 2**16
ENVELOPE = struct.Struct("<2sBI")
_HEADER, _STAMPS, _COUNTS = struct.Struct("<IIB"), struct.Struct("<qq"), struct.Struct("<HBbHHB")
_FOLLOWS, _BEGINS, _ENDS = 1, 2, 4
_LEAST_FACTOR = 1e-6
"""Covariance of the first pose, which is exact, over that of the end pose: keeps it positive definite."""


@dataclass(frozen=True)
class LightConfig(Config):
    """Size of a submap for the air."""

    landmarks: int = parameter(128, "landmarks that are sent of a submap", minimum=3, maximum=200)
    rank: int = parameter(8, "directions in which the errors of a submap's unknowns are said to be common",
                          minimum=1, maximum=64)  # fmt: skip
    poses: int = parameter(4, "poses of the path that are sent of a submap", minimum=2, maximum=255)


@dataclass(frozen=True, eq=False)
class LightSubmap:
    """The content of a message.

    ``path`` has stamps, poses and covariance factors; ``pose`` and ``pose_common`` are parts of the Gaussian.
    """

    agent: str
    session: int
    index: int
    follows_previous: bool
    start_stamp_ns: int
    end_stamp_ns: int
    end_pose: FloatArray
    path: list[tuple[int, FloatArray, float]]
    dimension: int
    pose: npt.NDArray[np.float16]
    pose_common: IntArray
    inflation: float
    landmarks: LandmarkBlock

    @property
    def middle(self) -> FloatArray:
        """Point from which the landmarks are seen, nearly: halfway to the end, (3,) m."""
        return np.asarray(0.5 * self.end_pose[:3, 3])

    @property
    def gaussian(self) -> CompactGaussian:
        """The joint Gaussian of end pose and landmarks."""
        block = self.landmarks
        common = np.concatenate([self.pose_common, block.common])
        return CompactGaussian(self.pose, block.factors, block.points - self.middle, common, self.inflation)

    def submap(self, gaussian: CompactGaussian | None = None, *more: LandmarkBlock) -> Submap:
        """The submap, with more landmarks behind its own where ``gaussian`` has them.

        Raises
        ------
        ValueError
            If the covariance is not positive definite, or nearly so.
        """
        gaussian = gaussian or self.gaussian
        gaussian.require_positive()
        covariance = gaussian.covariance()
        blocks = (self.landmarks, *more)
        codes = np.concatenate([block.codes for block in blocks])
        return Submap(
            agent=self.agent, index=self.index, start_stamp_ns=self.start_stamp_ns, end_stamp_ns=self.end_stamp_ns,
            end_pose=self.end_pose, landmarks=np.concatenate([block.points for block in blocks]),
            covariance=covariance, landmark_ids=np.concatenate([block.ids for block in blocks]),
            sightings=np.concatenate([block.sightings for block in blocks]).astype(np.int32),
            descriptors=decode(codes, self.dimension), follows_previous=self.follows_previous, session=self.session,
            path=tuple(
                PoseEstimate(stamp, T, max(factor, _LEAST_FACTOR) * covariance[:6, :6])
                for stamp, T, factor in self.path
            ),
        )  # fmt: skip


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
    return write(lightened(submap, config or LightConfig()))


def unpack(data: bytes) -> Submap:
    """The submap of a message, with the landmarks that were sent.

    Raises
    ------
    ValueError
        If the message is damaged, of another version, or says what cannot be.
    """
    return read(data).submap()


def lightened(submap: Submap, config: LightConfig) -> LightSubmap:
    """The content of a submap's message; ``ValueError`` as :func:`pack`."""
    rows = choose_landmarks(submap, config.landmarks)
    covariance = submap.covariance[np.ix_(*2 * [unknowns_of(rows)])]
    blocks = covariance[6:, 6:].reshape(len(rows), 3, len(rows), 3)[np.arange(len(rows)), :, np.arange(len(rows)), :]
    exponent = grid_exponent(blocks)
    cells = on_grid(submap.landmarks[rows], exponent)
    end_pose = _pose(_tangent(submap.end_pose).astype(np.float64))
    rays = np.ldexp(cells.astype(np.float64), exponent) - 0.5 * end_pose[:3, 3]
    gaussian = compact_gaussian(covariance, rays, config.rank, half_step(exponent))
    return LightSubmap(
        agent=submap.agent, session=submap.session, index=submap.index, follows_previous=submap.follows_previous,
        start_stamp_ns=submap.start_stamp_ns, end_stamp_ns=submap.end_stamp_ns, end_pose=end_pose,
        path=_key_poses(submap, gaussian.end_covariance(), config.poses), dimension=submap.descriptors.shape[1],
        pose=gaussian.pose, pose_common=gaussian.common[:6], inflation=gaussian.inflation,
        landmarks=LandmarkBlock(
            exponent, cells, gaussian.factors, gaussian.common[6:], submap.landmark_ids[rows].astype(np.int64),
            shown_sightings(submap.sightings[rows]), encode(submap.descriptors[rows]),
        ),
    )  # fmt: skip


def unknowns_of(rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Rows of a submap's covariance that are those of its end pose and of some landmarks."""
    return np.concatenate([np.arange(6), (6 + 3 * rows[:, None] + np.arange(3)).ravel()])


def write(light: LightSubmap) -> bytes:
    """The message of what is sent."""
    name, block, path = light.agent.encode(), light.landmarks, light.path
    if len(name) > 255:
        raise ValueError(f"an agent's name may have 255 bytes, '{light.agent[:20]}...' has {len(name)}")
    begins = bool(path) and path[0][0] == light.start_stamp_ns and _is_same(path[0][1], np.eye(4))
    ends = len(path) > begins and path[-1][0] == light.end_stamp_ns and _is_same(path[-1][1], light.end_pose)
    inner = path[int(begins) : len(path) - int(ends)]
    writer = SymbolWriter()
    writer.columns(light.pose_common)
    block.write(writer)
    rest = b"".join([
        struct.pack("<B", len(name)), name,
        _HEADER.pack(light.session, light.index, _FOLLOWS * light.follows_previous + _BEGINS * begins + _ENDS * ends),
        _STAMPS.pack(light.start_stamp_ns, light.end_stamp_ns),
        _COUNTS.pack(len(block), light.pose_common.shape[1], block.exponent, light.dimension, block.codes.shape[1],
                     len(inner)),
        _tangent(light.end_pose).tobytes(), light.pose.astype("<f2").tobytes(), struct.pack("<f", light.inflation),
        *(struct.pack("<q", stamp) + _tangent(T).tobytes() for stamp, T, _ in inner),
        np.array([factor for _, _, factor in path], dtype="<f2").tobytes(),
        writer.bytes(),
    ])  # fmt: skip
    if len(rest) + ENVELOPE.size > MOST_BYTES:
        raise ValueError(f"a submap for the air may have {MOST_BYTES} bytes, this one has {len(rest)}")
    return sealed(MAGIC, VERSION, rest)


def read(data: bytes) -> LightSubmap:
    """The content of a message; ``ValueError`` as :func:`unpack`."""
    reader = ByteReader(opened(data, MAGIC, VERSION, "submap for the air"))
    agent = reader.text(reader.number("<B"))
    session, index, flags = reader.numbers(_HEADER.format)
    start, end = reader.numbers(_STAMPS.format)
    n, rank, exponent, dimension, width, k = reader.numbers(_COUNTS.format)
    end_pose = _pose(reader.floats("<f4", (6,)))
    pose = reader.array("<f2", (21,)).astype(np.float16)
    (inflation,) = reader.numbers("<f")
    path = [(*reader.numbers("<q"), _pose(reader.floats("<f4", (6,)))) for _ in range(k)]
    if flags & _BEGINS:
        path.insert(0, (start, np.eye(4)))
    if flags & _ENDS:
        path.append((end, end_pose))
    factors = reader.floats("<f2", (len(path),))
    if not 1.0 <= inflation < MOST_INFLATION or flags > 7 or end < start or (factors < 0.0).any():
        raise ValueError("a submap for the air holds numbers that cannot be")
    symbols = SymbolReader(reader.bytes())
    pose_common = symbols.columns(6, min(rank, 65))
    landmarks = LandmarkBlock.read(symbols, exponent, n, rank, width)
    symbols.require_end()
    return LightSubmap(
        agent=agent, session=session, index=index, follows_previous=bool(flags & _FOLLOWS), start_stamp_ns=start,
        end_stamp_ns=end, end_pose=end_pose, dimension=dimension, pose=pose, pose_common=pose_common,
        path=[(stamp, T, float(factor)) for (stamp, T), factor in zip(path, factors, strict=True)],
        inflation=inflation, landmarks=landmarks,
    )  # fmt: skip


def sealed(magic: bytes, version: int, rest: bytes) -> bytes:
    """A message with its envelope."""
    return ENVELOPE.pack(magic, version, zlib.crc32(rest)) + rest


def opened(data: bytes, magic: bytes, version: int, name: str) -> bytes:
    """The rest of a message without its envelope; ``ValueError`` if it is damaged or another one."""
    if not ENVELOPE.size <= len(data) <= MOST_BYTES:
        raise ValueError(f"a {name} has {ENVELOPE.size} to {MOST_BYTES} bytes, got {len(data)}")
    found, found_version, checksum = ENVELOPE.unpack_from(data)
    if found != magic or found_version != version:
        raise ValueError(f"not a {name} of version {version}: begins with {bytes(data[:3])!r}")
    rest = bytes(data[ENVELOPE.size :])
    if zlib.crc32(rest) != checksum:
        raise ValueError(f"a {name} is damaged: its checksum does not fit")
    return rest


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


def _is_same(first: FloatArray, second: FloatArray) -> bool:
    """True if two poses are the same, but for the rounding of what is sent."""
    return bool(np.abs(first - second).max() < 1e-6)


def _tangent(T: FloatArray) -> npt.NDArray[np.float32]:
    return np.asarray(boxminus(T, np.eye(4)), dtype="<f4")


def _pose(tangent: FloatArray) -> FloatArray:
    T = boxplus(np.eye(4), tangent)
    if not is_rigid_transform(T):
        raise ValueError("a submap for the air has a pose that is none")
    return T
