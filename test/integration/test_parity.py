# SPDX-License-Identifier: Apache-2.0
"""The bag in bags/, an IMU and an odometry through the nodes and offline: the same trajectory and map, nothing lost."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from calibration_folder import write_calibrations
from mapping import without_dense_model
from sjsam_node.session.map_session import MapSession, Mode
from slam_bags.reading.rig_calibration import read_rig_calibration
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames
from slam_bags.storage.bag import BagReader, BagWriter
from slam_bags.storage.sensor_writer import IMU_FRAME, SensorWriter
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_bringup.processes.online_run import run_nodes
from slam_bringup.processes.recorded_run import collect
from slam_bringup.processes.start_map import StartMap
from slam_core.geometry import make_transform, so3_exp, so3_log
from slam_core.types import ImuSample, OdometryReading
from slam_viewer.results import summarise

pytestmark = [pytest.mark.ros, pytest.mark.slow]

DEMO = Path(__file__).resolve().parents[2] / "bags" / "demo"
FRAMES_NS = 2_500_000_000
IMU_STEP_NS = 10_000_000
IMU_OFFSET_NS = 3_000_000
ODOMETRY_STEP_NS = 23_000_000
ROUNDED_IN_A_QUATERNION = 1e-14
"""Error of a rotation matrix that went through an Odometry message; maps do not go through one."""
T_BASE_IMU = make_transform(so3_exp(np.array([0.0, 0.0, 0.5 * np.pi])), np.array([0.1, 0.0, 0.0]))


@pytest.fixture(scope="module")
def short_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 2.5 s of the bag in bags/, and an IMU and an odometry whose stamps are not the cameras'."""
    if not DEMO.is_dir():
        pytest.skip(f"no bag at {DEMO}")
    path = tmp_path_factory.mktemp("bags") / "short"
    with BagReader(DEMO) as long, BagWriter(path) as short:
        types = {topic: info.type_name for topic, info in long.topics.items()}
        writer, samples, poses = SensorWriter(short), turn_rates(long.start_ns), odometry(long.start_ns)
        writer.extrinsics(long.start_ns, {IMU_FRAME: T_BASE_IMU})
        for topic, stamp, data in long.raw():
            while samples and samples[0].stamp_ns <= stamp:
                writer.imu(samples.popleft())
            while poses and poses[0].stamp_ns <= stamp:
                writer.odometry(poses.popleft())
            if stamp <= long.start_ns + FRAMES_NS:
                short.write_raw(topic, types[topic], data, stamp)
    return path


