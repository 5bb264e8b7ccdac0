# SPDX-License-Identifier: Apache-2.0
"""Random messages on every topic of every node as real processes: nobody dies, all is counted, the map stays.

    python benchmarks/ros/fuzz.py [MESSAGES] [--composed]       100 000 by default

Every field of a message is drawn: numbers from zero, ordinary ones, infinities, NaN and 1e297, sizes that fit their
data and that do not, stamps that go on, stand still, or are an hour off. Prints, per node, whether it is alive, how
many messages it has counted as rejected, its faults (exceptions that were caught), and the growth of its memory. With
--composed the six nodes of a rig are one process, which hears from outside what none of them publishes: the sensors,
and the submaps of another agent.
"""

from __future__ import annotations

import argparse
import array
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "test"), str(ROOT / "test" / "sjsam_node"), *map(str, (ROOT / "src").iterdir())]

import rclpy  # noqa: E402
from rosidl_parser.definition import (  # noqa: E402
    AbstractSequence,
    AbstractString,
    Array,
    BasicType,
    NamespacedType,
)
from submap_world import Agent, circle, ring_world  # noqa: E402

from ros_probe import Probe  # noqa: E402
from sjsam_node.global_map import GlobalMap  # noqa: E402
from slam_core.messages import DEPTH_TOPICS, FEATURE_TOPICS, SUBMAP_TOPICS, submap_messages  # noqa: E402
from slam_core.ros import sensor_qos  # noqa: E402

NODES = {
    "stereo_driver": "stereo_frontend.driver_node",
    "tof_driver": "tof_driver.node",
    "feature_extractor": "stereo_frontend.node",
    "ndt_odometry": "ndt_registration.node",
    "ekf_slam": "ekf_slam_node.node",
    "sjsam": "sjsam_node.node",
    "dense_mapper": "dense_mapping.node",
    "viewer": "slam_viewer.viewer_node",
}
OF_A_RIG = {
    "stereo_driver": "stereo_frontend",
    "tof_driver": "tof_driver",
    "feature_extractor": "stereo_frontend",
    "ndt_odometry": "ndt_registration",
    "ekf_slam": "ekf_slam_node",
    "sjsam": "sjsam_node",
}
"""Packages of the nodes that can share a process."""

COMPOSED = "slam_bringup.processes.composed_node"
TOPICS = {
    **{f"stereo/{s}/image_raw": "Image" for s in ("left", "right")},
    **{f"stereo/{s}/image_rect": "Image" for s in ("left", "right")},
    **{f"stereo/{s}/camera_info": "CameraInfo" for s in ("left", "right")},
    "tof/range/image_raw": "Image", "tof/amplitude/image_raw": "Image", "tof/intensity/image_raw": "Image",
    **DEPTH_TOPICS, **FEATURE_TOPICS, **SUBMAP_TOPICS, "tof/points": "PointCloud2", "ndt/motion":
    "PoseWithCovarianceStamped", "imu": "Imu", "odom": "Odometry", "clicked_point": "PointStamped", "initialpose":
    "PoseWithCovarianceStamped", "static_transforms": "TransformStamped", "map/path": "Path", "map/landmarks":
    "PointCloud2", "map/dense_cloud": "PointCloud2", "map/occupancy": "OccupancyGrid", "map/graph": "MarkerArray",
    "map/marks": "MarkerArray", "map_to_odom": "TransformStamped", "pose": "PoseWithCovarianceStamped",
    "features/image": "Image", "tof/color/image": "Image",
}  # fmt: skip
HEARD = ("stereo/left/image_raw", "stereo/left/image_rect", "tof/range/image_raw", "tof/depth/image", "tof/points",
         "features", "submap/info", "odom")  # fmt: skip
"""One topic or two of each node."""

OTHER_AGENT = "b"
HEARD_COMPOSED = ("stereo/left/image_raw", "tof/range/image_raw", f"{OTHER_AGENT}/submap/info", "odom")

START = 1_700_000_000 * 10**9
NUMBERS = (0.0, 1.0, -1.0, 0.5, 30.0, 1e-12, 1e12, 1e297, -1e297, np.inf, -np.inf, np.nan)
NAMES = ("", "map", "odom", "base_link", "stereo_left_optical_frame", "base_link@5", "mono8", "rgb8", "32FC1", "16UC1",
         "64FC1", "plumb_bob", "equidistant", "x", "y", "z", "agent", "index", "true", "ü")  # fmt: skip
BYTES = {"mono8": 1, "rgb8": 3, "32FC1": 4, "16UC1": 2, "64FC1": 8}


