# SPDX-License-Identifier: Apache-2.0
"""The work of ``slam merge``: bags are mapped by tasks, maps are read, all become one, with the results of a run."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dense_mapping.reconstruction.surface import Surface
from sjsam_node.map_file import storage
from sjsam_node.map_file.storage import StoredMap, is_map
from sjsam_node.merging.merge import Merged
from sjsam_node.merging.union import NamedMap
from sjsam_node.regions.tasks import Tasks
from sjsam_node.session.map_session import MapSession
from sjsam_node.tags.map_tags import map_tags, tags_text
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.doctor.examination import require_stereo
from slam_bringup.jobs.common_readout import SeenReadout, camera_key, readouts_of_others
from slam_bringup.pipeline.configuration import choose, overrides_for, system_config
from slam_bringup.pipeline.offline import run_bag
from slam_bringup.pipeline.overrides import Overrides
from slam_bringup.terminal.mapping_options import map_folder, mode_for
from slam_core.trajectory import Trajectory
from slam_viewer.results import AgentResult, LandmarkMap, RunResult


@dataclass(frozen=True, eq=False)
class Inputs:
    """The maps that are merged, and lines for the user."""

    maps: tuple[NamedMap, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class MappedBag:
    """The map of a bag, and the readout of its camera as its frames show it."""

    stored: StoredMap
    readout: SeenReadout


def read_inputs(
    paths: Sequence[Path], own: Overrides, tasks: Tasks, on_step: Callable[[str, int, int], None] = lambda *_: None
) -> Inputs:
    """The maps of finished runs, and those of bags, which tasks map as ``slam run`` does by default.

    Bags of one camera are mapped once more with the readout of its rolling shutter that the others show, where they do
    (:mod:`slam_bringup.jobs.common_readout`).

    Raises
    ------
    ValueError
        If one of them is neither, or a bag cannot be mapped.
    """
    maps, bags, step = list[NamedMap](), list[Path](), "reading and mapping"
    for path in paths:
        folder = map_folder(path, localize_only=False) or path
        if is_map(folder):
            maps.append(NamedMap(str(path), storage.read(folder)))
            on_step(step, len(maps), len(paths))
        elif folder != path:
            raise ValueError(f"{folder} is not a map of this program")
        else:
            with SensorBag(path):  # what cannot be read shows before anything is mapped
                bags.append(path)
    known = len(maps)
    mapped = _mapped(bags, [own] * len(bags), tasks, lambda done: on_step(step, known + done, len(paths)))
    others = readouts_of_others([one.readout for one in mapped])
    again = [k for k, readout in enumerate(others) if readout is not None]
    overrides = [own.with_values(readout.parameters, "other recordings") for readout in others if readout is not None]
    step = "mapping again, with a common readout"
    for k, one in zip(again, _mapped([bags[k] for k in again], overrides, tasks,
                                     lambda done: on_step(step, done, len(again))), strict=True):  # fmt: skip
        mapped[k] = one
    maps += [NamedMap(str(bag), one.stored) for bag, one in zip(bags, mapped, strict=True)]
    notes = tuple(f"{bags[k].name}: {readout.text}" for k, readout in enumerate(others) if readout is not None)
    return Inputs(tuple(maps), notes)


def _mapped(
    bags: Sequence[Path], overrides: Sequence[Overrides], tasks: Tasks, on_done: Callable[[int], None]
) -> list[MappedBag]:
    """Bags, mapped by a task each."""
    handles = [tasks.submit(map_of_bag, bag.resolve(), own) for bag, own in zip(bags, overrides, strict=True)]
    out = []
    for handle in handles:
        out += tasks.gather([handle])
        on_done(len(out))
    return out


def map_of_bag(path: Path, own: Overrides) -> MappedBag:
    """The map that ``slam run`` saves of a bag, with a user's own overrides.

    Raises
    ------
    ValueError
        If the bag cannot be read, or nothing of it was mapped.
    """
    with SensorBag(path) as opened:
        mode, sensors = mode_for(opened, None), list(opened.sensors.values())
    if mode != "tof":
        require_stereo(path, None)
    system = choose(system_config(overrides_for(path, own)), mode, "sjsam", "none", None)
    mapped = threading.Event()
    with MapSession(system.sjsam) as session, tempfile.TemporaryDirectory() as scratch:
        # No dense model is made for a merge: the run ends once the map is there.
        result, _ = run_bag(path, system, session=session, stopped=mapped.is_set, on_mapped=lambda _: mapped.set())
        if result.failure:
            raise ValueError(f"{path}: {result.failure}")
        if not len(session.snapshot):
            raise ValueError(f"nothing of {path} was mapped: slam doctor looks at the recording")
        folder = Path(scratch) / "map"
        session.save(folder, is_last=True).result()
        known, seen = system.ekf_slam.measurement.sigma_readout > 0.0, result.agents[0].readout_seen_s
        camera = "" if known or len(sensors) > 1 else camera_key(sensors[0].tof if mode == "tof" else sensors[0].left)
        return MappedBag(storage.read(folder), SeenReadout(camera, *seen))


def merged_result(merged: Merged, names: Sequence[str], wall_s: float, notes: Sequence[str] = ()) -> RunResult:
    """The merged map as the result of a run, so that all that shows a run shows it."""
    snapshot = merged.map.snapshot()
    landmarks, trajectories = snapshot.landmarks(), snapshot.trajectory()
    shown = snapshot.structure()
    agents = tuple(AgentResult(name, Trajectory.from_estimates(poses)) for name, poses in sorted(trajectories.items()))
    tags = map_tags(shown, landmarks)
    stamps = [agent.trajectory.stamps_ns for agent in agents if len(agent.trajectory)]
    said = tags_text(tags)
    return RunResult(
        bag=" + ".join(names),
        mode="merge",
        mapper="sjsam",
        odometry="none",
        agents=agents,
        map=shown,
        landmarks=LandmarkMap(landmarks.positions, landmarks.covariances, landmarks.sightings),
        dense=Surface.empty(),
        floor_plans=(),
        submaps=len(shown),
        loop_closures=int(np.count_nonzero([k.is_closure for k in merged.map.state.graph.links])),
        frames=sum(len(s) for s in stamps),
        dropped={},
        rejections=dict(merged.map.counters.counts),
        sensor_s=sum((s[-1] - s[0]) / 1e9 for s in stamps),
        wall_s=wall_s,
        stage_ms={},
        events=(*notes, *merged.notes, *filter(None, (parts_text(merged), snapshot.overconfidence, said))),
        tags=tags,
    )


def parts_text(merged: Merged) -> str:
    """A line on maps that nothing ties together; empty where all are one."""
    if len(merged.parts) < 2:
        return ""
    parts = "; ".join(" and ".join(names) for names in merged.parts)
    return f"{len(merged.parts)} separate parts, no common place was recognised: {parts}"
