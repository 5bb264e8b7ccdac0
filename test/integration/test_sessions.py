# SPDX-License-Identifier: Apache-2.0
"""Odd stamps and jumping clocks at the filter and the joiner as real processes: no submap is ever forgotten."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed")
pytestmark = pytest.mark.ros

from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped  # noqa: E402

from feature_chain import HOUR, START, STEP_NS, Chain, stamp_of  # noqa: E402
from feature_world import loop  # noqa: E402
from sjsam_node.global_map import GlobalMap  # noqa: E402
from sjsam_node.map_file.storage import is_map  # noqa: E402


@pytest.fixture
def chain(tmp_path: Path, domain: int) -> Iterator[Chain]:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    chain = Chain(context, domain, tmp_path)
    chain.connect()
    yield chain
    codes = chain.end()
    rclpy.shutdown(context=context)
    assert codes == [0, 0]


def test_odd_stamps_of_operators_and_sensors_cost_nothing_and_a_jump_begins_a_session(chain: Chain) -> None:
    poses = loop(40)
    chain.send_frames(poses[:20], START)
    chain.wait_for_odometry(START + 19 * STEP_NS)
    chain.send("clicked_point", PointStamped())
    chain.send("initialpose", PoseWithCovarianceStamped())
    chain.send_frame(poses[20], START + HOUR)
    chain.send_frame(poses[20], 0)
    chain.send_frames(poses[20:30], START + 20 * STEP_NS)
    chain.wait_for_odometry(START + 29 * STEP_NS)
    assert len(chain.received["odom"]) == 30
    chain.send_frames(poses[30:], START - HOUR)
    chain.wait_for_odometry(START - HOUR + 9 * STEP_NS)
    keys = chain.saved_keys(START - HOUR + 9 * STEP_NS)
    second = START // 10**9
    first, jumped = ([k for k in keys if k[1] == session] for session in (second, second + 1))
    assert first == [("", second, k) for k in range(len(first))]
    assert jumped == [("", second + 1, k) for k in range(len(jumped))]
    assert len(first) >= 2
    assert jumped
    assert len(first) + len(jumped) == len(keys)


def test_both_nodes_killed_and_started_again_go_on_with_the_map(chain: Chain, tmp_path: Path) -> None:
    poses, half = loop(40), 20
    chain.send_frames(poses[:half], START)
    chain.wait_for_odometry(START + (half - 1) * STEP_NS)
    assert chain.call("/ekf_slam/finish").success
    chain.wait_for_map(START + (half - 1) * STEP_NS)
    copy = tmp_path / "map.autosave"
    chain.wait(lambda: is_map(copy) and len(GlobalMap.load(copy).snapshot()) >= 2, "no autosave")
    for name in ("sjsam", "ekf_slam"):
        chain.kill(name)
    before = GlobalMap.load(copy).snapshot().keys
    chain.wait_until_dead_are_forgotten()
    for name in ("sjsam", "ekf_slam"):
        chain.start(name)
    chain.connect()
    first = START + 100 * STEP_NS
    chain.send_frames(poses[half:], first)
    chain.wait_for_odometry(first + 19 * STEP_NS)
    keys = chain.saved_keys(first + 19 * STEP_NS)
    assert keys[: len(before)] == before
    assert len(keys) > len(before)
    assert {session for _, session, _ in keys} == {START // 10**9, first // 10**9}
    poses_in_map = [m for m in chain.received["pose"] if stamp_of(m) >= first]
    assert len(poses_in_map) == len(poses) - half
    assert all(m.header.frame_id == "map" for m in poses_in_map)
    assert all(np.linalg.eigvalsh(np.reshape(m.pose.covariance, (6, 6))).min() > 0 for m in poses_in_map)


def test_what_the_services_did_not_write_they_leave(chain: Chain) -> None:
    chain.send_frames(loop(20), START)
    chain.wait_for_odometry(START + 19 * STEP_NS)
    assert chain.call("/ekf_slam/finish").success
    chain.wait_for_map(START + 19 * STEP_NS)
    chain.map_path.mkdir()
    (chain.map_path / "photo.jpg").write_bytes(b"mine")
    for service in ("save_map", "load_map"):
        answer = chain.call(f"/sjsam/{service}")
        assert not answer.success
        assert str(chain.map_path) in answer.message
    assert [p.name for p in chain.map_path.iterdir()] == ["photo.jpg"]
    chain.map_path.with_name("map.ply").mkdir()
    assert not chain.call("/sjsam/export_ply").success
    shutil.rmtree(chain.map_path)
    assert chain.call("/sjsam/save_map").success, "the map is still there"


def test_an_emptied_map_is_shown_and_never_saved_over_another(chain: Chain) -> None:
    chain.send_frames(loop(20), START)
    chain.wait_for_odometry(START + 19 * STEP_NS)
    keys = chain.saved_keys(START + 19 * STEP_NS)
    assert keys
    assert chain.call("/sjsam/reset").success
    chain.wait(
        lambda: bool(chain.received["map/path"]) and not chain.received["map/path"][-1].poses, "the old map stays"
    )
    answer = chain.call("/sjsam/save_map")
    assert not answer.success
    assert "empty" in answer.message
    assert len(GlobalMap.load(chain.map_path).snapshot()) == len(keys)