@dataclass
class Fuzzer:
    """Draws messages; ``clock_ns`` is the time that goes on."""

    rng: np.random.Generator
    clock_ns: int = START

    def draw(self, kind: type) -> Any:
        """A message of a class with every field drawn."""
        message = kind()
        names = kind.get_fields_and_field_types()
        for name, slot in zip(names, kind.SLOT_TYPES, strict=True):
            setattr(message, name, self._value(slot, getattr(message, name)))
        return message

    def message(self, kind: type) -> Any:
        """A message with a stamp that mostly goes on and, for images, often with a size that fits."""
        message = self.draw(kind)
        if kind.__name__ == "Image" and self.rng.random() < 0.6:
            self._fit(message)
        stamp = self._stamp()
        if not hasattr(message, "header"):
            return message
        message.header.stamp.sec, message.header.stamp.nanosec = stamp // 10**9, stamp % 10**9
        return message

    def _stamp(self) -> int:
        self.clock_ns += 1_000_000
        pick = self.rng.random()
        if pick < 0.9:
            return self.clock_ns
        return int(self.rng.choice([0, self.clock_ns - 2 * 10**9, self.clock_ns + 3600 * 10**9, 2**31 * 10**9 - 1]))

    def _fit(self, image: Any) -> None:
        image.encoding = str(self.rng.choice(list(BYTES)))
        image.height, image.width = int(self.rng.integers(0, 9)), int(self.rng.integers(0, 9))
        image.step = image.width * BYTES[image.encoding]
        image.is_bigendian = 0
        image.data = self._octets(image.step * image.height)

    def _octets(self, count: int) -> Any:
        out = array.array("B")
        out.frombytes(self.rng.bytes(count))
        return out

    def _value(self, slot: Any, default: Any) -> Any:
        if isinstance(slot, NamespacedType):
            return self.draw(type(default))
        if isinstance(slot, AbstractString):
            return str(self.rng.choice(NAMES))
        if isinstance(slot, BasicType):
            return self._basic(slot.typename, default)
        count = slot.size if isinstance(slot, Array) else int(self.rng.integers(0, 6))
        return self._sequence(slot, default, count)

    def _sequence(self, slot: Any, default: Any, count: int) -> Any:
        assert isinstance(slot, (Array, AbstractSequence))
        kind = slot.value_type
        if isinstance(kind, BasicType) and kind.typename == "uint8":
            return self._octets(count)
        if isinstance(kind, NamespacedType):
            module = __import__(f"{'.'.join(kind.namespaces)}", fromlist=[kind.name])
            return [self.draw(getattr(module, kind.name)) for _ in range(count)]
        if isinstance(kind, BasicType):
            values = [self._basic(kind.typename, 0) for _ in range(count)]
            return np.array(values, default.dtype) if isinstance(default, np.ndarray) else values
        return [str(self.rng.choice(NAMES)) for _ in range(count)]

    def _basic(self, name: str, default: Any) -> Any:
        if name in ("float", "double"):
            value = float(self.rng.choice(NUMBERS)) if self.rng.random() < 0.5 else float(self.rng.normal())
            return value if name == "double" or not np.isfinite(value) else float(np.clip(value, -3e38, 3e38))
        if name == "boolean":
            return bool(self.rng.random() < 0.5)
        if name in ("octet", "char"):
            return bytes([int(self.rng.integers(0, 4))]) if isinstance(default, bytes) else int(self.rng.integers(0, 4))
        bits = int(name.removeprefix("u").removeprefix("int"))
        low, high = (0, 2**bits - 1) if name.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        return (
            int(self.rng.choice([0, 1, 7, 20000])) % (high + 1)
            if self.rng.random() < 0.8
            else (low, high)[int(self.rng.random() < 0.5)]
        )


@dataclass
class Outcome:
    """What became of one node."""

    alive: bool
    rejected: int
    faults: int
    grown_mib: float


def commands(folder: Path, composed: bool) -> dict[str, tuple[str, list[str]]]:
    """Module and arguments of each process."""
    own = {
        "sjsam": ["-p", f"map_path:={folder / 'map'}"],
        "feature_extractor": ["-p", "mode:=fuse"],
        "viewer": ["-p", "port:=0"],
        "dense_mapper": ["-p", f"output_path:={folder / 'dense'}"],
    }
    separate = {name: (module, ["--ros-args", *own.get(name, [])]) for name, module in NODES.items()}
    if not composed:
        return separate
    separate["sjsam"][1].extend(["-p", f"agents:=[{OTHER_AGENT}]"])
    nodes = [(package, name, separate[name][1], "") for name, package in OF_A_RIG.items()]
    (folder / "nodes.json").write_text(json.dumps(nodes))
    rest = {name: command for name, command in separate.items() if name not in OF_A_RIG}
    return {"slam_composed": (COMPOSED, ["--nodes", str(folder / "nodes.json")]), **rest}


