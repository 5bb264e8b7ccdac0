# SPDX-License-Identifier: Apache-2.0
"""Faults at filters and joiner as real processes: who survives, what is lost, and how soon it goes on.

    python benchmarks/ros/faults.py [NAME ...]

Each fault strikes in the middle of a drive of 60 frames at 10 Hz (feature level, so that only the nodes are tried).
survived: the nodes that were not killed still run, and every submap joined before the fault is in the map after it.
lost: frames without odometry. recovered: frames after the fault until odometry came again. sessions: of the agent that
was struck. Runs in a ROS domain of its own on this machine.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "test"), *map(str, (ROOT / "src").iterdir())]

import rclpy  # noqa: E402
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402

from feature_chain import HOUR, START, STEP_NS, Chain, below, stamp_of  # noqa: E402
from feature_world import loop  # noqa: E402
from slam_core.messages import FEATURE_TOPICS, features_messages, header_message  # noqa: E402

FRAMES, STRUCK, LASTS = 60, 30, 10


@dataclass
class Drive:
    """One drive: frames are sent with what ``stamp`` makes of their stamps."""

    chain: Chain
    poses: list[np.ndarray]
    agent: str = ""

    def send(self, first: int, last: int, shift_ns: int = 0, only: str = "") -> None:
        """Frames with their stamps shifted, those of one topic only where it is named."""
        for k in range(first, last):
            features = self.chain.features(self.poses[k], START + k * STEP_NS)
            messages = features_messages(self.chain.types, features)
            for topic, message in zip(FEATURE_TOPICS, messages, strict=True):
                if only in ("", topic):
                    message.header = header_message(
                        self.chain.types, START + k * STEP_NS + shift_ns, message.header.frame_id
                    )
                self.chain.send(below(self.agent, topic), message)
            self.chain.executor.spin_once(timeout_sec=0.02)

    def send_rest(self, first: int = STRUCK, shift_ns: int = 0) -> int:
        """The frames after a fault; the stamp of the last."""
        self.send(first, FRAMES, shift_ns)
        return START + (FRAMES - 1) * STEP_NS + shift_ns


def dark(drive: Drive) -> int:
    """Three seconds without a feature."""
    chain = drive.chain
    for k in range(STRUCK, STRUCK + 30):
        empty = chain.features(drive.poses[k], START + k * STEP_NS).select(np.zeros(0, dtype=np.int64))
        chain.send_features(empty, drive.agent)
    return drive.send_rest(STRUCK, 30 * STEP_NS)


def unplugged(drive: Drive) -> int:
    """Twenty seconds without a message."""
    return drive.send_rest(STRUCK, 200 * STEP_NS)


def step(shift_s: float) -> Callable[[Drive], int]:
    """All stamps step and stay there."""
    return lambda drive: drive.send_rest(STRUCK, round(shift_s * 1e9))


def odd_frame(shift_s: float) -> Callable[[Drive], int]:
    """One frame with another stamp."""

    def strike(drive: Drive) -> int:
        drive.send(STRUCK, STRUCK + 1, round(shift_s * 1e9))
        return drive.send_rest(STRUCK + 1)

    return strike


def one_topic(topic: str, shift_s: float) -> Callable[[Drive], int]:
    """The stamps of one topic step and come back a second later."""

    def strike(drive: Drive) -> int:
        drive.send(STRUCK, STRUCK + LASTS, round(shift_s * 1e9), topic)
        return drive.send_rest(STRUCK + LASTS)

    return strike


def operator(message: object, topic: str) -> Callable[[Drive], int]:
    """A message of an operator without a stamp."""

    def strike(drive: Drive) -> int:
        drive.chain.send(topic, message)
        return drive.send_rest()

    return strike


def imu_steps(drive: Drive) -> int:
    """An IMU's clock steps an hour back."""
    for k in range(40):
        stamp = START + STRUCK * STEP_NS + k * STEP_NS // 10 - (HOUR if k >= 20 else 0)
        header = header_message(drive.chain.types, stamp, "base_link")
        drive.chain.send(below(drive.agent, "imu"), Imu(header=header))
    return drive.send_rest()


