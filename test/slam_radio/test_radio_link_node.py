# SPDX-License-Identifier: Apache-2.0
"""Two ``radio_link`` processes over loopback TCP: submaps and poses reach the post, also those of a silence."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("zenoh")
pytestmark = pytest.mark.ros

from node_process import free_port, node, private_probe  # noqa: E402
from ros_probe import Probe  # noqa: E402
from slam_bringup.processes.node_arguments import ros_arguments  # noqa: E402
from slam_bringup.processes.processes import find_executable  # noqa: E402
from slam_core.geometry import boxplus  # noqa: E402
from slam_core.messages import (  # noqa: E402
    SUBMAP_TOPICS,
    odometry_message,
    submap_from_messages,
    submap_messages,
    transform_from_message,
    transform_message,
)
from slam_core.messages.submap_keys import submap_keys_message  # noqa: E402
from slam_core.messages.submaps import SubmapMessages  # noqa: E402
from slam_core.ros import sensor_qos  # noqa: E402
from slam_core.types import PoseEstimate  # noqa: E402


@pytest.fixture
def nodes(tmp_path: Path) -> Iterator[tuple[dict[str, str], Probe]]:
    with private_probe(tmp_path) as found:
        yield found


@pytest.fixture
def environment(nodes: tuple[dict[str, str], Probe]) -> dict[str, str]:
    return nodes[0]


@pytest.fixture
def probe(nodes: tuple[dict[str, str], Probe]) -> Probe:
    return nodes[1]


def radio_link(environment: dict[str, str], log: Path, namespace: str = "", **parameters: Any) -> Any:
    return node(environment, "slam_radio", "radio_link", log, namespace, **parameters)


def test_submaps_poses_and_corrections_cross_the_link_and_survive_its_silence(
    environment: dict[str, str], probe: Probe, make_submap: Callable[..., Any], tmp_path: Path
) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    types = probe.types
    for topic, kind in SUBMAP_TOPICS.items():
        probe.listen(f"/anna/{topic}", getattr(types, kind), latched=True)
    probe.listen("/anna/odom", types.Odometry)
    probe.listen("/helmet/map_to_odom", types.TransformStamped, latched=True)
    senders = {
        topic: probe.node.create_publisher(getattr(types, kind), f"/helmet/{topic}", sensor_qos(100, True))
        for topic, kind in SUBMAP_TOPICS.items()
    }
    submaps = [make_submap(40, seed=k, index=k, agent="") for k in range(5)]
    T = boxplus(np.eye(4), np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.3]))

    def publish(index: int) -> None:
        for topic, message in zip(SUBMAP_TOPICS, submap_messages(types, submaps[index]), strict=True):
            senders[topic].publish(message)

    def received() -> list[Any]:
        return list(zip(*(probe.received[f"/anna/{topic}"] for topic in SUBMAP_TOPICS), strict=False))

    def wait_for(count: int) -> None:
        try:
            probe.wait(lambda: len(received()) >= count, "")
        except AssertionError:
            pytest.fail(f"{len(received())} of {count} submaps: {logs()}")

    def logs() -> str:
        return "\n".join(path.read_text(errors="replace") for path in tmp_path.glob("*.log"))

    agent = {"agents": ("anna",), "connect": (address,), "light.landmarks": 20, "resend_after_s": 1.0}
    post = {"role": "post", "agents": ("anna",), "listen": (address,)}
    state = tmp_path / "state" / "indoor_slam"
    old = state / "helmet" / "radio" / "details" / "anna" / "1-7.submap"
    old.parent.mkdir(parents=True)
    old.write_bytes(b"SD\x01 of an earlier version")
    with radio_link(environment, tmp_path / "agent.log", "helmet", **agent):
        with radio_link(environment, tmp_path / "post.log", **post):
            publish(0)
            publish(1)
            wait_for(2)
            odometry = odometry_message(types, "odom", "base_link", PoseEstimate(10**9, T, 1e-4 * np.eye(6)))
            probe.send("/helmet/odom", odometry)
            probe.wait(lambda: probe.received["/anna/odom"], "no pose at the post")
            probe.send("/anna/map_to_odom", transform_message(types, 10**9, "map", "anna/odom", T))

            def is_corrected() -> bool:
                probe.send("/helmet/odom", odometry)
                return bool(probe.received["/helmet/map_to_odom"])

            probe.wait(is_corrected, f"no correction at the agent: {logs()}")
            correction = probe.received["/helmet/map_to_odom"][-1]
            probe.send(
                "/map/undecided", submap_keys_message(types, 10**9, [("anna", 2, 1), ("bert", 2, 0)]), latched=True
            )
            wait_for(3)
            detailed = submap_from_messages(SubmapMessages(*received()[-1]))
            assert probe.call("/radio_link/request_details").message == "details of 1 submaps asked for"
            wait_for(4)
        publish(2)  # the post is away
        publish(3)
        waiting = state / "helmet" / "radio" / "outbox" / "anna"
        probe.wait(lambda: len(list(waiting.glob("*.submap"))) == 2, "nothing waits on disk")
    for received_on in probe.received.values():
        received_on.clear()
    publish(4)
    with (
        radio_link(environment, tmp_path / "post.log", **post),
        radio_link(environment, tmp_path / "agent.log", "helmet", **agent),
    ):
        wait_for(5)  # two of before once more, for a sjsam that was started anew too
        probe.wait(lambda: not list(waiting.glob("*.submap")), "what was received still waits")
        (old.parent / "whole" / "2-4.npz").unlink()
        assert probe.call("/radio_link/request_details").message == "details of 3 submaps asked for"
        wait_for(7)
        untold = next(state.glob("**/inbox/anna")) / "untold.json"
        wanted = untold.with_name("wanted.json")
        probe.wait(lambda: json.loads(wanted.read_text()) == [], "details are still wanted that there are not")
        assert json.loads(untold.read_text()) == [[2, 4, 5]]
    assert f"1 files in {old.parent} are of another version of this program, or damaged: they are kept" in logs()
    assert old.read_bytes() == b"SD\x01 of an earlier version"
    found = [submap_from_messages(SubmapMessages(*messages)) for messages in received()]
    assert [(s.index, len(s.landmarks)) for s in found[5:]] == [(2, 40), (3, 40)]
    found = found[:5]
    assert [s.index for s in found] == list(range(5))
    assert (detailed.index, len(detailed.landmarks)) == (1, 40)
    assert [len(s.landmarks) for s in found] == [40, 40, 20, 20, 20]
    for light, whole in zip(found, submaps, strict=True):
        assert light.agent == "anna"
        assert light.session == whole.session
        rows = [int(np.nonzero(whole.landmark_ids == i)[0][0]) for i in light.landmark_ids]
        np.testing.assert_allclose(light.landmarks, whole.landmarks[rows], atol=5e-3)  # a quarter of their sigma
    parent, child, found_T = transform_from_message(correction)
    assert (parent, child) == ("map", "odom")
    np.testing.assert_allclose(found_T, T, atol=1e-6)
    assert "Traceback" not in logs()


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"agents": ("anna",)}, "say where the other end is"),
        ({"agents": ("anna", "bert"), "connect": ("tcp/127.0.0.1:1",)}, "an agent has one name"),
        ({"agents": ("a/b",), "connect": ("tcp/127.0.0.1:1",)}, "must name the agents by letters"),
        ({"agents": ("anna",), "connect": ("nonsense",)}, "the radio link does not open"),
        ({"agents": ("anna",), "connect": ("tcp/127.0.0.1:1",), "user": "anna"}, "needs 'password_file'"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    environment: dict[str, str], tmp_path: Path, parameters: dict[str, Any], text: str
) -> None:
    command = [*find_executable("slam_radio", "radio_link", []), *ros_arguments(parameters)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert text in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(("module", "project"), [("zenoh", "eclipse-zenoh"), ("constriction", "constriction")])
def test_without_a_library_a_line_says_what_to_install(environment: dict[str, str], module: str, project: str) -> None:
    code = f"import sys; sys.modules['{module}'] = None; from slam_radio.radio_link_node import main; main()"
    arguments = ros_arguments({"connect": ("tcp/127.0.0.1:1",)})
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert f"pip install {project}" in done.stderr
