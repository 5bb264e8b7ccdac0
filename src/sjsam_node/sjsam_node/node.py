# SPDX-License-Identifier: Apache-2.0
"""The ``sjsam`` node: submaps of one or several agents in, one map and every agent's place in it out."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType  # type: ignore[attr-defined]
from std_srvs.srv import Trigger

from sjsam_node.autosave import Autosave
from sjsam_node.global_map import ALREADY_JOINED, GlobalMap, GlobalMapConfig, JoinReport
from sjsam_node.localization import Localizer
from sjsam_node.map_messages import (
    cloud_message,
    ellipsoids_message,
    graph_message,
    landmarks_message,
    marks_message,
)  # fmt: skip
from sjsam_node.pose_tracker import PoseTracker
from slam_core.base_node import SlamNode
from slam_core.config import parameter
from slam_core.health import State
from slam_core.messages import (
    SUBMAP_TOPICS,
    estimate_from_message,
    header_message,
    path_message,
    pose_with_covariance_message,
    submap_from_messages,
    transform_message,
)
from slam_core.messages.base import Message
from slam_core.messages.submaps import SubmapMessages
from slam_core.point_cloud import is_ply, write_ply
from slam_core.ros import run_node
from slam_core.stamp_guard import StampPolicy
from slam_core.types import PoseEstimate, Submap

_MAP_PERIOD_S = 1.0
_TRANSFORM_PERIOD_S = 0.05
_LONGEST_SILENCE_S = 1.0
"""``map_to_odom`` is stamped as if time went on for so long after the last odometry."""


@dataclass(frozen=True)
class SjsamNodeConfig(GlobalMapConfig):
    """The map's parameters and the node's own."""

    agents: tuple[str, ...] = parameter(("",), "namespaces of the agents whose submaps are joined")
    map_frame: str = parameter("map", "frame of the map")
    odom_frame: str = parameter("odom", "frame of each agent's odometry, below its namespace")
    map_path: str = parameter("map", "folder that save_map writes and load_map reads")
    ply_path: str = parameter("map_landmarks.ply", "file that export_ply writes")
    localize_only: bool = parameter(False, "locate the agents in the loaded map without changing it")
    autosave_period_s: float = parameter(
        10.0, "time between two copies of the map that a killed node goes on from; 0: none", unit="s", minimum=0.0
    )
    autosave_path: str = parameter("", "folder of that copy; empty: map_path with the ending .autosave")
    transform_tolerance_s: float = parameter(
        0.2, "how far ahead map_to_odom is stamped, so that a lookup at the present time works", unit="s", minimum=0.0
    )


class SjsamNode(SlamNode[SjsamNodeConfig]):
    """Publishes each agent's pose, ``map_to_odom`` and the map.

    ``pose`` comes with every odometry message, ``map_to_odom`` twenty times a second, and the map, which costs the more
    the larger it is, once a second at most. None of them changes the map.
    """

    CHANGEABLE = ("map_path", "ply_path", "transform_tolerance_s")

    def __init__(self) -> None:
        super().__init__("sjsam", SjsamNodeConfig)
        self.global_map = GlobalMap(self.config)
        self.localizers: dict[str, Localizer] = {}
        self.autosave = self._make_autosave()
        self._stamp_ns = 0
        self._map_is_news = self._copy_is_old = False
        self._advertise_outputs()
        self._go_on_from_last_time()
        self.trackers = {agent: self._make_tracker(agent) for agent in self.config.agents}
        self._heard_at_s: dict[str, float] = {}
        for agent in self.config.agents:
            self._listen_to(agent)
        self.listen("clicked_point", "PointStamped", self.on_clicked_point, required=False)
        self.listen(
            "initialpose", "PoseWithCovarianceStamped", self.on_initial_pose, required=False, stamps=StampPolicy.ANY
        )
        for service in (self.save_map, self.load_map, self.export_ply, self.mark_here):
            self._serve(service.__name__, service)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_MAP_PERIOD_S, self._publish_news, clock=steady)
        self.create_timer(_TRANSFORM_PERIOD_S, self._publish_transforms, clock=steady)

    @property
    def map_path(self) -> Path:
        """Folder of the saved map."""
        return Path(self.config.map_path).expanduser()

    @property
    def ply_path(self) -> Path:
        """File of the exported landmarks."""
        return Path(self.config.ply_path).expanduser()

    def _make_autosave(self) -> Autosave:
        path = self.config.autosave_path or f"{self.map_path}.autosave"
        return Autosave(Path(path).expanduser(), 0.0 if self.config.localize_only else self.config.autosave_period_s)

    def _go_on_from_last_time(self) -> None:
        """The map of a node that was killed, or the one to localise in."""
        if self.config.localize_only:
            self.get_logger().info(self.load_map())
        elif (copy := self.autosave.found()) is not None:
            try:
                self._replace_map(copy)
            except ValueError as error:
                self.get_logger().error(f"the autosaved map cannot be used, a new one begins: {error}")
                self.autosave.put_away()
                return
            count = len(self.global_map.graph.records)
            self.get_logger().warning(
                f"a node was killed: going on from {count} submaps in {copy} (~/reset forgets them)"
            )

    def _make_tracker(self, agent: str) -> PoseTracker:
        return PoseTracker(None if self.config.localize_only else self.global_map.last_pose(agent))

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
        if report.reason == ALREADY_JOINED:  # sent again to a node that was started again
            self.health.count("submaps sent again")
            return
        if not report.accepted:
            raise ValueError(f"submap {submap.frame_id}: {report.reason}")
        self._count(report)
        pose = self.global_map.end_pose(submap.agent)
        if pose is not None:
            self._follow(agent, pose, submap)
        self._map_is_news = self._copy_is_old = True

    def on_odometry(self, agent: str, message: Message) -> None:
        """Where the agent is in the map at a pose of its odometry."""
        self._heard_at_s[agent] = time.monotonic()
        for pose in self.trackers[agent].add_odometry(estimate_from_message(message)):
            self.publish(_below(agent, "pose"), pose_with_covariance_message(self.types, self.config.map_frame, pose))

    def on_clicked_point(self, message: Message) -> None:
        """Mark a find at a point of the map frame."""
        if message.header.frame_id not in ("", self.config.map_frame):
            raise ValueError(f"clicked_point must be in frame {self.config.map_frame}, got {message.header.frame_id}")
        self.global_map.marks.add(self.global_map.graph, np.array([message.point.x, message.point.y, message.point.z]))
        self._publish_marks()
        self._copy_is_old = True

    def on_initial_pose(self, message: Message) -> None:
        """Where the agents are believed to be in the loaded map."""
        estimate = estimate_from_message(message)
        for agent in self.config.agents:
            self._localizer(agent).set_pose(estimate)

    def on_reset(self) -> None:
        """Forget the map; in a loaded map only where the agents are."""
        self.localizers.clear()
        if not self.config.localize_only:
            self.global_map.reset()
            self.autosave.put_away()
            self._copy_is_old = False
            self._publish_map()
        self.trackers = {agent: self._make_tracker(agent) for agent in self.config.agents}

    def on_close(self) -> None:
        """Write what has been mapped since the last copy, and put the copy away: nobody needs to go on from it."""
        if self.autosave.is_on and self._copy_is_old:
            self.autosave.wait()
            self.autosave.save(self.global_map.stored(), time.monotonic())
        self.autosave.put_away()
        self.autosave.close()

    def _localizer(self, agent: str) -> Localizer:
        return self.localizers.setdefault(agent, Localizer(self.global_map))

    def _localize(self, agent: str, submap: Submap) -> None:
        found = self._localizer(agent).process(submap)
        self.health.count("localized" if found.matched else "not recognised")
        if found.pose is None:
            self.health.set(State.LOST, "the place is not recognised in the map")
            return
        self.health.set(State.OK if found.matched else State.DEGRADED, "" if found.matched else "by odometry alone")
        self._follow(agent, found.pose, submap)

    def _follow(self, agent: str, end: PoseEstimate, submap: Submap) -> None:
        """The end of a submap is known in the map: carry the agent's odometry on from there."""
        tracker = self.trackers[agent]
        if tracker.newest_ns is None:  # no odometry is heard: the ends of submaps are all that is known
            self._heard_at_s[agent] = time.monotonic()
            self.publish(_below(agent, "pose"), pose_with_covariance_message(self.types, self.config.map_frame, end))
        if tracker.has_heard(end.stamp_ns):
            tracker.add_submap(end)
        elif not self.config.localize_only:
            tracker.add_submap(end, self.global_map.odometry_pose(submap.agent))

    def _count(self, report: JoinReport) -> None:
        self.health.count("submaps")
        self.health.count("closures", len(report.closures))
        self.health.counters["components"] = report.components
        for name, count in self.global_map.counters.counts.items():
            self.health.counters[name] = count
        reasons = [f"{report.components} separate parts"] if report.components > 1 else []
        if report.is_strained:
            reasons.append(f"submaps contradict each other {report.variance_factor:.0f} times more than they claim")
        self.health.set(State.DEGRADED if reasons else State.OK, ", ".join(reasons))

    # -- services ------------------------------------------------------------------------------------------------------

    def save_map(self) -> str:
        """Write the map to ``map_path``; an empty one never over another."""
        if not self.global_map.graph.records and self.map_path.exists():
            raise ValueError(f"the map is empty: {self.map_path} is left as it is")
        self.global_map.save(self.map_path)
        self._publish_map()
        return f"{len(self.global_map.graph.records)} submaps written to {self.map_path}"

    def load_map(self) -> str:
        """Replace the map by the one in ``map_path``; where that cannot be used the map stays as it is."""
        self._replace_map(self.map_path)
        self.trackers = {agent: self._make_tracker(agent) for agent in self.config.agents}
        return f"{len(self.global_map.graph.records)} submaps read from {self.map_path}"

    def _replace_map(self, path: Path) -> None:
        loaded = GlobalMap.load(path, self.config)
        self._stamp_ns = max((r.submap.end_stamp_ns for r in loaded.graph.records), default=self._stamp_ns)
        outputs = self._map_messages(loaded)  # whatever is wrong with it shows before anything changes
        self.global_map = loaded
        self.localizers.clear()
        self._copy_is_old = True
        self._publish_all(outputs)

    def export_ply(self) -> str:
        """Write the landmarks to ``ply_path``; a file that is no PLY is not replaced."""
        if self.ply_path.exists() and not is_ply(self.ply_path):
            raise ValueError(f"{self.ply_path} is there and no PLY file: it is left as it is, choose another ply_path")
        positions = self.global_map.landmarks().positions
        write_ply(self.ply_path, positions.astype(np.float32))
        return f"{len(positions)} landmarks written to {self.ply_path}"

    def mark_here(self) -> str:
        """Mark where the agent that was heard last is."""
        records = self.global_map.graph.records
        if not records:
            raise ValueError("nothing can be marked in an empty map")
        mark = self.global_map.marks.add(self.global_map.graph, self.global_map.graph.poses[records[-1].end][:3, 3])
        self._publish_marks()
        self._copy_is_old = True
        return mark.name

    # -- outputs -------------------------------------------------------------------------------------------------------

    def _publish_news(self) -> None:
        if self._map_is_news:
            self._publish_map()
        if self._copy_is_old and self.autosave.is_due(time.monotonic()):
            self._copy_is_old = False
            self.autosave.save(self.global_map.stored(), time.monotonic())

    def _publish_map(self) -> None:
        self._map_is_news = False
        self._publish_all(self._map_messages(self.global_map))

    def _publish_all(self, messages: dict[str, Message]) -> None:
        for topic, message in messages.items():
            self.publish(topic, message)

    def _map_messages(self, global_map: GlobalMap) -> dict[str, Message]:
        """What a map looks like, by topic."""
        header = header_message(self.types, self._stamp_ns, self.config.map_frame)
        landmarks, paths = global_map.landmarks(), global_map.path()
        messages = {
            "map/landmarks": landmarks_message(self.types, header, landmarks),
            "map/cloud": cloud_message(self.types, header, landmarks),
            "map/graph": graph_message(self.types, header, global_map),
            "map/marks": marks_message(self.types, header, global_map.marks.positions(global_map.graph)),
        }
        if self.has_listeners("map/ellipsoids"):
            messages["map/ellipsoids"] = ellipsoids_message(self.types, header, landmarks)
        for agent in self.config.agents:
            poses = paths.get(agent, [])
            messages[_below(agent, "map/path")] = path_message(self.types, self._stamp_ns, self.config.map_frame, poses)
        return messages

    def _publish_marks(self) -> None:
        header = header_message(self.types, self._stamp_ns, self.config.map_frame)
        marks = self.global_map.marks.positions(self.global_map.graph)
        self.publish("map/marks", marks_message(self.types, header, marks))

    def _publish_transforms(self) -> None:
        """``map_to_odom`` of every agent that has odometry, stamped a little ahead of the present time."""
        for agent, heard_at_s in self._heard_at_s.items():
            T_map_odom = self.trackers[agent].T_map_odom
            if T_map_odom is None or self._paused:
                continue
            stamp = self.trackers[agent].newest_ns or self._stamp_ns
            gone_s = min(time.monotonic() - heard_at_s, _LONGEST_SILENCE_S)
            ahead = stamp + round(1e9 * (gone_s + self.config.transform_tolerance_s))
            odom = _below(agent, self.config.odom_frame)
            message = transform_message(self.types, ahead, self.config.map_frame, odom, T_map_odom)
            self.publish(_below(agent, "map_to_odom"), message)
            self.broadcast(message)


def _below(agent: str, name: str) -> str:
    """A topic or frame below an agent's namespace."""
    return f"{agent}/{name}" if agent else name


def main() -> None:
    """Entry point of ``ros2 run sjsam_node sjsam``."""
    run_node(SjsamNode)
