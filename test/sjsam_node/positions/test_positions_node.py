# SPDX-License-Identifier: Apache-2.0
"""The node joins positions with submaps, counts those that it refuses, and sends where the building is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("domain")]

from node_bench import running  # noqa: E402
from positioned_world import ARM, T_BUILDING_WORLD, drive, positions  # noqa: E402

from sjsam_node.positions.position_links import REFUSED, USED  # noqa: E402
from sjsam_node.positions.position_queue import UNUSABLE  # noqa: E402
from slam_core.geometry import boxminus  # noqa: E402
from slam_core.messages import position_message, transform_from_message  # noqa: E402
from slam_core.messages.tf_message import transforms_from_octets  # noqa: E402
from slam_core.ros import has_tf2_msgs, sensor_qos  # noqa: E402
from slam_core.types import PositionReading  # noqa: E402


def test_positions_tell_where_the_building_is(tmp_path: Path) -> None:
    agent = drive(1)
    agent.name = "anna"
    submaps, (readings, bad) = agent.submaps(), positions(agent, 3, outliers=0.1)
    arm = f"position.lever_arm:={ARM.tolist()}"
    given = "agents:=[anna]", "position.interval:=0.1", arm, f"map_path:={tmp_path / 'map'}", "autosave_period_s:=0.0"
    with running(*given) as bench:
        heard: list[object] = []
        kind, is_raw = bench.types.TFMessage, not has_tf2_msgs()
        bench.neighbour.create_subscription(kind, "/tf_static", heard.append, sensor_qos(10, True), raw=is_raw)
        publisher = bench.publisher("anna/position", "PoseWithCovarianceStamped")
        nothing = PositionReading(readings[0].stamp_ns - 1, readings[0].position, np.zeros((3, 3)))
        for reading in (nothing, *readings):
            publisher.publish(position_message(bench.types, "uwb", reading))
        assert bench.spin_until(lambda: len(bench.node.map._positions._streams["anna"].waiting) == len(readings))
        bench.send(submaps)
        assert bench.spin_until(lambda: bench.counters["submaps joined"] == len(submaps), 60.0)
        counts = bench.node.map.counts
        assert counts[UNUSABLE] == 1
        assert bad <= counts[REFUSED] <= bad + 3
        assert counts[USED] + counts[REFUSED] == len(readings)
        before = len(heard)
        assert bench.spin_until(lambda: len(heard) > before)
    (message,) = transforms_from_octets(bench.types, heard[-1]) if is_raw else heard[-1].transforms  # type: ignore[arg-type,attr-defined]
    parent, child, found = transform_from_message(message)
    assert (parent, child) == ("building", "map")
    error = boxminus(found, T_BUILDING_WORLD @ agent.path[0])
    assert np.linalg.norm(error[:3]) < 0.5
    assert np.linalg.norm(error[3:]) < 0.05
