# SPDX-License-Identifier: Apache-2.0
"""Damaged and forged submaps and views: each is refused by ValueError, or is one that can be used as any other.

    python benchmarks/radio/fuzz.py RUN [--messages 100000]
    python benchmarks/radio/fuzz.py --views [--messages 100000]

RUN: the folder of a run with its ``map``. Half of the messages are damaged as a channel does (bytes changed, cut, put
together of two), half are forged: the content is changed and the checksum made anew. ``--views``: instead of submaps
pictures, dense key frames, and the messages of pieces, of what is lacking and of what there is not. Prints how many
were refused and accepted; any other error than ValueError ends it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sjsam_node.map_file import storage
from slam_core.geometry import FloatArray
from slam_core.types import Submap
from slam_radio.packing.light_submap import ENVELOPE, LightConfig, pack, sealed, unpack
from slam_radio.views.depth_code import depth_levels
from slam_radio.views.view_format import PlacedImage, pack_view, rgb_of, unpack_view
from slam_radio.views.view_taker import encoded
from slam_radio.wire.view_messages import (
    Lack,
    ViewKey,
    pack_look,
    pack_piece,
    pack_unseen,
    pieces_of,
    unpack_look,
    unpack_piece,
    unpack_unseen,
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, nargs="?", metavar="RUN")
    parser.add_argument("--views", action="store_true")
    parser.add_argument("--messages", type=int, default=100_000)
    arguments = parser.parse_args()
    if arguments.views == (arguments.run is not None):
        parser.error("name a RUN, or --views")
    rng = np.random.default_rng(1)
    if arguments.views:
        for name, packed, read in views(rng):
            fuzz(f"{name}, ", packed, read, arguments.messages // 4, rng)
    else:
        records = storage.read(arguments.run / "map").state.graph.records
        fuzz("", [pack(r.submap, LightConfig(landmarks=16)) for r in records], read_submap, arguments.messages, rng)


def fuzz(
    name: str, packed: list[bytes], read: Callable[[bytes], object], messages: int, rng: np.random.Generator
) -> None:
    """Read damaged messages and forged ones, and print what became of them."""
    for kind, make in (("damaged", damaged), ("forged", forged)):
        refused = accepted = 0
        for _ in range(messages // 2):
            try:
                read(make(packed, rng))
            except ValueError:
                refused += 1
            else:
                accepted += 1
        print(f"{name}{kind}: {refused} refused, {accepted} accepted")


def read_submap(data: bytes) -> Submap:
    """Unpack a submap; one that is accepted has to be one."""
    submap = unpack(data)
    np.linalg.cholesky(submap.covariance)
    require_finite(submap.landmarks, "a submap's landmarks")
    return submap


def read_view(data: bytes) -> PlacedImage:
    """Unpack a view; one that is accepted has to be one."""
    view = unpack_view(data)
    require_finite(view.T_start_camera, "a view's pose")
    if view.jpeg and rgb_of(view.jpeg).shape[:2] != view.size[::-1]:
        raise SystemExit("a picture of another size than its view says was accepted")
    return view


def require_finite(numbers: FloatArray, what: str) -> None:
    if not np.isfinite(numbers).all():
        raise SystemExit(f"{what} that are not finite were accepted")


def views(rng: np.random.Generator) -> list[tuple[str, list[bytes], Callable[[bytes], object]]]:
    """Names, messages and readers of what is sent when a post asks for pictures and depth."""
    pixels = np.kron(rng.integers(0, 256, (6, 8, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    depth = np.linspace(0.5, 4.0, 48 * 64, dtype=np.float32).reshape(48, 64)
    levels, steps = depth_levels(depth, 0.01 * depth)
    shot = PlacedImage(1, 2, 10**9, 10**8, np.eye(4), (64, 48), (50.0, 50.0, 31.5, 23.5), encoded(pixels, 40))
    dense = PlacedImage(1, 2, 10**9, 10**8, np.eye(4), (64, 48), shot.intrinsics, shot.jpeg, levels, steps)
    packed, key = [pack_view(shot), pack_view(dense)], ViewKey(1, 2, 10**9)
    pieces = [pack_piece(piece) for data in packed for piece in pieces_of(key, 10**9, data)]
    lacks = [pack_look([Lack(key, k, 5 * k), Lack(key)]) for k in range(4)]
    return [
        ("views", packed, read_view),
        ("pieces", pieces, unpack_piece),
        ("looks", lacks, unpack_look),
        ("unseen", [pack_unseen([key, key])], unpack_unseen),
    ]


def damaged(packed: list[bytes], rng: np.random.Generator) -> bytes:
    """A message that a channel has spoilt; never one that was sent."""
    data = packed[rng.integers(len(packed))]
    how = rng.integers(3)
    if how == 0:
        spoilt = bytearray(data)
        for at in rng.choice(len(data), rng.integers(1, 9), replace=False):
            spoilt[at] ^= int(rng.integers(1, 256))
        return bytes(spoilt)
    cut = int(rng.integers(len(data)))
    return data[:cut] if how == 1 else data[:cut] + packed[rng.integers(len(packed))][cut + 1 :]


def forged(packed: list[bytes], rng: np.random.Generator) -> bytes:
    """A message whose content was changed, with a checksum that fits."""
    data = packed[rng.integers(len(packed))]
    magic, version, _ = ENVELOPE.unpack_from(data)
    rest = bytearray(data[ENVELOPE.size :])
    for at in rng.integers(len(rest), size=rng.integers(1, 9)):
        rest[at] = int(rng.integers(256))
    return sealed(magic, version, bytes(rest))


if __name__ == "__main__":
    main()
