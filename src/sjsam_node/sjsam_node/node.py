"""The ``sjsam`` node: submaps of one or several agents in, one map and every agent's place in it out."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType  # type: ignore[attr-defined]
from std_srvs.srv import Trigger

from sjsam_node.global_map import GlobalMap, GlobalMapConfig, JoinReport
from sjsam_node.localization import Localizer
from sjsam_node.map_messages import (
    cloud_message,
    ellipsoids_message,
    graph_message,
    landmarks_message,
    marks_message,
)  # fmt: skip
from slam_core.base_node import SlamNode
from slam_core.config import parameter
from slam_core.geometry import FloatArray, invert_transform
from slam_core.health import State
from slam_core.messages import (
    SUBMAP_TOPICS,
    estimate_from_message,
    header_message,
    path_message,
    pose_from_message,
    pose_with_covariance_message,
    stamp_ns,
    submap_from_messages,
    transform_message,
)
from slam_core.messages.base import Message
from slam_core.messages.submaps import SubmapMessages
from slam_core.point_cloud import write_ply
from slam_core.ros import run_node
from slam_core.stamp_guard import StampPolicy
from slam_core.types import PoseEstimate, Submap

_ODOMETRY_KEPT = 20000
_MAP_PERIOD_S = 1.0


@dataclass(frozen=True)
class SjsamNodeConfig(GlobalMapConfig):
    """The map's parameters and the node's own."""

    agents: tuple[str, ...] = parameter(("",), "namespaces of the agents whose submaps are joined")
    map_frame: str = parameter("map", "frame of the map")
    odom_frame: str = parameter("odom", "frame of each agent's odometry, below its namespace")
    map_path: str = parameter("map", "folder that save_map writes and load_map reads")
    ply_path: str = parameter("map_landmarks.ply", "file that export_ply writes")
    localize_only: bool = parameter(False, "locate the agents in the loaded map without changing it")


class SjsamNode(SlamNode[SjsamNodeConfig]):
    """Publishes ``pose`` and ``map_to_odom`` of each agent after each of its submaps, and the map, which costs the more
    the larger it is, once a second at most. Neither changes the map.
    """

    def __init__(self) -> None:
        super().__init__("sjsam", SjsamNodeConfig)
        self.global_map = GlobalMap(self.config)
        self.localizers: dict[str, Localizer] = {}
        self.odometry: dict[str, dict[int, FloatArray]] = {agent: {} for agent in self.config.agents}
        self._stamp_ns = 0
        self._map_is_news = False
        self._advertise_outputs()
        for agent in self.config.agents:
            self._listen_to(agent)
        unordered = {"required": False, "stamps": StampPolicy.ANY}
        self.listen("clicked_point", "PointStamped", self.on_clicked_point, **unordered)
        self.listen("initialpose", "PoseWithCovarianceStamped", self.on_initial_pose, **unordered)
        self._serve("save_map", self.save_map)
        self._serve("load_map", self.load_map)
        self._serve("export_ply", self.export_ply)
        self._serve("mark_here", self.mark_here)
        self.create_timer(_MAP_PERIOD_S, self._publish_news, clock=Clock(clock_type=ClockType.STEADY_TIME))
        if self.config.localize_only:
            self.get_logger().info(self.load_map())

    def _advertise_outputs(self) -> None:
        for name in ("map/landmarks", "map/cloud"):
            self.advertise(name, "PointCloud2", latched=True, depth=1)
        for name in ("map/ellipsoids", "map/graph", "map/marks"):
            self.advertise(name, "MarkerArray", latched=True, depth=1)
        for agent in self.config.agents:
            self.advertise(_below(agent, "map/path"), "Path", latched=True, depth=1)
            self.advertise(_below(agent, "pose"), "PoseWithCovarianceStamped")
            self.advertise(_below(agent, "map_to_odom"), "TransformStamped", latched=True, depth=1)

    def _listen_to(self, agent: str) -> None:
        topics = {_below(agent, topic): kind for topic, kind in SUBMAP_TOPICS.items()}
        on_odometry = partial(self.on_odometry, agent)
        self.listen_together(topics, partial(self.on_submap, agent), latched=True, stamps=StampPolicy.ANY)
        self.listen(_below(agent, "odom"), "Odometry", on_odometry, required=False, stamps=StampPolicy.ANY)

    def _serve(self, name: str, action: Callable[[], str]) -> None:
        def answer(_: Any, response: Any) -> Any:
            try:
                response.success, response.message = True, action()
            except (ValueError, OSError) as error:
                response.success, response.message = False, str(error)
            self.get_logger().info(f"{name}: {response.message}")
            return response

        self.create_service(Trigger, f"~/{name}", answer)

    # -- inputs --------------------------------------------------------------------------------------------------------

    def on_submap(self, agent: str, *messages: Message) -> None:
        """One finished submap."""
        submap = submap_from_messages(SubmapMessages(*messages))
        self._stamp_ns = max(self._stamp_ns, submap.end_stamp_ns)
        if self.config.localize_only:
            self._localize(agent, submap)
            return
        report = self.global_map.add(submap)
        if not report.accepted:
            raise ValueError(f"submap {submap.frame_id}: {report.reason}")
        self._count(report)
        pose = self.global_map.end_pose(submap.agent)
        if pose is not None:
            self._publish_pose(agent, pose, submap)
        self._map_is_news = True

    def on_odometry(self, agent: str, message: Message) -> None:
        """Remember the odometry: a submap's end is one of its stamps."""
        kept = self.odometry[agent]
        kept[stamp_ns(message)] = pose_from_message(message.pose.pose)
        if len(kept) > _ODOMETRY_KEPT:
            del kept[next(iter(kept))]

    def on_clicked_point(self, message: Message) -> None:
        """Mark a find at a point of the map frame."""
        if message.header.frame_id not in ("", self.config.map_frame):
            raise ValueError(f"clicked_point must be in frame {self.config.map_frame}, got {message.header.frame_id}")
        self.global_map.marks.add(self.global_map.graph, np.array([message.point.x, message.point.y, message.point.z]))
        self._publish_marks()

    def on_initial_pose(self, message: Message) -> None:
        """Where the agents are believed to be in the loaded map."""
        estimate = estimate_from_message(message)
        for agent in self.config.agents:
            self._localizer(agent).set_pose(estimate)

    def on_reset(self) -> None:
        """Forget the map; in a loaded map only where the agents are."""
        self.localizers.clear()
        for kept in self.odometry.values():
            kept.clear()
        if not self.config.localize_only:
            self.global_map.reset()
            self._publish_map()

    def _localizer(self, agent: str) -> Localizer:
        return self.localizers.setdefault(agent, Localizer(self.global_map))

    def _localize(self, agent: str, submap: Submap) -> None:
        found = self._localizer(agent).process(submap)
        self.health.count("localized" if found.matched else "not recognised")
        if found.pose is None:
            self.health.set(State.LOST, "the place is not recognised in the map")
            return
        self.health.set(State.OK if found.matched else State.DEGRADED, "" if found.matched else "by odometry alone")
        self._publish_pose(agent, found.pose, submap)

    def _count(self, report: JoinReport) -> None:
        self.health.count("submaps")
        self.health.count("closures", len(report.closures))
        self.health.counters["components"] = report.components
        for name, count in self.global_map.counters.counts.items():
            self.health.counters[name] = count
        linked = report.components == 1
        self.health.set(State.OK if linked else State.DEGRADED, "" if linked else f"{report.components} separate parts")

    # -- services ------------------------------------------------------------------------------------------------------

    def save_map(self) -> str:
        """Write the map to ``map_path``; an empty one never over another."""
        if not self.global_map.graph.records and Path(self.config.map_path).exists():
            raise ValueError(f"the map is empty: {self.config.map_path} is left as it is")
        self.global_map.save(self.config.map_path)
        self._publish_map()
        return f"{len(self.global_map.graph.records)} submaps written to {self.config.map_path}"

    def load_map(self) -> str:
        """Replace the map by the one in ``map_path``."""
        self.global_map = GlobalMap.load(self.config.map_path, self.config)
        self.localizers.clear()
        self._publish_map()
        return f"{len(self.global_map.graph.records)} submaps read from {self.config.map_path}"

    def export_ply(self) -> str:
        """Write the landmarks to ``ply_path``."""
        positions = self.global_map.landmarks().positions
        write_ply(Path(self.config.ply_path), positions.astype(np.float32))
        return f"{len(positions)} landmarks written to {self.config.ply_path}"

    def mark_here(self) -> str:
        """Mark where the agent that was heard last is."""
        records = self.global_map.graph.records
        if not records:
            raise ValueError("nothing can be marked in an empty map")
        mark = self.global_map.marks.add(self.global_map.graph, self.global_map.graph.poses[records[-1].end][:3, 3])
        self._publish_marks()
        return mark.name

    # -- outputs -------------------------------------------------------------------------------------------------------

    def _publish_news(self) -> None:
        if self._map_is_news:
            self._publish_map()

    def _publish_map(self) -> None:
        self._map_is_news = False
        header, landmarks = (
            header_message(self.types, self._stamp_ns, self.config.map_frame),
            self.global_map.landmarks(),
        )
        self.publish("map/landmarks", landmarks_message(self.types, header, landmarks))
        self.publish("map/cloud", cloud_message(self.types, header, landmarks))
        if self.has_listeners("map/ellipsoids"):
            self.publish("map/ellipsoids", ellipsoids_message(self.types, header, landmarks))
        self.publish("map/graph", graph_message(self.types, header, self.global_map))
        self._publish_marks()
        paths = self.global_map.path()
        for agent in self.config.agents:
            path = path_message(self.types, self._stamp_ns, self.config.map_frame, paths.get(agent, []))
            self.publish(_below(agent, "map/path"), path)

    def _publish_marks(self) -> None:
        header = header_message(self.types, self._stamp_ns, self.config.map_frame)
        self.publish(
            "map/marks", marks_message(self.types, header, self.global_map.marks.positions(self.global_map.graph))
        )

    def _publish_pose(self, agent: str, pose: PoseEstimate, submap: Submap) -> None:
        self.publish(_below(agent, "pose"), pose_with_covariance_message(self.types, self.config.map_frame, pose))
        T_odom_rig = self.odometry[agent].get(submap.end_stamp_ns)
        if T_odom_rig is None:
            T_odom_rig = self.global_map.odometry_pose(submap.agent)
        T_map_odom = pose.T @ invert_transform(T_odom_rig)
        odom = _below(agent, self.config.odom_frame)
        message = transform_message(self.types, pose.stamp_ns, self.config.map_frame, odom, T_map_odom)
        self.publish(_below(agent, "map_to_odom"), message)
        self.broadcast(message)


def _below(agent: str, name: str) -> str:
    """A topic or frame below an agent's namespace."""
    return f"{agent}/{name}" if agent else name


def main() -> None:
    """Entry point of ``ros2 run sjsam_node sjsam``."""
    run_node(SjsamNode)