def turn_rates(start_ns: int) -> deque[ImuSample]:
    """What an IMU measures on the true trajectory."""
    with SensorBag(DEMO) as bag:
        truth = bag.ground_truth("")
    assert truth is not None
    stamps = start_ns + IMU_OFFSET_NS + np.arange(FRAMES_NS // IMU_STEP_NS) * IMU_STEP_NS
    poses = truth.interpolate(np.append(stamps, stamps[-1] + IMU_STEP_NS))
    R_imu_base = T_BASE_IMU[:3, :3].T
    rates = [R_imu_base @ so3_log(a[:3, :3].T @ b[:3, :3]) / (IMU_STEP_NS * 1e-9) for a, b in pairwise(poses)]
    return deque(ImuSample(int(t), rate, np.array([0.0, 0.0, 9.8])) for t, rate in zip(stamps, rates, strict=True))


def odometry(start_ns: int) -> deque[OdometryReading]:
    """The true way of the IMU's frame, 2 % too long, with a covariance that grows."""
    with SensorBag(DEMO) as bag:
        truth = bag.ground_truth("")
    assert truth is not None
    stamps = start_ns + np.arange(FRAMES_NS // ODOMETRY_STEP_NS) * ODOMETRY_STEP_NS
    poses = truth.interpolate(stamps) @ T_BASE_IMU
    own = np.linalg.inv(poses[0]) @ poses
    own[:, :3, 3] *= 1.02
    none = np.zeros(6), np.zeros((6, 6))
    return deque(
        OdometryReading(int(t), T, 1e-6 * (k + 1) * np.eye(6), *none, IMU_FRAME)
        for k, (t, T) in enumerate(zip(stamps, own, strict=True))
    )


def files(folder: Path) -> dict[str, bytes]:
    """The files of a map, whose arrays are named after their digest."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("mode", "odometry", "composed", "calibrated"),
    [
        ("stereo", "none", False, False),
        ("tof", "none", True, False),
        ("fuse", "ndt", False, True),
        ("fuse", "ndt", True, False),
    ],
)
def test_nodes_and_the_offline_pipeline_agree(
    domain_environment: dict[str, str], short_bag: Path, tmp_path: Path, mode: str, odometry: str, composed: bool,
    calibrated: bool,
) -> None:  # fmt: skip
    config = without_dense_model(choose(load_system_config(None), mode, "sjsam", odometry))
    folders = write_calibrations(DEMO, tmp_path / "calibration") if calibrated else ()
    names = BagNames(calibration=read_rig_calibration(folders))
    out = tmp_path / "out"
    run = run_nodes(short_bag, config, out, odometry=odometry != "none", composed=composed, names=names)
    online, _ = collect(short_bag, config, run, mapper="sjsam", odometry=odometry, names=names)
    offline, session = run_bag(short_bag, config, odometry=odometry, names=names)
    session.save(tmp_path / "offline").result()
    assert files(run.map_folder) == files(tmp_path / "offline")
    assert set(run.exit_codes.values()) == {0}, run.exit_codes
    assert sum(online.dropped.values()) == 0, online.dropped
    assert (online.frames, online.submaps) == (offline.frames, offline.submaps)
    a, b = online.agents[0], offline.agents[0]
    np.testing.assert_array_equal(a.feature_counts, b.feature_counts)
    np.testing.assert_array_equal(a.trajectory.stamps_ns, b.trajectory.stamps_ns)
    np.testing.assert_array_equal(a.trajectory.poses, b.trajectory.poses)
    np.testing.assert_array_equal(a.trajectory.covariances, b.trajectory.covariances)
    np.testing.assert_allclose(a.filtered.poses, b.filtered.poses, rtol=0, atol=ROUNDED_IN_A_QUATERNION)
    np.testing.assert_array_equal(a.filtered.covariances, b.filtered.covariances)
    np.testing.assert_array_equal(online.landmarks.positions, offline.landmarks.positions)


def test_a_rig_is_located_in_a_map_through_the_nodes_as_offline(
    domain_environment: dict[str, str], short_bag: Path, tmp_path: Path
) -> None:
    config = without_dense_model(choose(load_system_config(None), "fuse", "sjsam", "none"))
    _, grown = run_bag(short_bag, config)
    grown.save(tmp_path / "map").result()
    start = StartMap.read(config, tmp_path / "map", localize_only=True)
    assert start is not None
    before = files(tmp_path / "map")
    run = run_nodes(short_bag, config, tmp_path / "out", odometry=False, composed=True, start_map=start)
    online, _ = collect(short_bag, config, run, mapper="sjsam", odometry="none", start_map=start)
    with MapSession(config.sjsam, Mode.LOCALISE) as session:
        session.load(tmp_path / "map", len).result()
        offline, _ = run_bag(short_bag, config, session=session)
    assert files(tmp_path / "map") == files(run.map_folder) == before
    assert online.loop_closures == offline.loop_closures > 0
    told = summarise(online)["localization"][""]
    assert 0.0 < told["located_share"] < 1.0, "live, a place is known after the submap in which it was recognised"
    assert told["first_located_s"] > 0.0
    assert summarise(replace(offline, is_localized=True))["localization"][""] == {
        "located_share": 1.0, "first_located_s": 0.0,
    }  # fmt: skip
    a, b = online.agents[0].trajectory, offline.agents[0].trajectory
    common = np.isin(b.stamps_ns, a.stamps_ns)
    assert common.sum() == len(a)
    np.testing.assert_allclose(a.poses[:, :3, 3], b.poses[common, :3, 3], atol=0.02)
