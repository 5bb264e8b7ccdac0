# SPDX-License-Identifier: Apache-2.0
"""What a controller sees of ``sjsam``: a consumer that takes the transforms as Nav2's costmaps and controllers do."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

pytest.importorskip("rclpy")
pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("domain")]

from node_bench import Bench, running  # noqa: E402

from slam_core.geometry import (  # noqa: E402
    FloatArray,
    invert_transform,
    make_transform,
    rotation_from_euler,
    so3_log,
    transform_from_pose7,
)
from slam_core.health import State  # noqa: E402
from slam_core.messages import odometry_message  # noqa: E402
from slam_core.types import PoseEstimate, Submap  # noqa: E402

SPEED, RATE = 4.0, 1.0
TOLERANCE_S = 0.3
"""Nav2's ``transform_tolerance``: a transform that is older than this is not driven by."""


def matrix(position: Any, rotation: Any) -> FloatArray:
    values = [position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w]
    return transform_from_pose7(np.array(values))


def stamp_ns(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


class Controller:
    """Drives by map -> odom -> base_link while that is fresh; remembers where it believed to be."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        for topic, kind in (("map_to_odom", "TransformStamped"), ("map_to_odom_pose", "PoseWithCovarianceStamped")):
            bench.listen(topic, kind)
        self.on_tf: list[Any] = []
        broadcast = bench.node.broadcast
        bench.node.broadcast = lambda message: (self.on_tf.append(message), broadcast(message))
        self._odometry = bench.publisher("odom", "Odometry")
        self.now_ns, self.T_odom_base = 0, np.eye(4)

    def drive_to(self, pose: PoseEstimate) -> None:
        self.now_ns, self.T_odom_base = pose.stamp_ns, pose.T
        self._odometry.publish(odometry_message(self._bench.types, "odom", "base_link", pose))

    def transforms(self) -> list[tuple[int, FloatArray]]:
        """All transforms heard, by rising stamp."""
        heard = {
            stamp_ns(m): matrix(m.transform.translation, m.transform.rotation)
            for m in self._bench.received["map_to_odom"]
        }
        return sorted(heard.items(), key=lambda item: item[0])

    @property
    def may_drive(self) -> bool:
        found = self.transforms()
        return bool(found) and found[-1][0] >= self.now_ns - TOLERANCE_S * 1e9


@pytest.fixture
def submaps(rng: np.random.Generator) -> list[Submap]:
    return Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.3), rng, "").submaps()


def test_a_controller_sees_no_jump_and_knows_how_much_is_held_back(submaps: list[Submap], tmp_path: Path) -> None:
    """The first submap moves the map by 5 m and a quarter turn."""
    T_odom_map = make_transform(rotation_from_euler(np.pi / 2), np.array([5.0, -3.0, 0.5]))
    poses = join(submaps)[0].trajectory("")
    bounds = (f"max_correction_speed:={SPEED}", f"max_correction_rate:={RATE}", f"map_path:={tmp_path / 'map'}")
    with running(*bounds) as bench:
        controller = Controller(bench)
        for pose in poses:
            controller.drive_to(PoseEstimate(pose.stamp_ns, T_odom_map @ pose.T, 1e-6 * np.eye(6)))
            bench.spin_until(lambda: False, 0.01)
        assert bench.spin_until(lambda: len(controller.transforms()) > 3)
        assert np.array_equal(controller.transforms()[-1][1], np.eye(4)), "nothing is joined yet"
        bench.send(submaps[:1])  # by another one the estimate would change on the way
        assert bench.spin_until(lambda: bench.counters["submaps joined"] == 1)
        assert "correction_held_back_m" in bench.node.health.values
        wanted = bench.node.placements[""].tracker.T_map_odom

        def arrived() -> bool:
            standing = PoseEstimate(controller.now_ns + 20_000_000, controller.T_odom_base, 1e-6 * np.eye(6))
            controller.drive_to(standing)
            return bool(np.abs(controller.transforms()[-1][1] - wanted).max() < 1e-12)

        assert bench.spin_until(arrived), "it comes to the estimate"
        poses_heard = bench.received["map_to_odom_pose"]
        arrived_ns = controller.transforms()[-1][0]
        assert bench.spin_until(lambda: stamp_ns(poses_heard[-1]) >= arrived_ns)
        assert bench.spin_until(lambda: bench.node.health.values["correction_held_back_m"] == "0.000", 5.0)

    rig, shares = np.append(controller.T_odom_base[:3, 3], 1.0), []
    for (stamp, before), (later, after) in pairwise(controller.transforms()):
        moved = [np.linalg.norm((after - before) @ point) / SPEED for point in (np.eye(4)[3], rig)]
        moved.append(np.linalg.norm(so3_log((invert_transform(before) @ after)[:3, :3])) / RATE)
        shares.append(max(moved) / (1e-9 * (later - stamp)))
    assert max(shares) <= 1.0 + 1e-9
    assert max(shares) > 0.99, "and it goes as fast as it may"
    by_stamp = {stamp_ns(m): m for m in controller.on_tf}
    assert all(
        by_stamp[stamp_ns(m)].transform == m.transform and by_stamp[stamp_ns(m)].child_frame_id == "odom"
        for m in bench.received["map_to_odom"]
    ), "/tf is the same"

    behind = []
    for message in bench.received["map_to_odom_pose"]:
        T = matrix(message.pose.pose.position, message.pose.pose.orientation)
        if np.array_equal(T, np.eye(4)):
            continue  # nothing was joined yet
        covariance = np.reshape(message.pose.covariance, (6, 6))
        assert np.linalg.eigvalsh(covariance)[0] > 0.0
        rest = wanted[:3, 3] - T[:3, 3]
        assert rest @ np.linalg.solve(covariance[:3, :3], rest) < 1.0, "what is held back is within one sigma"
        behind.append(np.linalg.norm(rest))
    assert behind[0] > 1.0
    assert behind[-1] < 1e-9


def test_who_is_lost_is_silent_says_so_and_drives_on_where_he_is_found(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    agent = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 1.3), rng, "a")
    join(agent.submaps())[0].save(tmp_path / "map")
    visitor = Agent(agent.world, agent.path[10:60], rng, "", stamp_ns=10**12).submaps()
    stranger = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.3), rng, "", stamp_ns=2 * 10**12).submaps()
    back = Agent(agent.world, agent.path[10:60], rng, "", stamp_ns=3 * 10**12).submaps()
    with running(f"map_path:={tmp_path / 'map'}", "localize_only:=true", "max_correction_speed:=0.1") as bench:
        controller, sent = Controller(bench), 0

        def located() -> bool:
            return bench.counters["localized"] + bench.counters["not recognised"] == sent

        def drive(submaps: list[Submap]) -> None:
            nonlocal sent
            for submap in submaps:
                controller.drive_to(PoseEstimate(submap.end_stamp_ns, submap.end_pose, 1e-4 * np.eye(6)))
                bench.spin_until(lambda: False, 0.1)
                bench.send([submap])
                sent += 1
                assert bench.spin_until(located)
            bench.spin_until(lambda: False, 0.3)

        assert not controller.may_drive, "not before the place is known"
        drive(visitor)
        assert bench.node.health.state is not State.LOST
        assert bench.counters["localized"] > 0
        assert controller.may_drive
        drive([replace(stranger[0], follows_previous=False)])
        assert bench.node.health.state is State.LOST
        assert "no map_to_odom" in bench.node.health.reason
        heard = len(bench.received["map_to_odom"])
        drive(stranger[1:2])
        assert len(bench.received["map_to_odom"]) == heard
        assert not controller.may_drive
        drive(back)
        assert bench.node.health.state is not State.LOST
        assert controller.may_drive
