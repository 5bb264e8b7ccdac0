# SPDX-License-Identifier: Apache-2.0
"""Submaps of real and rendered bags, filtered once and kept, so that joining is measured without the rest.

    python benchmarks/joining/recorded_submaps.py BAG OUT.pickle [--mode stereo] [--to-and-fro 200 [--frames 4]]

``--to-and-fro`` shows the bag's features to the filter forwards and backwards until it has made so many submaps;
``--frames`` only its first ones: a rig that stands still.
"""

from __future__ import annotations

import argparse
import pickle
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import problems  # noqa: F401 - sets the import path

from ekf_slam_node.slam import EkfSlam
from sjsam_node.global_map import GlobalMap, JoinReport
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.trajectory import Trajectory
from slam_core.types import Features, Submap


@dataclass(frozen=True, eq=False)
class Recording:
    """Ground truth of every agent, the filter's own poses, and the number of submaps.

    sensor_s: duration of the recording. features_s: time that its features took, by the wall.
    """

    count: int
    truth: dict[str, Trajectory]
    filtered: dict[str, Trajectory]
    sensor_s: float
    features_s: float


def record(bag: Path, mode: str, odometry: str) -> tuple[Recording, list[Submap]]:
    """Submaps of a bag in the order in which they were finished, which nothing joins."""
    submaps: list[Submap] = []

    def store(_: GlobalMap, submap: Submap) -> JoinReport:
        submaps.append(submap)
        return JoinReport(True)

    with patch.object(GlobalMap, "add", store):
        result, _ = run_bag(bag, choose(load_system_config(None), mode, "sjsam", odometry), odometry=odometry)
    features_s = 1e-3 * sum(sum(result.stage_ms.get(stage, [])) for stage in ("keypoints", "features"))
    truth = {agent.name: agent.truth for agent in result.agents}
    filtered = {agent.name: agent.filtered for agent in result.agents}
    return Recording(len(submaps), truth, filtered, result.sensor_s, features_s), submaps


def record_to_and_fro(bag: Path, mode: str, count: int, frames: int | None) -> tuple[Recording, list[Submap]]:
    """``count`` submaps of a bag whose (first) features are seen forwards, backwards, forwards again and so on."""
    seen: list[tuple[EkfSlam, Features]] = []
    process = EkfSlam.process

    def remember(ekf: EkfSlam, features: Features) -> object:
        seen.append((ekf, features))
        return process(ekf, features)

    with patch.object(EkfSlam, "process", remember):
        once, _ = record(bag, mode, "none")
    features = [f for _, f in seen][:frames]
    ekf = EkfSlam(seen[0][0].config, seen[0][0]._T_rig_optical)
    stamps = np.array([f.stamp_ns for f in features])
    step, (agent, truth) = int(np.median(np.diff(stamps))), next(iter(once.truth.items()))
    at = truth.interpolate(stamps)
    submaps: list[Submap] = []
    stamps_ns, true_poses, estimates, k, direction = [], [], [], 0, 1
    while len(submaps) < count:
        stamp = int(stamps[0]) + step * len(stamps_ns)
        found = ekf.process(replace(features[k], stamp_ns=stamp))
        submaps += found.submaps
        stamps_ns.append(stamp)
        true_poses.append(at[k])
        estimates.append(found.pose)
        if not 0 <= k + direction < len(features):
            direction = -direction
        k = min(max(k + direction, 0), len(features) - 1)
    walked = Trajectory(np.array(stamps_ns), np.array(true_poses))
    filtered = Trajectory.from_estimates(estimates)
    passes = len(stamps_ns) / len(features)
    sensor_s = 1e-9 * (stamps_ns[-1] - stamps_ns[0])
    return Recording(len(submaps), {agent: walked}, {agent: filtered}, sensor_s, passes * once.features_s), submaps


def load(path: Path) -> tuple[Recording, Iterator[Submap]]:
    """A recording that :func:`store` wrote; its submaps are read as they are asked for."""
    file = path.open("rb")
    recording: Recording = pickle.load(file)
    return recording, (pickle.load(file) for _ in range(recording.count))


def store(path: Path, recording: Recording, submaps: list[Submap]) -> None:
    """Write a recording, then its submaps one by one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        for part in (recording, *submaps):
            pickle.dump(part, file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--mode", default="stereo")
    parser.add_argument("--odometry", default="none")
    parser.add_argument("--to-and-fro", type=int, default=0, metavar="SUBMAPS")
    parser.add_argument("--frames", type=int)
    arguments = parser.parse_args()
    if arguments.to_and_fro:
        recording, submaps = record_to_and_fro(arguments.bag, arguments.mode, arguments.to_and_fro, arguments.frames)
    else:
        recording, submaps = record(arguments.bag, arguments.mode, arguments.odometry)
    store(arguments.output, recording, submaps)
    print(f"{arguments.output}: {recording.count} submaps of {recording.sensor_s:.1f} s")


if __name__ == "__main__":
    # Under its own name, so that what is pickled is found again by whoever imports this file.
    import recorded_submaps

    recorded_submaps.main()