def killed(*names: str) -> Callable[[Drive], int]:
    """Nodes are killed with -9 and started again."""

    def strike(drive: Drive) -> int:
        for name in names:
            drive.chain.kill(name)
        drive.chain.wait_until_dead_are_forgotten()
        for name in names:
            drive.chain.start(name)
        drive.chain.connect()
        return drive.send_rest(STRUCK, 300 * STEP_NS)

    return strike


CLICK, GUESS = PointStamped(), PoseWithCovarianceStamped()
FAULTS: dict[str, Callable[[Drive], int]] = {
    "none": step(0.0),
    "3 s of darkness": dark,
    "20 s unplugged": unplugged,
    **{f"clock steps by {s:+g} s": step(s) for s in (2.0, -2.0, 3600.0, -3600.0)},
    **{f"one frame {s:+g} s off": odd_frame(s) for s in (2.0, -2.0, 3600.0, -3600.0)},
    **{f"{t} alone {s:+g} s for 1 s": one_topic(t, s) for t in FEATURE_TOPICS for s in (2.0, -2.0, 3600.0, -3600.0)},
    "imu steps by -3600 s": imu_steps,
    "clicked_point with stamp 0": operator(CLICK, "clicked_point"),
    "initialpose with stamp 0": operator(GUESS, "initialpose"),
    "ekf_slam killed": killed("ekf_slam"),
    "sjsam killed": killed("sjsam"),
    "both killed": killed("ekf_slam", "sjsam"),
    "two agents, b's clock -3600 s": step(-3600.0),
    "two agents, b killed": killed("b/ekf_slam"),
}


def run(name: str, domain: int, folder: Path) -> str:
    """One line of the table."""
    agents = ("a", "b") if name.startswith("two") else ("",)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    chain = Chain(context, domain, folder, agents)
    try:
        chain.connect()
        drive = Drive(chain, loop(FRAMES), agents[-1])
        for agent in agents:
            chain.send_frames(drive.poses[:STRUCK], START, agent)
            chain.wait_for_odometry(START + (STRUCK - 1) * STEP_NS, agent)
        assert chain.call(f"/{below(drive.agent, 'ekf_slam')}/finish").success
        for agent in agents:
            if agent != drive.agent:
                assert chain.call(f"/{below(agent, 'ekf_slam')}/finish").success
            chain.wait_for_map(START + (STRUCK - 1) * STEP_NS, agent)
        answer = chain.call("/sjsam/save_map")
        before = set(keys(chain, answer))
        topic = below(drive.agent, "odom")
        count = len(chain.received[topic])
        last = FAULTS[name](drive)
        chain.wait_for_odometry(last, drive.agent)
        after = set(chain.saved_keys(last, drive.agent))
        alive = all(process.poll() is None for process in chain.processes.values())
        stamps = [stamp_of(m) for m in chain.received[topic][count:]]
        resumed = (FRAMES - STRUCK) - len([s for s in stamps if s <= last])
        sessions = len({key[1] for key in after if key[0] == drive.agent})
        survived = alive and before <= after
        wait_s = (min(stamps, default=last) - min(last - (FRAMES - STRUCK - 1) * STEP_NS, last)) / STEP_NS
        verdict = "yes" if survived else "NO"
        counts = f"{sessions:8} {len(before):6} {len(after):5}"
        return f"{name:36} {verdict:9} {max(resumed, 0):4} {max(wait_s, 0):9.0f} {counts}"
    finally:
        chain.end()
        rclpy.shutdown(context=context)


def keys(chain: Chain, answer: object) -> list[tuple[str, int, int]]:
    from sjsam_node.global_map import GlobalMap

    assert answer.success, answer.message  # type: ignore[attr-defined]
    return GlobalMap.load(chain.map_path).snapshot().keys


def main() -> None:
    wanted = sys.argv[1:] or list(FAULTS)
    print(f"{'fault':36} {'survived':9} {'lost':>4} {'recovered':>9} {'sessions':>8} {'before':>6} {'after':>5}")
    for i, name in enumerate(wanted):
        with tempfile.TemporaryDirectory() as folder:
            try:
                line = run(name, 1 + (os.getpid() + i) % 100, Path(folder))
            except AssertionError as error:
                line = f"{name:36} NO        {error}"
        print(line, flush=True)


if __name__ == "__main__":
    main()
