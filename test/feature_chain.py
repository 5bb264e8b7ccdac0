# SPDX-License-Identifier: Apache-2.0
"""Filters and joiner as real processes, and who sends them features of a simulated world: for tests and benchmarks."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE / "ekf_slam_node")]

from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped, TransformStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from nav_msgs.msg import Path as PathMessage  # noqa: E402

from feature_world import T_RIG_OPTICAL, loop, room  # noqa: E402
from ros_probe import Probe  # noqa: E402
from sjsam_node.global_map import GlobalMap  # noqa: E402
from slam_core.messages import (  # noqa: E402
    FEATURE_TOPICS,
    STATIC_TRANSFORMS_TOPIC,
    features_messages,
    transform_message,
)
from slam_core.ros import sensor_qos  # noqa: E402
from slam_core.types import Features  # noqa: E402

STEP_NS = 100_000_000
START = 1_700_000_000 * 10**9
HOUR = 3600 * 10**9
PATIENCE_S = 240.0


class Chain(Probe):
    """``ekf_slam`` of each agent and ``sjsam`` as processes; topics, names and frames below the agents' names."""

    def __init__(
        self, context: Any, domain: int, folder: Path, agents: tuple[str, ...] = ("",), *, joiner: bool = True,
        small_submaps: bool = True,
    ) -> None:  # fmt: skip
        super().__init__(context)
        self.small_submaps = small_submaps
        self.environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain),
            "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
        }
        self.map_path, self.agents = folder / "map", agents
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.rng = np.random.default_rng(4)
        self.world = room(self.rng)
        self.listen("/diagnostics", self.types.DiagnosticArray)
        for agent in agents:
            self.start(below(agent, "ekf_slam"))
            self.listen(below(agent, "odom"), Odometry)
            self.listen(below(agent, "pose"), PoseWithCovarianceStamped)
            self.listen(below(agent, "map/path"), PathMessage, latched=True)
            for topic, kind in FEATURE_TOPICS.items():
                self._offer(below(agent, topic), getattr(self.types, kind))
        if joiner:
            self.start("sjsam")
        for topic, kind in (("clicked_point", PointStamped), ("initialpose", PoseWithCovarianceStamped)):
            self._offer(topic, kind)
        self.mounting = self.node.create_publisher(TransformStamped, STATIC_TRANSFORMS_TOPIC, sensor_qos(10, True))

    def wait(self, condition: Callable[[], bool], why: str, seconds: float = PATIENCE_S) -> None:
        """As the probe's, for machines that have much else to do."""
        super().wait(condition, why, seconds)

    def _offer(self, topic: str, kind: Any) -> None:
        self.senders[topic] = self.node.create_publisher(kind, topic, sensor_qos(100))

    def start(self, name: str) -> None:
        """Start ``sjsam`` or ``<agent>/ekf_slam``."""
        agent, _, executable = name.rpartition("/")
        module = {"ekf_slam": "ekf_slam_node", "sjsam": "sjsam_node"}[executable]
        own = {
            "sjsam": (
                f"map_path:={self.map_path}",
                f"ply_path:={self.map_path}.ply",
                *(["autosave_period_s:=0.5"] if self.small_submaps else []),
                *([f"agents:={list(self.agents)}"] if any(self.agents) else []),
            ),
            # Frames are sent in bursts: a live filter would rightly leave out all but the newest of each.
            "ekf_slam": (
                "input.policy:=all",
                *(["submap.max_frames:=8"] if self.small_submaps else []),
                f"agent:='{agent}'",
            ),
        }[executable]
        arguments = [word for parameter in own for word in ("-p", parameter)]
        namespace = ["-r", f"__ns:=/{agent}"] if agent else []
        command = [
            sys.executable,
            "-c",
            f"from {module}.node import main; main()",
            "--ros-args",
            *namespace,
            *arguments,
        ]
        self.processes[name] = subprocess.Popen(command, env=self.environment)

    def kill(self, name: str) -> None:
        """End a node as no node wants to be ended."""
        self.processes[name].kill()
        self.processes[name].wait()

    def connect(self) -> None:
        """Wait until all nodes listen and are heard, and tell them the camera's mounting."""
        self.wait(lambda: all(s.get_subscription_count() for s in self.senders.values()), "nodes do not listen")
        self.wait(lambda: all(s.get_publisher_count() for s in self._subscriptions), "nodes do not speak")
        names = [f"/{below(agent, 'ekf_slam')}" for agent in self.agents]
        self.received["/diagnostics"].clear()
        self.wait(lambda: all(self._is_connected(name) for name in names), "filters are not connected")
        frame_id = self.features(loop(2)[0], 0).frame_id
        self.mounting.publish(transform_message(self.types, 0, "base_link", frame_id, T_RIG_OPTICAL))
        self._let_others_find_us()

    def _is_connected(self, name: str) -> bool:
        """Whether a node has lately said that all its inputs have been found, but the static transforms."""
        said = [s for m in self.received["/diagnostics"] for s in m.status if s.name == name]
        values = {v.key: v.value for v in said[-1].values} if said else {"unconnected": "features"}
        return "features" not in values["unconnected"]

    def features(self, T: np.ndarray, stamp: int) -> Features:
        """What a rig at a pose sees."""
        return self.world.features(T, stamp, self.rng)[0]

    def send_frames(self, poses: list[np.ndarray], first_ns: int, agent: str = "") -> None:
        """One frame per pose, a tenth of a second apart."""
        for k, T in enumerate(poses):
            self.send_features(self.features(T, first_ns + k * STEP_NS), agent)

    def send_frame(self, T: np.ndarray, stamp: int) -> None:
        """One frame of the only agent."""
        self.send_features(self.features(T, stamp))

    def send_features(self, features: Features, agent: str = "") -> None:
        """One frame as messages."""
        for topic, message in zip(FEATURE_TOPICS, features_messages(self.types, features), strict=True):
            self.send(below(agent, topic), message)

    def wait_for_odometry(self, stamp: int, agent: str = "") -> None:
        """Until the filter has spoken of a frame."""
        messages = self.received[below(agent, "odom")]
        self.wait(lambda: any(stamp_of(m) == stamp for m in messages), f"no odometry at {stamp}")

    def wait_for_map(self, stamp: int, agent: str = "") -> None:
        """Until the map has a pose of a stamp."""
        paths = self.received[below(agent, "map/path")]
        self.wait(lambda: any(stamp_of(p) == stamp for m in paths for p in m.poses), f"{stamp} is not in the map")

    def saved_keys(self, newest_ns: int, agent: str = "") -> list[tuple[str, int, int]]:
        """Keys of the saved submaps, once an agent's pose of a stamp is in the map."""
        for name in self.agents:
            assert self.call(f"/{below(name, 'ekf_slam')}/finish").success
        self.wait_for_map(newest_ns, agent)
        answer = self.call("/sjsam/save_map")
        assert answer.success, answer.message
        return GlobalMap.load(self.map_path).snapshot().keys

    def wait_until_dead_are_forgotten(self) -> None:
        """A killed node is matched until its lease ends, and what is sent to it meanwhile is lost."""
        alive = sum(process.poll() is None for process in self.processes.values()) > 0
        killed = [below(a, t) for a in self.agents for t in FEATURE_TOPICS if self._is_dead(below(a, "ekf_slam"))]
        topics = killed + (["clicked_point"] if self._is_dead("sjsam") else [])
        assert topics or alive
        self.wait(lambda: not any(self.senders[t].get_subscription_count() for t in topics), "the dead still listen")

    def _is_dead(self, name: str) -> bool:
        return self.processes[name].poll() is not None

    def end(self) -> list[int]:
        """Stop all nodes in order; their exit codes."""
        for process in self.processes.values():
            process.send_signal(signal.SIGINT)
        codes = [process.wait(60) for process in self.processes.values()]
        self.executor.shutdown()
        self.node.destroy_node()
        return codes


def below(agent: str, name: str) -> str:
    """A name below an agent's."""
    return f"{agent}/{name}" if agent else name


def stamp_of(message: Any) -> int:
    """Header stamp of a message, ns."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)
