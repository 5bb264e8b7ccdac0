# SPDX-License-Identifier: Apache-2.0
"""Submaps for the air beside whole ones: bytes, time, and the map that is joined from them.

    OPENBLAS_NUM_THREADS=1 python benchmarks/radio/light_submaps.py RUN ... [--landmarks 64 96 128] [--rank 8]

RUN: the folder of a run with its ``map``, of one agent or of several (``split_agents.py``). Its submaps are packed and
unpacked in order, and joined as whole ones are. Columns: kB a submap, kB a metre of way between the submaps' ends,
processor ms to pack and to unpack a submap (median), closures that the settled map holds, and how many of these hold
between whole submaps too, parts of the map, position error (mm, all agents aligned together) and ANEES at the poses
that are sent, and the claimed sigma of the submaps' ends over that of whole submaps (median and least).

``--only``: what is done to submaps, to find what a loss is due to: ``landmarks`` are chosen, ``descriptors`` coded,
the ``gaussian`` compacted, the ``path`` thinned, and nothing else. ``--details``: with the details of all submaps,
which count too; ``--asked``: with those of the submaps that the map is undecided about, as a post asks for them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from rich.console import Console
from rich.table import Table

from sjsam_node.global_map import GlobalMap
from sjsam_node.map_file import storage
from sjsam_node.map_file.refining import undecided
from slam_core.evaluation import align, associate, evaluate
from slam_core.geometry import FloatArray
from slam_core.runtime.memory import share_one_heap
from slam_core.trajectory import Trajectory, read_trajectory
from slam_core.types import PoseEstimate, Submap
from slam_radio.packing import submap_details
from slam_radio.packing.compact_gaussian import compact_gaussian
from slam_radio.packing.descriptor_code import decode, encode
from slam_radio.packing.landmark_choice import choose_landmarks
from slam_radio.packing.light_submap import LightConfig, lightened, pack, unpack, write
from slam_radio.packing.submap_details import pack_details

_COLUMNS = ("run", "landmarks", "kB", "kB/m", "pack", "unpack", "closures", "of whole", "parts", "mm", "ANEES",
            "sigma", "least")  # fmt: skip
_TRUTH_GAP_S = 0.1
T = TypeVar("T")
Key = tuple[str, int, int]
Ends = tuple[tuple[str, int, int], tuple[str, int, int]]


@dataclass(frozen=True, eq=False)
class Joined:
    """Poses by agent, claimed sigma (n,) m of all submaps' ends, closures held, and parts of the map."""

    poses: dict[str, list[PoseEstimate]]
    sigma: FloatArray
    closures: set[Ends]
    parts: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--landmarks", type=int, nargs="+", default=(64, 96, 128, 160))
    parser.add_argument("--rank", type=int, default=LightConfig().rank)
    parser.add_argument("--only", choices=("landmarks", "descriptors", "gaussian", "path"))
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--details", action="store_true")
    which.add_argument("--asked", action="store_true")
    arguments = parser.parse_args()
    share_one_heap()  # as nodes do
    table = Table(*_COLUMNS)
    for run in arguments.runs:
        submaps = [r.submap for r in storage.read(run / "map").state.graph.records]
        stamps = {(s.agent, p.stamp_ns) for s in submaps for p in unpack(pack(s)).path}
        truth = truth_of(run, submaps)
        whole = joined(submaps)
        errors = accuracy(whole, truth, stamps)
        table.add_row(run.name, "all", "", "", "", "", str(len(whole.closures)), "", str(whole.parts), *errors)
        for landmarks in arguments.landmarks:
            config = LightConfig(landmarks, arguments.rank)
            if arguments.only:
                light, figures = [partly(s, arguments.only, config) for s in submaps], [""] * 4
            else:
                asked = {key_of(s) for s in submaps} if arguments.details else set()
                light, figures = packed(submaps, config, asked)
                while arguments.asked and (new := undecided_in(light) - asked):
                    asked |= new
                    light, figures = packed(submaps, config, asked)
            found = joined(light)
            cells = (*figures, *compared(found, whole, accuracy(found, truth, stamps)))
            table.add_row(run.name, str(landmarks), *cells)
    Console(width=140).print(table)


def packed(submaps: Sequence[Submap], config: LightConfig, asked: set[Key]) -> tuple[list[Submap], list[str]]:
    """Submaps as they arrive, some with details; kB, kB a metre, and ms of packing and of unpacking."""
    spent: tuple[list[float], list[float]] = ([], [])
    data = [timed(lambda s=s: messages(s, config, key_of(s) in asked), spent[0]) for s in submaps]  # type: ignore[misc]
    light = [timed(lambda d=d: unpacked(*d), spent[1]) for d in data]  # type: ignore[misc]
    way = sum(float(np.linalg.norm(s.end_pose[:3, 3])) for s in submaps)
    size = sum(len(message) for both in data for message in both if message)
    return light, [
        f"{size / len(submaps) / 1e3:.2f}",
        f"{size / way / 1e3:.2f}",
        *(f"{np.median(s):.1f}" for s in spent),
    ]


