# SPDX-License-Identifier: Apache-2.0
"""The node sends where the map lies in its building to all who listen to /tf_static, also to those who come later."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("domain")]

from node_bench import running  # noqa: E402

from slam_core.geometry import make_transform, rotation_from_euler  # noqa: E402
from slam_core.messages import transform_from_message  # noqa: E402
from slam_core.messages.tf_message import transforms_from_octets  # noqa: E402
from slam_core.ros import has_tf2_msgs, sensor_qos  # noqa: E402
from slam_core.storage.anchor_file import Anchor  # noqa: E402


def test_the_anchor_of_a_map_is_on_tf_static(tmp_path: Path) -> None:
    T = make_transform(rotation_from_euler(0.8), np.array([12.0, -3.0, 1.3]))
    Anchor(T, 0.01 * np.eye(6)).write(tmp_path / "anchor.yaml")
    with running(f"anchor_path:={tmp_path / 'anchor.yaml'}", f"map_path:={tmp_path / 'map'}") as bench:
        heard = []
        kind, is_raw = bench.types.TFMessage, not has_tf2_msgs()
        bench.neighbour.create_subscription(kind, "/tf_static", heard.append, sensor_qos(10, True), raw=is_raw)
        assert bench.spin_until(lambda: bool(heard))
        (message,) = transforms_from_octets(bench.types, heard[0]) if is_raw else heard[0].transforms
    parent, child, found = transform_from_message(message)
    assert (parent, child) == ("building", "map")
    np.testing.assert_allclose(found, T, atol=1e-9)


def test_a_damaged_anchor_is_refused_when_the_node_starts(tmp_path: Path) -> None:
    (tmp_path / "anchor.yaml").write_text("frame: building\nchild_frame: map\nposition: [0, 0, .nan]")
    with pytest.raises(ValueError, match="is no anchor of a map"), running(f"anchor_path:={tmp_path / 'anchor.yaml'}"):
        pass
