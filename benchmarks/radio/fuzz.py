# SPDX-License-Identifier: Apache-2.0
"""Damaged and forged submaps for the air: each is refused by ValueError, or is a submap that joins as any other.

    python benchmarks/radio/fuzz.py RUN [--messages 100000]

RUN: the folder of a run with its ``map``. Half of the messages are damaged as a channel does (bytes changed, cut, put
together of two), half are forged: the content is changed and the checksum made anew. Prints how many were refused and
accepted; any other error than ValueError ends it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from sjsam_node.map_file import storage
from slam_radio.packing.light_submap import ENVELOPE, MAGIC, VERSION, LightConfig, pack, sealed, unpack


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("--messages", type=int, default=100_000)
    arguments = parser.parse_args()
    records = storage.read(arguments.run / "map").state.graph.records
    packed = [pack(r.submap, LightConfig(landmarks=16)) for r in records]
    rng = np.random.default_rng(1)
    for kind, make in (("damaged", damaged), ("forged", forged)):
        refused = accepted = 0
        for _ in range(arguments.messages // 2):
            try:
                submap = unpack(make(packed, rng))
            except ValueError:
                refused += 1
            else:
                accepted += 1
                np.linalg.cholesky(submap.covariance)
                if not np.isfinite(submap.landmarks).all():
                    raise SystemExit("a submap with landmarks that are not finite was accepted")
        print(f"{kind}: {refused} refused, {accepted} accepted")


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
    rest = bytearray(packed[rng.integers(len(packed))][ENVELOPE.size :])
    for at in rng.integers(len(rest), size=rng.integers(1, 9)):
        rest[at] = int(rng.integers(256))
    return sealed(MAGIC, VERSION, bytes(rest))


if __name__ == "__main__":
    main()
