# SPDX-License-Identifier: Apache-2.0
"""The ``sjsam`` node: submaps of one or several agents in, one map and every agent's place in it out."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from time import ctime, monotonic
from typing import Any, TypeVar

import numpy as np
from rclpy.clock import Clock, ClockType  # type: ignore[attr-defined]
from std_srvs.srv import Trigger

from sjsam_node import map_messages
from sjsam_node.agents import separate_parts
from sjsam_node.correction import MapToOdom
from sjsam_node.global_map import ALREADY_JOINED, JoinReport
from sjsam_node.node_config import SjsamNodeConfig, copy_path
from sjsam_node.pose_tracker import PoseTracker
from sjsam_node.regions.live import LiveTasks
from sjsam_node.session.autosave import Autosave
from sjsam_node.session.map_session import MapSession, Mode, Outcome
from sjsam_node.session.submap_order import SubmapOrder, gap_text
from sjsam_node.smoothing.map_snapshot import ADVICE, MapSnapshot
from sjsam_node.tags.map_tags import map_tags, tags_text
from slam_core.geometry import FloatArray
from slam_core.health import State
from slam_core.messages import (
    SUBMAP_TOPICS,
    estimate_from_message,
    header_message,
    path_message,
    pose_with_covariance_message,
    position_from_message,
    submap_from_messages,
    transform_message,
)
from slam_core.messages.base import Message
from slam_core.messages.submap_keys import submap_keys_message
from slam_core.messages.submaps import SubmapMessages
from slam_core.nodes.awaiting import until
from slam_core.nodes.base_node import SlamNode
from slam_core.nodes.stamp_guard import StampPolicy
from slam_core.point_cloud import is_ply, write_ply
from slam_core.ros import below, run_node
from slam_core.types import PoseEstimate, Submap

T = TypeVar("T")
_MAP_PERIOD_S = 1.0
_TRANSFORM_PERIOD_S = 0.05


class SjsamNode(SlamNode[SjsamNodeConfig]):
    """Publishes each agent's pose, ``map_to_odom`` and the map.

    ``pose`` comes with every odometry message, ``map_to_odom`` twenty times a second, and the map, which costs the more
    the larger it is, once a second at most. Submaps are joined on a thread of
    :mod:`sjsam_node.session.map_session`, so that all else goes on meanwhile, from the last estimate.
    """

    CHANGEABLE = ("map_path", "ply_path", "transform_tolerance_s")

    def __init__(self) -> None:
        super().__init__("sjsam", SjsamNodeConfig)
        mode = Mode.LOCALISE if self.config.localize_only else Mode.MAP
        self.map = MapSession(self.config, mode, self._make_autosave(), LiveTasks.at(self.config.scheduler))
        self._stamp_ns, self._drawn = 0, self.map.snapshot
        self._picture: Future[Any] = self.map.read(lambda _: None)
        self._advertise_outputs()
        self.placements = {agent: MapToOdom(self.config) for agent in self.config.agents}
        self._start_trackers()
        self._go_on_from_last_time()
        self._order = SubmapOrder[tuple[str, Submap]](self.map.snapshot.keys)
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

    def _make_autosave(self) -> Autosave | None:
        period_s = self.config.autosave_period_s
        is_on = period_s > 0.0 and not self.config.localize_only
        return Autosave(copy_path(self.config, self.get_namespace()), period_s) if is_on else None

    def _go_on_from_last_time(self) -> None:
        """The map of a node that was killed, or the one to begin with or to localise in."""
        initial = self.config.initial_map or (self.config.map_path if self.config.localize_only else "")
        copy = self.map.crash_recovery_path()
        if copy is None and initial:
            self._show_loaded(self.map.load(Path(initial).expanduser(), self._seen).result())
            self.get_logger().info(f"{self.map.snapshot.submap_count} submaps read from {initial}")
        elif copy is not None:
            try:
                self._show_loaded(self.map.load(copy, self._seen).result())
            except ValueError as error:
                self.get_logger().error(f"the autosaved map cannot be used, a new one begins: {error}")
                self.map.reset()
                return
            written = ctime((copy / "manifest.json").stat().st_mtime)
            known = f"{self.map.snapshot.submap_count} submaps of {written} in {copy}"
            self.get_logger().warning(f"a node was killed: going on from {known} (~/reset forgets them)")

    def _start_trackers(self) -> None:
        """Follow every agent from its end in the map, else from the origin; one to be located from nowhere yet."""
        shown = self.map.snapshot
        last = dict(zip([agent for agent, _, _ in shown.keys], shown.poses[shown.nodes[:, 1]], strict=True))
        for agent, placement in self.placements.items():
            placement.start(PoseTracker(None if self.config.localize_only else last.get(agent, np.eye(4))))

    def _advertise_outputs(self) -> None:
        for name in ("map/landmarks", "map/cloud"):
            self.advertise(name, "PointCloud2", latched=True, depth=1)
        self.advertise("map/undecided", "DiagnosticArray", latched=True, depth=1)
        for name in ("map/ellipsoids", "map/graph", "map/marks"):
            self.advertise(name, "MarkerArray", latched=True, depth=1)
        for agent in self.config.agents:
            self.advertise(below(agent, "map/path"), "Path", latched=True, depth=1)
            self.advertise(below(agent, "pose"), "PoseWithCovarianceStamped")
            self.advertise(below(agent, "map_to_odom"), "TransformStamped", latched=True, depth=1)
            self.advertise(below(agent, "map_to_odom_pose"), "PoseWithCovarianceStamped", latched=True, depth=1)
        if self.config.anchor_path:
            self.broadcast_static(
                map_messages.anchor_message(self.types, self.config.anchor_path, self.config.map_frame)
            )

    def _listen_to(self, agent: str) -> None:
        topics = {below(agent, topic): kind for topic, kind in SUBMAP_TOPICS.items()}
        self.listen_together(topics, partial(self.on_submap, agent), latched=True, stamps=StampPolicy.ANY)
        optional = ("odom", "Odometry", self.on_odometry), ("position", "PoseWithCovarianceStamped", self.on_position)
        for topic, kind, take in optional:
            self.listen(below(agent, topic), kind, partial(take, agent), required=False, stamps=StampPolicy.ANY)

    def _serve(self, name: str, action: Callable[[], Awaitable[str]]) -> None:
        async def answer(_: Any, response: Any) -> Any:
            try:
                response.success, response.message = True, await action()
            except (ValueError, OSError) as error:
                response.success, response.message = False, str(error)
            self.get_logger().info(f"{name}: {response.message}")
            return response

        self.create_service(Trigger, f"~/{name}", answer)

    # -- inputs --------------------------------------------------------------------------------------------------------

    def on_submap(self, agent: str, *messages: Message) -> None:
        """One finished submap: it is joined, or located, after those before it."""
        submap = submap_from_messages(SubmapMessages(*messages))
        self._stamp_ns = max(self._stamp_ns, submap.end_stamp_ns)
        self.health.count("submaps received")
        key, item = (submap.agent, submap.session, submap.index), (agent, submap)
        self._hand_over([item] if self.config.localize_only else self._order.add(key, item))
        if self._order.should_ask(monotonic()):
            self.ask_again(below(agent, topic) for topic in SUBMAP_TOPICS)

    def _hand_over(self, submaps: list[tuple[str, Submap]]) -> None:
        """Have the session do its part, and go on from there."""
        for agent, submap in submaps:
            self.map.add(submap).add_done_callback(partial(self._take_later, agent, submap))
            self._show_waiting()

    def _take_later(self, agent: str, submap: Submap, done: Future[Outcome | None]) -> None:
        take = partial(self._take, agent, submap, done)
        self.do_later("submap", partial(self._process, "submap", 0, take, announce=False))

    def _take(self, agent: str, submap: Submap, done: Future[Outcome | None]) -> None:
        """Go on from what has become of a submap; nothing has where the node was reset meanwhile."""
        self._show_waiting()
        outcome = done.result()
        if outcome is not None and outcome.report is not None:
            self._take_joined(agent, submap, outcome, outcome.report)
        elif outcome is not None:
            self._take_located(agent, outcome)
        self.report_now()

    def _take_joined(self, agent: str, submap: Submap, joined: Outcome, report: JoinReport) -> None:
        if report.reason == ALREADY_JOINED:  # sent again to a node that was started again
            self.health.count("submaps sent again")
            return
        if joined.end is None:
            raise ValueError(f"submap {submap.frame_id}: {report.reason}")
        self.health.processed(joined.duration_s, is_frame=False)
        self.publish("map/undecided", submap_keys_message(self.types, self._stamp_ns, joined.undecided))
        self._count(report)
        self._follow(agent, joined.end, joined.in_odom)

    def _take_located(self, agent: str, located: Outcome) -> None:
        self.health.count("localized" if located.closures else "not recognised")
        if located.end is None:
            self.health.set(
                State.LOST, "the place is not recognised in the map: no pose and no map_to_odom until it is"
            )
            self.placements[agent].lose()
            return
        is_seen = located.closures > 0
        self.health.set(State.OK if is_seen else State.DEGRADED, "" if is_seen else "by odometry alone")
        self._follow(agent, located.end)

    def _show_waiting(self) -> None:
        self.health.take(self.map.load_counts)

    def on_odometry(self, agent: str, message: Message) -> None:
        """Publish the pose of an agent in the map at a pose of its odometry."""
        self.placements[agent].heard()
        for pose in self.placements[agent].tracker.add_odometry(estimate_from_message(message)):
            self.publish(below(agent, "pose"), pose_with_covariance_message(self.types, self.config.map_frame, pose))

    def on_position(self, agent: str, message: Message) -> None:
        """A position of an agent's antenna in a fixed frame."""
        self.map.add_position(agent, position_from_message(message))

    def on_clicked_point(self, message: Message) -> None:
        """Mark a find at a point of the map frame."""
        self._mark(map_messages.clicked_point(message, self.config.map_frame))

    def on_initial_pose(self, message: Message) -> None:
        """Take the pose at which the agents are believed to be in the loaded map."""
        estimate = estimate_from_message(message)
        for agent in self.config.agents:
            self.map.set_pose(agent, estimate)

    def on_reset(self) -> None:
        """Forget the map; in a loaded map only where the agents are."""
        self.map.reset()
        self._start_trackers()
        self._publish_map()

    async def on_finish(self) -> str:
        """Join all submaps that have come and settle the map: saved now, it is that of ``slam run``."""
        await self._done(self.map.finish())
        self.finish_work()
        return f"{self.map.snapshot.submap_count} submaps joined"

    def on_close(self) -> None:
        """Join what waits: no submap that has come is lost."""
        self.finish_work()
        self._hand_over(self._order.give_up())
        if self.map.waiting:
            self.get_logger().info(f"joining {self.map.waiting} submaps before the end")
        self.map.close()

    def _follow(self, agent: str, end: PoseEstimate, in_odom: PoseEstimate | None = None) -> None:
        """The end of a submap is known in the map: carry the agent's odometry on from there."""
        tracker = self.placements[agent].tracker
        if tracker.newest_ns is None:  # no odometry is heard: the ends of submaps are all that is known
            self.placements[agent].heard()
            self.publish(below(agent, "pose"), pose_with_covariance_message(self.types, self.config.map_frame, end))
        if tracker.has_heard(end.stamp_ns):
            tracker.add_submap(end)
        elif in_odom is not None:
            tracker.add_submap(end, in_odom)

    def _count(self, report: JoinReport) -> None:
        self.health.count("submaps refined" if report.is_refined else "submaps joined")
        self.health.count("closures", len(report.closures))
        self.health.take(self.map.counts | {"components": report.components})
        reasons = [separate_parts(self.map.snapshot)] if report.components > 1 else []
        if report.is_strained:
            reasons.append(f"submaps contradict each other {report.variance_factor:.0f} times more than they claim")
            self.get_logger().warning(f"{reasons[-1]}. {ADVICE}", once=True)
        self.health.set(State.DEGRADED if reasons else State.OK, ", ".join(reasons))

    # -- services ------------------------------------------------------------------------------------------------------

    async def save_map(self) -> str:
        """Write the map, with the submaps joined so far, to ``map_path``; an empty one never over another."""
        waiting = self.map.waiting
        await self._done(self.map.save(self.map_path))
        self._publish_map()
        return self._size("written to") + (f", {waiting} more wait to be joined" if waiting else "")

    async def load_map(self) -> str:
        """Replace the map by the one in ``map_path``; where that cannot be used the map stays as it is."""
        self._show_loaded(await self._done(self.map.load(self.map_path, self._seen)))
        return self._size("read from")

    def _seen(self, loaded: MapSnapshot) -> dict[str, Message]:
        """Messages of a loaded map."""
        self._stamp_ns = max(s.end_stamp_ns for s in loaded.submaps)
        return self._map_messages(loaded)

    def _show_loaded(self, outputs: dict[str, Message]) -> None:
        self._start_trackers()
        self._publish_all(outputs)
        self._drawn = self.map.snapshot

    async def export_ply(self) -> str:
        """Write the landmarks to ``ply_path``; a file that is no PLY is not replaced."""
        path = self.ply_path
        if path.exists() and not is_ply(path):
            raise ValueError(f"{path} is there and no PLY file: it is left as it is, choose another ply_path")
        landmarks = await self._done(self.map.read(MapSnapshot.landmarks))
        write_ply(path, landmarks.positions.astype(np.float32))
        return f"{len(landmarks.positions)} landmarks written to {path}"

    async def mark_here(self) -> str:
        """Mark where the agent that was heard last is."""
        return self._mark(self.map.snapshot.newest_place)

    def _mark(self, point: FloatArray) -> str:
        mark = self.map.mark(point)
        header = header_message(self.types, self._stamp_ns, self.config.map_frame)
        self.publish("map/marks", map_messages.marks_message(self.types, header, self.map.snapshot.mark_positions()))
        return mark.name

    def _size(self, done: str) -> str:
        return f"{self.map.snapshot.submap_count} submaps {done} {self.map_path}"

    async def _done(self, future: Future[T]) -> T:
        """Result of another thread; until it is there the node does all else."""
        future.add_done_callback(lambda _: self._wake.trigger())
        await until(future.done)
        return future.result()

    # -- outputs -------------------------------------------------------------------------------------------------------

    def _publish_news(self) -> None:
        if missing := self._order.overdue(monotonic()):
            for (agent, _), indices in missing.items():
                self.health.count("submaps missed", len(indices))
                self.get_logger().warning(gap_text(agent, indices))
            self._hand_over(self._order.give_up())
        if self._drawn is not self.map.snapshot and self._picture.done():
            self._publish_map()
        copy = self.map.save_copy()
        if copy is not None:  # what went wrong with the one before shows
            copy.add_done_callback(lambda done: self.do_later("autosave", done.result))

    def _publish_map(self) -> None:
        """Have the map drawn and then published."""
        self._picture = self.map.read(self._draw)
        self._picture.add_done_callback(lambda done: self.do_later("map", lambda: self._publish_all(done.result())))

    def _draw(self, snapshot: MapSnapshot) -> dict[str, Message]:
        self._drawn = self.map.snapshot
        return self._map_messages(snapshot)

    def _publish_all(self, messages: dict[str, Message]) -> None:
        for topic, message in messages.items():
            self.publish(topic, message)

    def _map_messages(self, snapshot: MapSnapshot) -> dict[str, Message]:
        """Messages that show a map, by topic; on the thread that may read its covariances."""
        header = header_message(self.types, self._stamp_ns, self.config.map_frame)
        landmarks, paths = snapshot.landmarks(), snapshot.path()
        if said := tags_text(map_tags(snapshot, landmarks)):
            self.do_later("tags", lambda: self.health.show("tags", said))
        if (frame := snapshot.fixed_frame()) is not None and not self.config.anchor_path:
            fixed = map_messages.fixed_frame_message(self.types, frame, self.config.map_frame)
            self.do_later("building", partial(self.broadcast_static, fixed))
        messages = map_messages.map_pictures(self.types, header, snapshot, landmarks)
        if self.has_listeners("map/ellipsoids"):
            messages["map/ellipsoids"] = map_messages.ellipsoids_message(self.types, header, landmarks)
        for agent in self.config.agents:
            poses = paths.get(agent, [])
            messages[below(agent, "map/path")] = path_message(self.types, self._stamp_ns, self.config.map_frame, poses)
        return messages

    def _publish_transforms(self) -> None:
        """``map_to_odom`` of every agent that has odometry, stamped a little ahead of the present time."""
        if self._paused:
            return
        for agent, placement in self.placements.items():
            if (found := placement.at_present(self._stamp_ns, self.config.transform_tolerance_s)) is None:
                continue
            pose, held_back_m = found
            frame, odom = self.config.map_frame, below(agent, self.config.odom_frame)
            message = transform_message(self.types, pose.stamp_ns, frame, odom, pose.T)
            self.publish(below(agent, "map_to_odom"), message)
            self.broadcast(message)
            self.publish(below(agent, "map_to_odom_pose"), pose_with_covariance_message(self.types, frame, pose))
            if placement.is_bounded:
                self.health.show(below(agent, "correction_held_back_m"), f"{held_back_m:.3f}")


def main() -> None:
    """Entry point of ``ros2 run sjsam_node sjsam``."""
    run_node(SjsamNode, small_packets=True)