def run(count: int, domain: int, folder: Path, *, composed: bool = False) -> tuple[dict[str, Outcome], bool]:
    """Fuzz all nodes; what became of each, and whether the map is the same as before."""
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    started = commands(folder, composed)
    logs = {name: (folder / f"{name}.log").open("w") for name in started}
    processes = {
        name: subprocess.Popen(
            [sys.executable, "-c", f"from {module} import main; main()", *arguments],
            env=environment,
            stdout=logs[name],
            stderr=subprocess.STDOUT,
        )
        for name, (module, arguments) in started.items()
    }
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    probe = Probe(context)
    try:
        topics = {
            f"{OTHER_AGENT}/{topic}" if composed and topic in SUBMAP_TOPICS else topic: kind
            for topic, kind in TOPICS.items()
        }
        _offer(probe, topics, HEARD_COMPOSED if composed else HEARD)
        before, records = _map_before(probe, folder, OTHER_AGENT if composed else "")
        start = {name: _rss_mib(process) for name, process in processes.items()}
        _send(probe, topics, count)
        after = _saved(probe, folder)
        counts = _counts(probe)
        inside = {"slam_composed": tuple(OF_A_RIG)}
        outcome = {
            name: Outcome(
                process.poll() is None,
                *(
                    sum(counts.get(f"/{node}", {}).get(what, 0) for node in inside.get(name, (name,)))
                    for what in ("rejected", "faults")
                ),
                _rss_mib(process) - start[name],
            )
            for name, process in processes.items()
        }
        same = len(after.snapshot()) == records and np.array_equal(after.state.poses, before.state.poses)
        return outcome, same
    finally:
        for process in processes.values():
            process.kill()
            process.wait()
        for log in logs.values():
            log.close()
        probe.executor.shutdown()
        probe.node.destroy_node()
        rclpy.shutdown(context=context)


def _offer(probe: Probe, topics: dict[str, str], heard: Sequence[str]) -> None:
    """Publishers of all topics, once the nodes listen."""
    probe.listen("/diagnostics", probe.types.DiagnosticArray)
    for topic, kind in topics.items():
        latched = topic in ("static_transforms", "map_to_odom") or "submap/" in topic or topic.startswith("map/")
        probe.senders[topic] = probe.node.create_publisher(getattr(probe.types, kind), topic, sensor_qos(100, latched))
    probe.wait(lambda: all(probe.senders[t].get_subscription_count() for t in heard), "nodes do not listen", 300.0)


def _map_before(probe: Probe, folder: Path, agent: str) -> tuple[GlobalMap, int]:
    """A small map that must not change."""
    rng = np.random.default_rng(1)
    submaps = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.4), rng, agent).submaps()
    for submap in submaps:
        for topic, message in zip(SUBMAP_TOPICS, submap_messages(probe.types, submap), strict=True):
            probe.send(f"{agent}/{topic}" if agent else topic, message)
    probe.wait(
        lambda: _counts(probe).get("/sjsam", {}).get("submaps joined", 0) == len(submaps),
        "submaps are not joined",
        300.0,
    )
    _saved(probe, folder)
    return _saved(probe, folder), len(submaps)


def _send(probe: Probe, topics: dict[str, str], count: int) -> None:
    fuzzer = Fuzzer(np.random.default_rng(2))
    names = list(topics)
    for k in range(count):
        topic = names[k % len(names)]
        probe.senders[topic].publish(fuzzer.message(getattr(probe.types, topics[topic])))
        if k % 50 == 0:
            probe.executor.spin_once(timeout_sec=0.01)
    _settle(probe)


def _settle(probe: Probe) -> None:
    """Until no node's counters change any more."""
    last: Any = None
    end = time.monotonic() + 120.0
    while time.monotonic() < end:
        until = time.monotonic() + 3.0
        while time.monotonic() < until:
            probe.executor.spin_once(timeout_sec=0.05)
        if (now := _counts(probe)) == last:
            return
        last = now


def _saved(probe: Probe, folder: Path) -> GlobalMap:
    from std_srvs.srv import Trigger

    client = probe.node.create_client(Trigger, "/sjsam/save_map")
    probe.wait(client.service_is_ready, "no save_map")
    future = client.call_async(Trigger.Request())
    probe.wait(future.done, "save_map does not answer", 120.0)
    assert future.result().success, future.result().message
    return GlobalMap.load(folder / "map")


def _counts(probe: Probe) -> dict[str, dict[str, int]]:
    """The newest counters of every node."""
    out: dict[str, dict[str, int]] = {}
    for message in probe.received["/diagnostics"]:
        for status in message.status:
            out[status.name] = {v.key: int(v.value) for v in status.values if v.value.lstrip("-").isdigit()}
    return out


def _rss_mib(process: subprocess.Popen[bytes]) -> float:
    try:
        pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int, nargs="?", default=100_000)
    parser.add_argument("--composed", action="store_true")
    given = parser.parse_args()
    count = given.count
    with tempfile.TemporaryDirectory() as folder:
        outcome, same = run(count, 1 + os.getpid() % 100, Path(folder), composed=given.composed)
    print(f"{count} messages on {len(TOPICS)} topics")
    print(f"{'node':20} {'alive':6} {'rejected':>9} {'faults':>7} {'grown MiB':>10}")
    for name, o in outcome.items():
        print(f"{name:20} {'yes' if o.alive else 'NO':6} {o.rejected:9} {o.faults:7} {o.grown_mib:10.1f}")
    print(f"map as before: {'yes' if same else 'NO'}")


if __name__ == "__main__":
    main()
