# SPDX-License-Identifier: Apache-2.0
"""A submap for the air: what joining needs, in about four kilobytes, and no surer than the submap itself.

    data = pack(submap, LightConfig())
    light = unpack(data)            # a Submap, with fewer landmarks

Format, version 4, little endian. A message is

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
k x (i64, 6 x f32,  poses of the path: stamp, tangent of T_start_rig, and standard deviations, mm and mrad, of
6 x f16)            a diagonal covariance that covers its own in every direction
to the end          columns of numbers, range coded (:mod:`slam_radio.packing.symbol_code`), for r > 0 first
                    the pose's (6, r) of U; then the landmarks': positions x, y, z in steps of the grid,
                    6 of factors, the first id, the others less those before, sightings, at most 255,
                    (3n, r) of U, (n, c) of descriptors (:mod:`slam_radio.packing.descriptor_code`)
==================  ===================================================================================

Version 3 is read too: files of before lie on disks. Its poses of the path have no standard deviations; behind them
stands an f16 for each, for those that are left out too: the factor by which the end pose's covariance covers its own.
All ids are one column, the first one too.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray
from slam_core.types import Submap
from slam_radio.packing.byte_reader import ByteReader
from slam_radio.packing.compact_gaussian import MOST_INFLATION, CompactGaussian, compact_gaussian
from slam_radio.packing.descriptor_code import decode, encode, is_of_basis
from slam_radio.packing.earlier_poses import EarlierPoses
from slam_radio.packing.key_poses import KeyPoses, pose_of, tangent_of
from slam_radio.packing.landmark_block import LandmarkBlock, grid_exponent, half_step, on_grid, shown_sightings
from slam_radio.packing.landmark_choice import choose_landmarks
from slam_radio.packing.symbol_code import IntArray, SymbolReader, SymbolWriter

MAGIC, VERSION, _EARLIER = b"SL", 4, 3
MOST_BYTES = 2**16
ENVELOPE = struct.Struct("<2sBI")
_HEADER, _STAMPS, _COUNTS = struct.Struct("<IIB"), struct.Struct("<qq"), struct.Struct("<HBbHHB")
_FOLLOWS, _BEGINS, _ENDS = 1, 2, 4


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

    ``pose`` and ``pose_common`` are parts of the Gaussian.
    """

    agent: str
    session: int
    index: int
    follows_previous: bool
    start_stamp_ns: int
    end_stamp_ns: int
    end_pose: FloatArray
    path: KeyPoses
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
            path=self.path.estimates(self.start_stamp_ns, self.end_stamp_ns, self.end_pose, covariance[:6, :6]),
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
    unknowns = unknowns_of(rows)
    covariance = submap.covariance.take(unknowns, 0).take(unknowns, 1)
    blocks = covariance[6:, 6:].reshape(len(rows), 3, len(rows), 3)[np.arange(len(rows)), :, np.arange(len(rows)), :]
    exponent = grid_exponent(blocks)
    cells = on_grid(submap.landmarks[rows], exponent)
    end_pose = pose_of(tangent_of(submap.end_pose).astype(np.float64))
    rays = np.ldexp(cells.astype(np.float64), exponent) - 0.5 * end_pose[:3, 3]
    gaussian = compact_gaussian(covariance, rays, config.rank, half_step(exponent))
    return LightSubmap(
        agent=submap.agent, session=submap.session, index=submap.index, follows_previous=submap.follows_previous,
        start_stamp_ns=submap.start_stamp_ns, end_stamp_ns=submap.end_stamp_ns, end_pose=end_pose,
        path=KeyPoses.of(submap, end_pose, gaussian.end_covariance(), config.poses),
        dimension=submap.descriptors.shape[1], pose=gaussian.pose, pose_common=gaussian.common[:6],
        inflation=gaussian.inflation,
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
    flags = _FOLLOWS * light.follows_previous + _BEGINS * path.begins + _ENDS * path.ends
    writer = SymbolWriter()
    writer.columns(light.pose_common)
    block.write(writer)
    rest = b"".join([
        struct.pack("<B", len(name)), name,
        _HEADER.pack(light.session, light.index, flags),
        _STAMPS.pack(light.start_stamp_ns, light.end_stamp_ns),
        _COUNTS.pack(len(block), light.pose_common.shape[1], block.exponent, light.dimension, block.codes.shape[1],
                     len(path.inner)),
        tangent_of(light.end_pose).tobytes(), light.pose.astype("<f2").tobytes(), struct.pack("<f", light.inflation),
        path.bytes(), writer.bytes(),
    ])  # fmt: skip
    if len(rest) + ENVELOPE.size > MOST_BYTES:
        raise ValueError(f"a submap for the air may have {MOST_BYTES} bytes, this one has {len(rest)}")
    return sealed(MAGIC, VERSION, rest)


def read(data: bytes) -> LightSubmap:
    """The content of a message; ``ValueError`` as :func:`unpack`."""
    version = said_version(data, VERSION, _EARLIER)
    reader = ByteReader(opened(data, MAGIC, version, "submap for the air"))
    agent = reader.text(reader.number("<B"))
    session, index, flags = reader.numbers(_HEADER.format)
    start, end = reader.numbers(_STAMPS.format)
    n, rank, exponent, dimension, width, k = reader.numbers(_COUNTS.format)
    end_pose = pose_of(reader.floats("<f4", (6,)))
    pose = reader.array("<f2", (21,)).astype(np.float16)
    (inflation,) = reader.numbers("<f")
    begins, ends = bool(flags & _BEGINS), bool(flags & _ENDS)
    poses: type[KeyPoses | EarlierPoses] = EarlierPoses if version == _EARLIER else KeyPoses
    path = poses.read(reader, k, begins=begins, ends=ends)
    if not 1.0 <= inflation < MOST_INFLATION or flags > 7 or end < start:
        raise ValueError("a submap for the air holds numbers that cannot be")
    if width != dimension and not is_of_basis(width, dimension):
        raise ValueError(f"a submap for the air has descriptors of {dimension} numbers, of which it sends {width}")
    symbols = SymbolReader(reader.bytes())
    pose_common = symbols.columns(6, min(rank, 65))
    landmarks = LandmarkBlock.read(symbols, exponent, n, rank, width, has_ids_together=version == _EARLIER)
    symbols.require_end()
    light = LightSubmap(
        agent=agent, session=session, index=index, follows_previous=bool(flags & _FOLLOWS), start_stamp_ns=start,
        end_stamp_ns=end, end_pose=end_pose, dimension=dimension, pose=pose, pose_common=pose_common,
        path=KeyPoses(begins, ends, []) if isinstance(path, EarlierPoses) else path, inflation=inflation,
        landmarks=landmarks,
    )  # fmt: skip
    if not isinstance(path, EarlierPoses):
        return light
    light.gaussian.require_positive()
    return replace(light, path=path.key_poses(start, end, end_pose, light.gaussian.end_covariance()))


def sealed(magic: bytes, version: int, rest: bytes) -> bytes:
    """A message with its envelope."""
    return ENVELOPE.pack(magic, version, zlib.crc32(rest)) + rest


def said_version(data: bytes, *known: int) -> int:
    """The version of a message, the first known one if it is none of those."""
    return data[2] if len(data) > 2 and data[2] in known else known[0]


def opened(data: bytes, magic: bytes, version: int, name: str, most_bytes: int = MOST_BYTES) -> bytes:
    """The rest of a message without its envelope; ``ValueError`` if it is damaged or another one."""
    if not ENVELOPE.size <= len(data) <= most_bytes:
        raise ValueError(f"a {name} has {ENVELOPE.size} to {most_bytes} bytes, got {len(data)}")
    found, found_version, checksum = ENVELOPE.unpack_from(data)
    if found != magic or found_version != version:
        raise ValueError(f"not a {name} of version {version}: begins with {bytes(data[:3])!r}")
    rest = bytes(data[ENVELOPE.size :])
    if zlib.crc32(rest) != checksum:
        raise ValueError(f"a {name} is damaged: its checksum does not fit")
    return rest
