# SPDX-License-Identifier: Apache-2.0
"""Bytes that the messages of CCM-SLAM, COVINS and Swarm-SLAM would need for a run's key frames, beside ours.

    python benchmarks/radio/others.py RUN ... [--step 0.3] [--turn 15]

RUN: the folder of a run of one agent, with ``result.mcap`` and ``map``. A frame is a key frame if the rig has moved by
``--step`` m or turned by ``--turn`` degrees since the last one; it has the features that our front end found in it.
Map points are our landmarks: those that are new with a key frame and those that it sees, as the submaps have them. All
descriptors of the others are binary ones of 32 bytes, as ORB and BRIEF have; ours are what we send. No system is run:
the fields of its messages are added up, without headers of transports, updates and answers. Sources, all at GitHub:

CCM-SLAM
    VIS4ROB-lab/ccm_slam, ``cslam_msgs/msg``: KF, MP, CvKeyPoint, Descriptor (ROS 1: an array has 4 bytes of length).
COVINS
    VIS4ROB-lab/covins, ``covins_comm/include/covins/covins_base``: ``msgs/msg_keyframe.hpp``, ``msgs/msg_landmark.hpp``
    and ``typedefs_base.hpp`` (cereal: 8 bytes of length of a vector or map, 8 of rows and columns of each matrix,
    16 of an id). Without images, inertial readings and the additional features of COVINS-G.
Swarm-SLAM
    lajoiepy/cslam_interfaces and introlab/rtabmap_ros, ``rtabmap_msgs/msg/SensorData.msg``: of each key frame a global
    descriptor of 64 numbers (its default, CosPlace with ResNet-18, as float32), and of a key frame that
    another robot asks for the features: 28 bytes a key point (as its own log counts), 12 its point, 32 its descriptor.
    Two rows: what all key frames need, and what it is if each is asked for once. Without images.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from sjsam_node.map_file import storage
from slam_bags.storage.bag import BagReader
from slam_core.geometry import boxminus
from slam_core.messages import stamp_ns
from slam_core.trajectory import read_trajectory
from slam_radio.packing.light_submap import pack

_ORB = 32
_VECTOR, _MATRIX, _PAIR = 8, 8, 16
"""Of cereal: length of a container, rows and columns of an Eigen matrix, a pair of size_t."""


@dataclass(frozen=True)
class KeyFrame:
    """Features of a key frame, those that are map points, and map points that are new with it."""

    features: float
    seen: float
    new: float


def ccm_slam(frame: KeyFrame) -> float:
    """Key frame and new map points of CCM-SLAM; a point's observations are that of this key frame."""
    key_point = 4 + 4 + 1 + 4 + 1 + 1
    fixed = (1 + 2 + 1 + 4 + 8 + 1) + (2 + 2 + 4 + 4) + 6 * 4 + 2 + (64 + 64 + 1 + 1 + 64) + (1 + 4 + 4 + 3 * 32)
    fixed += 4 * 2 + 36 + (2 + 1 + 2 + 1) + 1 + 5 * 4  # bounds, K, related key frames, bad; lengths of five arrays
    point = (
        (1 + 4 + 1 + 4 + 2 + 1 + 1) + (12 + 12 + 1 + 1) + (3 * 4 + 2 + 1 + 2) + (12 + 1) + _ORB + (3 + 3) + 1 + 8 + 1
    )
    return fixed + frame.features * (key_point + _ORB) + frame.seen * (4 + 1 + 2) + frame.new * point


def covins(frame: KeyFrame) -> float:
    """Key frame and new landmarks of COVINS."""
    vector3, pose = _MATRIX + 24, _MATRIX + 128
    calibration = pose + 4 + 4 + (_MATRIX + 16) + 2 * (_MATRIX + 32) + (_MATRIX + 72) + 10 * 8 + vector3 + 4 + 2 * 8
    feature = 2 * (_MATRIX + 8) + (_MATRIX + 16) + _ORB
    matrix = 4 + 4 + 4 + 1  # rows, columns, type and continuity of an OpenCV matrix
    fixed = 8 + _PAIR + calibration + 4 * 4 + 6 * _VECTOR + 3 * matrix + 2 * pose + 7 * vector3
    fixed += 4 * vector3 + 7 * _VECTOR + _VECTOR + 3 * _PAIR + 1  # preintegration without readings, landmarks, ids
    landmark = _PAIR + vector3 + (_VECTOR + _PAIR + 4) + _PAIR + 1
    return fixed + frame.features * feature + frame.seen * (4 + _PAIR) + frame.new * landmark


def swarm_slam_signature(frame: KeyFrame) -> float:
    """Global descriptor of Swarm-SLAM, with ids and length."""
    del frame
    return 4 + 4 + 4 + 64 * 4


def swarm_slam(frame: KeyFrame) -> float:
    """Global and local descriptors of Swarm-SLAM: ids and lengths, and the features."""
    return swarm_slam_signature(frame) + 6 * 4 + frame.features * (28 + 12 + _ORB)


OTHERS = {
    "CCM-SLAM": ccm_slam,
    "COVINS": covins,
    "Swarm-SLAM, signatures": swarm_slam_signature,
    "Swarm-SLAM, each asked for once": swarm_slam,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--step", type=float, default=0.3, help="m")
    parser.add_argument("--turn", type=float, default=15.0, help="degrees")
    arguments = parser.parse_args()
    table = Table("run", "key frames", "features", "seen", "new", "m", "system", "bytes a key frame", "kB/m")
    for run in arguments.runs:
        frames, way = key_frames(run, arguments.step, np.radians(arguments.turn))
        means = [f"{np.mean([getattr(f, name) for f in frames]):.0f}" for name in ("features", "seen", "new")]
        cells = [run.name, str(len(frames)), *means, f"{way:.1f}"]
        light = [len(pack(r.submap)) for r in storage.read(run / "map").state.graph.records]
        sizes = {"ours, with covariance": float(sum(light))}
        sizes |= {name: sum(map(count, frames)) for name, count in OTHERS.items()}
        for name, size in sizes.items():
            table.add_row(*cells, name, f"{size / len(frames):.0f}", f"{size / way / 1e3:.1f}")
            cells = [""] * len(cells)
    Console(width=140).print(table)


def key_frames(run: Path, step: float, turn: float) -> tuple[list[KeyFrame], float]:
    """The key frames of a run, and the length (m) of the way between their poses."""
    with BagReader(run / "result.mcap") as bag:
        found = {stamp_ns(m.message): m.message.width * m.message.height for m in bag.messages({"/features"})}
    trajectory = read_trajectory(run / "trajectory.tum")
    chosen: list[int] = []
    for k, T in enumerate(trajectory.poses):
        moved = boxminus(T, trajectory.poses[chosen[-1]]) if chosen else np.full(6, np.inf)
        if np.linalg.norm(moved[:3]) >= step or np.linalg.norm(moved[3:]) >= turn:
            chosen.append(k)
    stamps = np.array(sorted(found))
    features = [found[int(stamps[np.abs(stamps - trajectory.stamps_ns[k]).argmin()])] for k in chosen]
    submaps = [r.submap for r in storage.read(run / "map").state.graph.records]
    seen = sum(int(s.sightings.sum()) for s in submaps) / len(trajectory.poses)
    new = sum(len(s.landmarks) for s in submaps) / len(chosen)
    way = sum(float(np.linalg.norm(b[:3, 3] - a[:3, 3])) for a, b in pairwise(trajectory.poses[chosen]))
    return [KeyFrame(n, min(seen, n), min(new, n)) for n in features], way


if __name__ == "__main__":
    main()