def key_of(submap: Submap) -> Key:
    """Agent, session and index."""
    return submap.agent, submap.session, submap.index


def undecided_in(submaps: Sequence[Submap]) -> set[Key]:
    """Submaps that their map is undecided about at some time, as they come."""
    joined_map, found = GlobalMap(), set[Key]()
    for submap in submaps:
        joined_map.add(submap)
        found |= undecided(joined_map.estimate.graph, joined_map.detector.pending)
    return found


def messages(submap: Submap, config: LightConfig, with_details: bool) -> tuple[bytes, bytes | None]:
    """The message of a submap, and that of its details."""
    light = lightened(submap, config)
    message = write(light)
    return message, pack_details(submap, light, message) if with_details else None


def unpacked(message: bytes, details: bytes | None) -> Submap:
    """The submap of its messages."""
    return unpack(message) if details is None else submap_details.with_details(message, details)


def timed(call: Callable[[], T], spent: list[float]) -> T:
    """What a call returns; the processor ms that it took are appended."""
    begun = time.process_time()
    result = call()
    spent.append(1e3 * (time.process_time() - begun))
    return result


def partly(submap: Submap, only: str, config: LightConfig) -> Submap:
    """The submap with one of its parts as it is sent, and the others as they are."""
    if only == "descriptors":
        return replace(submap, descriptors=decode(encode(submap.descriptors), submap.descriptors.shape[1]))
    if only == "gaussian":
        return replace(
            submap,
            covariance=compact_gaussian(
                submap.covariance, submap.landmarks - 0.5 * submap.end_pose[:3, 3], config.rank
            ).covariance(),
        )
    if only == "path":
        return replace(submap, path=unpack(pack(submap, config)).path)
    rows = choose_landmarks(submap, config.landmarks)
    unknowns = np.concatenate([np.arange(6), (6 + 3 * rows[:, None] + np.arange(3)).ravel()])
    return replace(
        submap, landmarks=submap.landmarks[rows], covariance=submap.covariance[np.ix_(unknowns, unknowns)],
        landmark_ids=submap.landmark_ids[rows], sightings=submap.sightings[rows], descriptors=submap.descriptors[rows],
    )  # fmt: skip


def compared(found: Joined, whole: Joined, errors: Sequence[str]) -> Iterator[str]:
    """Figures of a map beside that of whole submaps."""
    ratio = found.sigma[1:] / whole.sigma[1:]
    yield from (str(len(found.closures)), str(len(found.closures & whole.closures)), str(found.parts), *errors)
    yield from (f"{np.median(ratio):.2f}", f"{ratio.min():.2f}")


def joined(submaps: Sequence[Submap]) -> Joined:
    """The settled map of submaps."""
    joined_map = GlobalMap()
    for submap in submaps:
        joined_map.add(submap)
    joined_map.settle()
    snapshot, records = joined_map.snapshot(), joined_map.estimate.graph.records
    sigma = [np.sqrt(np.trace(snapshot.end(record).covariance[:3, :3])) for record in range(len(snapshot))]
    closures = {(records[k.first].key, records[k.second].key) for k in joined_map.estimate.graph.links if k.is_closure}
    ordered = {(min(ends), max(ends)) for ends in closures}
    return Joined(snapshot.trajectory(), np.array(sigma), ordered, snapshot.components)


def truth_of(run: Path, submaps: Sequence[Submap]) -> dict[str, Trajectory]:
    """True poses by agent."""
    return {
        agent: read_trajectory(run / (f"ground_truth_{agent}.tum" if agent else "ground_truth.tum"))
        for agent in {s.agent for s in submaps}
    }


def accuracy(found: Joined, truth: dict[str, Trajectory], stamps: set[tuple[str, int]]) -> tuple[str, str]:
    """Position error mm, all agents in one frame, and ANEES, mean of all poses, each from its agent's start.

    stamps: agent and stamp of the poses that count.
    """
    estimates, truths, nees = [], [], []
    for agent, own in truth.items():
        estimate = Trajectory.from_estimates(p for p in found.poses[agent] if (agent, p.stamp_ns) in stamps)
        matched, true_poses = associate(estimate, own, _TRUTH_GAP_S, interpolate=True)
        estimates.append(matched.poses)
        truths.append(true_poses)
        result = evaluate(estimate, own, interpolate=True, max_difference_s=_TRUTH_GAP_S)
        nees += [result.anees] * len(matched) if result.anees is not None else []
    poses, true_poses = np.concatenate(estimates), np.concatenate(truths)
    gap = align(poses, true_poses)[:, :3, 3] - true_poses[:, :3, 3]
    return f"{1e3 * np.sqrt((gap**2).sum(axis=1).mean()):.1f}", f"{np.mean(nees):.2f}"


if __name__ == "__main__":
    main()
