# SPDX-License-Identifier: Apache-2.0
"""The ``viewer`` node: what the other nodes publish, live on the page."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from rclpy.clock import Clock, ClockType  # type: ignore[attr-defined]
from std_srvs.srv import Trigger

from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.plans.storeys import CurrentStorey
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray
from slam_core.messages import (
    cloud_from_message,
    estimate_from_message,
    header_message,
    image_from_message,
    occupancy_from_message,
    path_from_message,
    pose_from_message,
    transform_from_message,
)
from slam_core.messages.base import Message
from slam_core.nodes.base_node import SlamNode
from slam_core.nodes.stamp_guard import StampPolicy
from slam_core.ros import below, run_node, sensor_qos
from slam_core.types import ByteArray, PoseEstimate
from slam_radio.wire.link_report import LinkReport
from slam_viewer.page.agent_link import link_text, link_warning, reach, reach_text
from slam_viewer.page.asked_views import AskedViews
from slam_viewer.page.command_post import has_place, position_radius, storey_at, unseen, ways_out
from slam_viewer.page.page import ViewerPage
from slam_viewer.page.panel import AgentRow

_SILENT_S = 3.0
_STOREYS = 4
_STATES = ("OK", "DEGRADED", "LOST")
_ABOVE_FLOOR_M = 0.04
_EYE_LEVEL_M = 1.2
"""A place that is clicked on the floor is asked for at this height above it."""
_POST_PERIOD_S = 2.0
"""Time from one look for ways out to the next, s."""


@dataclass(frozen=True)
class ViewerConfig(Config):
    """The viewer."""

    agents: tuple[str, ...] = parameter(("",), "namespaces of the agents that are shown")
    port: int = parameter(8080, "port of the page; 0: any that is free", minimum=0, maximum=65535)
    host: str = parameter(
        "127.0.0.1",
        "address the page listens on; 0.0.0.0 lets other machines see it, who know the token in its address",
    )
    map_frame: str = parameter("map", "frame of the map")
    walking_speed: float = parameter(
        1.5, "the disc that an agent is in grows so fast while nothing is heard of it", unit="m/s", minimum=0.0
    )


@dataclass
class _Agent:
    """State of one agent."""

    state: str = "no news yet"
    reason: str = ""
    T_map_odom: FloatArray = field(default_factory=lambda: np.eye(4))
    pose: PoseEstimate | None = None
    T_odom_base: FloatArray | None = None
    heard_at_ns: int = 0
    picture_at_ns: int = 0
    path: FloatArray | None = None
    link: LinkReport | None = None

    def silent_s(self, now_ns: int) -> float:
        """Time since the last odometry, 0 while that is short."""
        silent_s = (now_ns - self.heard_at_ns) / 1e9
        return silent_s if self.heard_at_ns and silent_s > _SILENT_S else 0.0


class ViewerNode(SlamNode[ViewerConfig]):
    """Shows agents, map, model and floor plan.

    A click on the page, once asked for, is published as ``clicked_point``.
    """

    def __init__(self) -> None:
        super().__init__("viewer", ViewerConfig)
        self.page = ViewerPage(self.config.port, self.config.host)
        self._agents = {agent: _Agent() for agent in self.config.agents}
        self._plans: dict[int, FloorPlan] = {}
        self._storeys: dict[str, CurrentStorey] = {}
        self._looked = False
        self.advertise("clicked_point", "PointStamped")
        for index, agent in enumerate(self.config.agents):
            self._listen_to(index, agent)
        self._listen_to_map()
        with self.page.overview:
            button = self.page.server.gui.add_button("Mark a place: then click into the scene")
            button.on_click(lambda _: self.page.on_click(self._on_click))
            for agent in self.config.agents:
                here = self.page.server.gui.add_button(f"Mark where {agent or 'the rig'} is")
                here.on_click(partial(self._mark_agent, agent))
            self._ask = self.page.server.gui.add_button("Ask agents for details of all submaps", visible=False)
            self._ask.on_click(lambda _: self._ask_for_details())
        self._asked = AskedViews(self, self.page, self._place_of)
        self._request_details = self.create_client(Trigger, "radio_link/request_details")
        self.create_timer(_POST_PERIOD_S, self._show_post, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(f"the page is at {self.page.url}")

    def on_shutdown(self) -> None:  # type: ignore[override]  # no lifecycle node: rclpy's own takes a state
        """Close the page."""
        self.page.stop()

    def _listen_to(self, index: int, agent: str) -> None:
        own = partial(below, agent)
        self.listen(
            own("odom"), "Odometry", partial(self._on_odometry, index, agent), required=False, stamps=StampPolicy.ANY
        )
        self.listen(
            own("map_to_odom"),
            "TransformStamped",
            partial(self._on_map_to_odom, agent),
            latched=True,
            required=False,
            stamps=StampPolicy.ANY,
        )
        self.listen(
            own("pose"),
            "PoseWithCovarianceStamped",
            partial(self._on_pose, agent),
            required=False,
            stamps=StampPolicy.ANY,
        )
        self.listen(
            own("map/path"),
            "Path",
            partial(self._on_path, index, agent),
            latched=True,
            required=False,
            stamps=StampPolicy.ANY,
        )
        self.listen(
            own("features/image"), "Image", partial(self._on_picture, agent), required=False, stamps=StampPolicy.ANY
        )

    def _listen_to_map(self) -> None:
        self.listen(
            "map/landmarks", "PointCloud2", self._on_landmarks, latched=True, required=False, stamps=StampPolicy.ANY
        )
        # Markers have no stamp of their own, which the inputs of estimators need.
        for topic, show in (("map/graph", self._on_graph), ("map/marks", self._on_marks)):
            take = partial(self._take_markers, topic, show)
            self.create_subscription(self._ros_types.MarkerArray, topic, take, sensor_qos(1, latched=True))
        # Diagnostics are stamped by the clock on the wall, a replay's messages by that of the recording.
        self.create_subscription(self._ros_types.DiagnosticArray, "/diagnostics", self._on_diagnostics, sensor_qos(100))
        self.listen(
            "map/dense_cloud", "PointCloud2", self._on_dense_cloud, latched=True, required=False, stamps=StampPolicy.ANY
        )
        for number in range(_STOREYS):
            topic = f"map/occupancy_{number}" if number else "map/occupancy"
            self.listen(
                topic,
                "OccupancyGrid",
                partial(self._on_plan, number),
                latched=True,
                required=False,
                stamps=StampPolicy.ANY,
            )

    # -- agents --------------------------------------------------------------------------------------------------------

    def _on_odometry(self, index: int, agent: str, message: Message) -> None:
        own = self._agents[agent]
        own.T_odom_base, own.heard_at_ns = pose_from_message(message.pose.pose), self._now_ns()
        if own.state == "no news yet":
            own.state = "OK"
        self.page.show_agent(agent, index, own.T_map_odom @ own.T_odom_base)

    def _on_map_to_odom(self, agent: str, message: Message) -> None:
        self._agents[agent].T_map_odom = transform_from_message(message)[2]

    def _on_pose(self, agent: str, message: Message) -> None:
        self._agents[agent].pose = estimate_from_message(message)

    def _on_path(self, index: int, agent: str, message: Message) -> None:
        poses = path_from_message(message)
        if len(poses) < 2:
            return
        matrices = np.stack([T for _, T in poses])
        self._agents[agent].path = matrices[:, :3, 3]
        self.page.show_trajectory(index, matrices)

    def _on_picture(self, agent: str, message: Message) -> None:
        own, now = self._agents[agent], self._now_ns()
        if now - own.picture_at_ns < 200_000_000:  # five a second are enough for the eye
            return
        own.picture_at_ns = now
        picture = _rgb(message)
        self.page.show_picture(picture, f"{agent or 'rig'}: features by depth; circle stereo, square ToF")
        if own.T_odom_base is not None:
            self.page.show_camera(own.T_map_odom @ own.T_odom_base, picture)

    def _on_diagnostics(self, message: Message) -> None:
        for status in message.status:
            if status.name == f"{self.get_namespace().rstrip('/')}/radio_link":
                self._on_links({pair.key: pair.value for pair in status.values})
            for agent, own in self._agents.items():
                if status.name == f"/{below(agent, 'ekf_slam')}":
                    level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
                    own.state, own.reason = _STATES[min(level, 2)], str(status.message)

    def _on_links(self, values: Mapping[str, str]) -> None:
        """Keep what the post's radio_link says of the link to each agent."""
        try:
            links = {agent: LinkReport.of(agent, values) for agent in self._agents}
        except ValueError as error:
            self._reject(f"/diagnostics: message of radio_link rejected: {error}")
            return
        for agent, link in links.items():
            self._agents[agent].link = link
        self._ask.visible = any(links.values())
        self._asked.offer(is_post=any(links.values()))

    def _ask_for_details(self) -> None:
        """Have the post's radio_link ask for the landmarks that light submaps left out."""
        if self._request_details.service_is_ready():
            asked = self._request_details.call_async(Trigger.Request())
            asked.add_done_callback(lambda done: self.get_logger().info(done.result().message))
        else:
            self.get_logger().warning("no radio_link beside the viewer answers: no details are asked for")

    # -- map -----------------------------------------------------------------------------------------------------------

    def _on_landmarks(self, message: Message) -> None:
        cloud = cloud_from_message(message)
        covariances = np.empty((len(cloud), 3, 3))
        for i, a in enumerate("xyz"):
            for j, b in enumerate("xyz"):
                covariances[:, i, j] = cloud[f"cov_{min(a, b)}{max(a, b)}"]
        positions = np.stack([cloud[axis] for axis in "xyz"], axis=1).astype(np.float64)
        self.page.show_landmarks(positions, covariances, cloud["sightings"].astype(np.int64))

    def _take_markers(self, topic: str, show: Callable[[Message], None], message: Message) -> None:
        """Rejects what is no marker of ours, as :meth:`listen` does for messages with a stamp."""
        try:
            if not np.isfinite([[p.x, p.y, p.z] for marker in message.markers for p in marker.points]).all():
                raise ValueError("a point is not finite")
            show(message)
        except ValueError as error:
            self._reject(f"{topic}: message rejected: {error}")

    def _on_graph(self, message: Message) -> None:
        for marker in message.markers:
            lines = np.array([[p.x, p.y, p.z] for p in marker.points]).reshape(-1, 2, 3)
            if marker.ns == "closures":
                self.page.show_closures(lines)
            else:
                self.page.show_submaps(lines[:, 0], lines[:, 1])

    def _on_marks(self, message: Message) -> None:
        points = [[p.x, p.y, p.z] for marker in message.markers for p in marker.points]
        self.page.show_marks([f"mark {k + 1}" for k in range(len(points))], np.array(points).reshape(-1, 3))

    def _on_dense_cloud(self, message: Message) -> None:
        cloud = cloud_from_message(message)
        points = np.stack([cloud[axis] for axis in "xyz"], axis=1).astype(np.float32)
        packed = np.ascontiguousarray(cloud["rgb"]).view(np.uint32)
        colours = np.stack([(packed >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)
        self.page.show_layer("dense points")
        self.page.show_points(points, colours)
        if not self._looked and len(points):
            self._looked = True
            self.page.look_at(points.astype(np.float64))

    def _on_plan(self, number: int, message: Message) -> None:
        plan = FloorPlan(*occupancy_from_message(message))
        self._plans[number] = plan
        self.page.show_plan(plan, number)
        borders = unseen(tuple(self._plans.values()))
        self.page.show_frontiers(np.array([f.point for f in borders]).reshape(-1, 3), [f.length for f in borders])

    # -- command post --------------------------------------------------------------------------------------------------

    def _show_post(self) -> None:
        rows, poses, paths = [], {}, {}
        for index, (agent, own) in enumerate(self._agents.items()):
            rows.append(self._row(agent, own))
            self._show_reach(index, own)
            if own.T_odom_base is not None and own.path is not None:
                covariance = np.zeros((6, 6)) if own.pose is None else own.pose.covariance
                poses[agent] = PoseEstimate(0, own.T_map_odom @ own.T_odom_base, covariance)
                paths[agent] = own.path
        self.page.show_agent_table(rows)
        self._show_storeys(poses)
        texts = []
        for out in ways_out(tuple(self._plans.values()), poses, paths) if self._plans else ():
            points = np.empty((0, 3)) if out.route is None else out.route.points
            self.page.show_way(list(self._agents).index(out.agent), points, out.label)
            texts.append((out.agent, out.text))
        self.page.show_ways_text(texts)

    def _show_storeys(self, poses: Mapping[str, PoseEstimate]) -> None:
        """Show the plans up to the storey of the highest agent; all while nobody has a place."""
        plans = tuple(self._plans[number] for number in sorted(self._plans))
        for agent, pose in poses.items():
            self._storeys.setdefault(agent, CurrentStorey()).update(plans, pose.T[:3, 3])
        numbers = [own.number for own in self._storeys.values() if own.number is not None]
        self.page.show_storeys_up_to(max(numbers, default=_STOREYS))

    def _row(self, agent: str, own: _Agent) -> AgentRow:
        silent_s = own.silent_s(self._now_ns())
        state = f"silent for {silent_s:.0f} s" if silent_s else own.state
        note = own.reason if own.reason not in ("", "OK") else ""
        storey = self._storeys[agent].number if agent in self._storeys else None
        if storey is not None and len(self._plans) > 1:
            note = " ".join(filter(None, (note, f"storey {storey}")))
        if own.pose is not None:
            where = reach_text(position_radius(own.pose), silent_s, self.config.walking_speed)
            note = " ".join(filter(None, (note, where)))
        if own.link is None:
            return AgentRow(agent, state, note)
        return AgentRow(agent, state, note, link_text(own.link), link_warning(own.link))

    def _show_reach(self, index: int, own: _Agent) -> None:
        """The disc that an agent is in, on the floor where that is known; none while the map does not say where."""
        if own.pose is None or own.T_odom_base is None:
            return
        radius, point = position_radius(own.pose), (own.T_map_odom @ own.T_odom_base)[:3, 3]
        plan = storey_at(tuple(self._plans.values()), point)
        if plan is not None:
            point = point - (float(plan.height_of(point[None])[0]) - _ABOVE_FLOOR_M) * plan.T_map_plan[:3, 2]
        silent_s = own.silent_s(self._now_ns())
        shown = reach(radius, silent_s, self.config.walking_speed) if has_place(radius) else np.inf
        self.page.show_reach(index, point, shown)

    def _on_click(self, origin: FloatArray, direction: FloatArray) -> None:
        """Publish where the ray of a click meets the floor."""
        if (point := self._on_floor(origin, direction)) is not None:
            self._publish_mark(point)

    def _on_floor(self, origin: FloatArray, direction: FloatArray) -> FloatArray | None:
        """Point (3,) m where a ray meets the lowest floor plan, or the map's plane z = 0; None if it is parallel."""
        T = self._plans[0].T_map_plan if self._plans else np.eye(4)
        along = float(direction @ T[:3, 2])
        return None if abs(along) < 1e-6 else origin + direction * ((T[:3, 3] - origin) @ T[:3, 2]) / along

    def _place_of(self, origin: FloatArray, direction: FloatArray) -> FloatArray | None:
        """Point (3,) m at eye level above that of a click; without a plan, the map's z = 0 is at that level."""
        point = self._on_floor(origin, direction)
        if point is None or not self._plans:
            return point
        return np.asarray(point + _EYE_LEVEL_M * self._plans[0].T_map_plan[:3, 2])

    def _mark_agent(self, agent: str, _: object) -> None:
        """Publish where an agent is, as a find of its own; nothing while that is not known."""
        own = self._agents[agent]
        if own.T_odom_base is not None:
            self._publish_mark((own.T_map_odom @ own.T_odom_base)[:3, 3])

    def _publish_mark(self, point: FloatArray) -> None:
        x, y, z = point.tolist()
        header = header_message(self.types, self._now_ns(), self.config.map_frame)
        self.publish("clicked_point", self.types.PointStamped(header=header, point=self.types.Point(x=x, y=y, z=z)))

    def _now_ns(self) -> int:
        """Time of this machine: how long nobody was heard is a matter of the page, not of the map."""
        return int(self.get_clock().now().nanoseconds)


def _rgb(message: Message) -> ByteArray:
    """A picture as RGB (h, w, 3) uint8."""
    picture = image_from_message(message)
    if picture.ndim == 2:
        return np.repeat(picture[..., None], 3, axis=2).astype(np.uint8)
    return np.ascontiguousarray(picture[..., ::-1] if message.encoding == "bgr8" else picture)


def main() -> None:
    """Entry point of ``ros2 run slam_viewer viewer``."""
    run_node(ViewerNode)
