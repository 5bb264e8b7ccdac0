# SPDX-License-Identifier: Apache-2.0
"""Submaps for the air beside whole ones: bytes, time, and the map that is joined from them.

    OPENBLAS_NUM_THREADS=1 python benchmarks/radio/light_submaps.py RUN ... [--landmarks 32 64 96 128] [--rank 8]

RUN: the folder of a run with its ``map``. Its submaps are packed and unpacked in order, and joined as whole ones are.
Columns: kB a submap, kB a metre of way between the submaps' ends, processor ms to pack and unpack, closures, parts of
the map, difference of the joined end poses to those of whole submaps (mm, rms), and their claimed sigma over that of
whole submaps (median and least).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from sjsam_node import storage
from sjsam_node.global_map import GlobalMap
from slam_core.geometry import FloatArray
from slam_core.types import Submap
from slam_radio.light_submap import LightConfig, pack, unpack

_COLUMNS = ("run", "landmarks", "kB", "kB/m", "ms", "closures", "parts", "difference mm", "sigma", "least")


@dataclass(frozen=True, eq=False)
class Joined:
    """End positions (n, 3) m of all submaps, their claimed sigma (n,) m, closures and parts of the map."""

    ends: FloatArray
    sigma: FloatArray
    closures: int
    parts: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--landmarks", type=int, nargs="+", default=(32, 64, 96, 128))
    parser.add_argument("--rank", type=int, default=8)
    arguments = parser.parse_args()
    table = Table(*_COLUMNS)
    for run in arguments.runs:
        submaps = [r.submap for r in storage.read(run / "map").state.graph.records]
        whole = joined(submaps)
        table.add_row(run.name, "all", "", "", "", str(whole.closures), str(whole.parts), "", "", "")
        for landmarks in arguments.landmarks:
            table.add_row(run.name, str(landmarks), *row(submaps, whole, LightConfig(landmarks, arguments.rank)))
    Console().print(table)


def row(submaps: Sequence[Submap], whole: Joined, config: LightConfig) -> Iterator[str]:
    """Figures of one size of submaps."""
    begun = time.process_time()
    sent = dict.fromkeys((s.agent for s in submaps), np.empty(0, dtype=np.int64))
    light, size = [], 0
    for submap in submaps:
        data = pack(submap, config, sent[submap.agent])
        light.append(unpack(data))
        sent[submap.agent] = light[-1].landmark_ids
        size += len(data)
    spent = time.process_time() - begun
    way = sum(float(np.linalg.norm(s.end_pose[:3, 3])) for s in submaps)
    found = joined(light)
    difference = np.linalg.norm(found.ends - whole.ends, axis=1)
    ratio: npt.NDArray[np.float64] = found.sigma[1:] / whole.sigma[1:]
    yield from (f"{size / len(submaps) / 1e3:.2f}", f"{size / way / 1e3:.2f}", f"{1e3 * spent / len(submaps):.1f}")
    yield from (str(found.closures), str(found.parts), f"{1e3 * np.sqrt(np.mean(difference**2)):.1f}")
    yield from (f"{np.median(ratio):.2f}", f"{ratio.min():.2f}")


def joined(submaps: Sequence[Submap]) -> Joined:
    """The settled map of submaps."""
    joined_map = GlobalMap()
    closures = sum(len(joined_map.add(submap).closures) for submap in submaps)
    joined_map.settle()
    snapshot = joined_map.snapshot()
    ends = [snapshot.end(record) for record in range(len(snapshot))]
    sigma = np.array([np.sqrt(np.trace(end.covariance[:3, :3])) for end in ends])
    return Joined(np.array([end.T[:3, 3] for end in ends]), sigma, closures, snapshot.components)


if __name__ == "__main__":
    main()
