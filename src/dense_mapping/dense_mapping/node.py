# SPDX-License-Identifier: Apache-2.0
"""The ``dense_mapper`` node: depth and stereo images and the joined trajectory in, dense model and floor plan out."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from rclpy.clock import Clock, ClockType  # type: ignore[attr-defined]
from std_srvs.srv import Trigger

from dense_mapping.colours import NO_PICTURE
from dense_mapping.dense_model import DenseConfig
from dense_mapping.dense_stage import DenseStage, cameras_of
from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.plans.plan_io import plan_names, write_plan
from dense_mapping.plans.storeys import CurrentStorey
from dense_mapping.reconstruction.surface_cloud import cloud_of
from dense_mapping.reconstruction.surface_io import write_mesh
from slam_core.config import parameter
from slam_core.health import State
from slam_core.messages import (
    camera_info_from_message,
    cloud_message,
    colour_from_message,
    depth_from_messages,
    grey_and_colour_from_message,
    grey_from_message,
    header_message,
    imu_from_message,
    mask_from_message,
    occupancy_message,
    path_from_message,
    pose_from_message,
    stamp_ns,
)
from slam_core.messages.base import Message
from slam_core.messages.key_frames import KEY_FRAME_TOPICS, key_frame_from_messages
from slam_core.nodes.base_node import SlamNode
from slam_core.nodes.stamp_guard import StampPolicy
from slam_core.ros import below, run_node, sensor_qos
from slam_core.trajectory import Trajectory
from slam_core.types import PoseEstimate
from stereo_frontend.sources import RawPair
from stereo_frontend.stage import StereoStage
from stereo_frontend.stereo.calibrated_pairs import SIDES
from stereo_frontend.stereo.rectification_error import RectificationError

_PUBLISH_PERIOD_S = 5.0
"""Least time from one model published to the next."""


@dataclass(frozen=True)
class DenseNodeConfig(DenseConfig):
    """The dense model's parameters and the node's own."""

    agents: tuple[str, ...] = parameter(("",), "namespaces of the agents whose cameras make the model")
    cameras: tuple[str, ...] = parameter(
        (),
        "names of the cameras of each agent's rig that has several, each with its own topics, or of one agent's: "
        "agent/camera; empty: one camera",
    )
    map_frame: str = parameter("map", "frame of the map")
    base_frame: str = parameter("base_link", "frame of each agent's rig, below its namespace")
    output_path: str = parameter("dense", "folder that ~/save writes: mesh.ply, floor_plan*.yaml and .pgm")


class DenseMapperNode(SlamNode[DenseNodeConfig]):
    """Publishes ``map/dense_cloud`` and ``map/occupancy`` (lowest storey; then ``map/occupancy_1`` ...), latched.

    Of each agent, as it changes: ``storey``, the number of its storey, and ``storey/occupancy``, the plan of that.
    """

    def __init__(self) -> None:
        super().__init__("dense_mapper", DenseNodeConfig)
        self.mapper = DenseStage(self.config)
        # Each camera is to the model what an agent with one camera is, on the path of its rig.
        self._cameras = {a: cameras_of(a, self.config.cameras) for a in self.config.agents}
        self._bases = {
            camera: below(agent, self.config.base_frame) for agent, own in self._cameras.items() for camera in own
        }
        self._pairs = {camera: StereoStage(rectified=True) for own in self._cameras.values() for camera in own}
        self._corrections: dict[str, str] = {}
        self._stamp_ns = 0
        self._is_news = False
        self.advertise("map/dense_cloud", "PointCloud2", latched=True, depth=1)
        self._storeys = 0
        self._advertise_storeys(1)
        self._plans: tuple[FloorPlan, ...] = ()
        self._current = {agent: CurrentStorey() for agent in self.config.agents}
        for agent in self.config.agents:
            self.advertise(below(agent, "storey"), "Int32", latched=True, depth=1)
            self.advertise(below(agent, "storey/occupancy"), "OccupancyGrid", latched=True, depth=1)
        if self.config.use_stereo:
            # Diagnostics are stamped by the clock on the wall, a replay's messages by that of the recording.
            self.create_subscription(self.types.DiagnosticArray, "/diagnostics", self._on_diagnostics, sensor_qos(100))
        for agent in self.config.agents:
            self._listen_to(agent)
            for camera in self._cameras[agent]:
                self._listen_to_camera(agent, camera)
        self.create_service(Trigger, "~/save", self._on_save)
        self.create_timer(_PUBLISH_PERIOD_S, self._publish_news, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_reset(self) -> None:
        """Forget the model."""
        self.mapper.reset()
        self._plans = ()
        self._current = {agent: CurrentStorey() for agent in self.config.agents}
        self._is_news = False

    def on_new_session(self) -> None:
        """Keep the model; what waits for a pose of the old time will get none."""
        self.mapper.begin_session()

    def on_finish(self) -> str:
        """Move and publish everything now."""
        self._publish_model()
        return f"{len(self.mapper.model.keyframes)} key frames in the model, {self.mapper.waiting} without a pose"

    # -- inputs --------------------------------------------------------------------------------------------------------

    def _listen_to(self, agent: str) -> None:
        own, listen = partial(below, agent), partial(self.listen, clock=agent)
        listen(own("odom"), "Odometry", partial(self._on_odometry, agent))
        listen(own("map/path"), "Path", partial(self._on_path, agent), latched=True, stamps=StampPolicy.ANY)
        listen(own("pose"), "PoseWithCovarianceStamped", partial(self._on_pose, agent), required=False)
        listen(own("imu"), "Imu", partial(self._on_imu, agent), required=False)
        radio = {own(topic): kind for topic, kind in KEY_FRAME_TOPICS.items()}
        on_radio = partial(self._on_key_frame, agent)
        self.listen_together(radio, on_radio, clock=agent, latched=True, required=False, stamps=StampPolicy.ANY)

    def _listen_to_camera(self, agent: str, camera: str) -> None:
        own = partial(below, camera)
        listen, listen_together = partial(self.listen, clock=agent), partial(self.listen_together, clock=agent)
        if self.config.use_tof:
            topics = {"tof/depth/image": "Image", "tof/noise/image": "Image", "tof/camera_info": "CameraInfo"}
            topics = {own(topic): kind for topic, kind in topics.items()}
            listen_together(topics, partial(self._on_depth, camera), required=False)
            listen(own("tof/color/image"), "Image", partial(self._on_colour, camera, "tof"), required=False)
            masks = partial(self._on_mask, camera, "tof")
            listen(own("tof/mask"), "Image", masks, required=False, stamps=StampPolicy.FOLLOWS)
        if self.config.use_stereo:
            for side in SIDES:
                topic = own(f"stereo/{side}/camera_info")
                listen(topic, "CameraInfo", partial(self._on_info, camera, side), required=False)
            pairs = {own(f"stereo/{side}/image_rect"): "Image" for side in SIDES}
            listen_together(pairs, partial(self._on_pair, camera), required=False)
            masks = partial(self._on_mask, camera, "stereo")
            listen(own("mask"), "Image", masks, required=False, stamps=StampPolicy.FOLLOWS)
            colours = own("stereo/left/image_rect_color")
            listen(colours, "Image", partial(self._on_colour, camera, "stereo"), required=False)

    def _on_odometry(self, agent: str, message: Message) -> None:
        for camera in self._cameras[agent]:
            self.mapper.add_odometry(camera, pose_from_message(message.pose.pose))

    def _on_pose(self, agent: str, message: Message) -> None:
        if self._current[agent].update(self._plans, pose_from_message(message.pose.pose)[:3, 3]):
            self._publish_storey(agent)

    def _on_depth(self, camera: str, depth: Message, noise: Message, info: Message) -> None:
        T_base_camera = self.lookup(self._bases[camera], depth.header.frame_id)
        if self.mapper.wants(camera, "tof", stamp_ns(depth), T_base_camera):
            self.mapper.add(camera, "tof", T_base_camera, depth_from_messages(depth, noise, info), NO_PICTURE)

    def _on_key_frame(self, agent: str, *messages: Message) -> None:
        """Take a key frame that a post has asked for over the radio."""
        if self.mapper.add_anchored(self._cameras[agent][0], key_frame_from_messages(*messages)):
            self._is_news = True

    def _on_colour(self, camera: str, sensor: str, message: Message) -> None:
        self.mapper.add_colour(camera, sensor, stamp_ns(message), colour_from_message(message))

    def _on_mask(self, camera: str, sensor: str, message: Message) -> None:
        self.mapper.add_mask(camera, sensor, mask_from_message(message))

    def _on_info(self, camera: str, side: str, message: Message) -> None:
        self._pairs[camera].set_info(side, camera_info_from_message(message))

    def _on_pair(self, camera: str, left: Message, right: Message) -> None:
        T_base_camera = self.lookup(self._bases[camera], left.header.frame_id)
        grey, colour = grey_and_colour_from_message(left)
        pair = RawPair(stamp_ns(left), grey, grey_from_message(right), left.header.frame_id, colour)
        self.mapper.add_pair(camera, T_base_camera, pair, self._pairs[camera])

    def _on_imu(self, agent: str, message: Message) -> None:
        sample = imu_from_message(message)
        R_base_imu = self.lookup(below(agent, self.config.base_frame), sample.frame_id)[:3, :3]
        self.mapper.add_force(self._cameras[agent][0], sample.stamp_ns, R_base_imu @ sample.linear_acceleration)

    def _on_diagnostics(self, message: Message) -> None:
        """Rectify as the front end has found out that one should."""
        for status in message.status:
            for camera, stage in self._pairs.items():
                if status.name != f"/{below(camera, 'feature_extractor')}" or stage.infos is None:
                    continue
                text = next((entry.value for entry in status.values if entry.key == "correction"), "")
                if text != self._corrections.get(camera, ""):
                    self._corrections[camera] = text
                    stage.correct(RectificationError.from_text(stage.infos[0].rectified, text))

    def _on_path(self, agent: str, message: Message) -> None:
        self._stamp_ns = max(self._stamp_ns, stamp_ns(message))
        poses = [PoseEstimate(stamp, T, np.zeros((6, 6))) for stamp, T in path_from_message(message)]
        path = Trajectory.from_estimates(poses)
        if any([self.mapper.set_path(camera, path) for camera in self._cameras[agent]]):
            self._is_news = True
        self.health.take(
            {
                "key frames": len(self.mapper.model.keyframes),
                "waiting for a pose": self.mapper.waiting,
                "dropped without a pose": self.mapper.dropped,
                "masks of another size": self.mapper.refused_masks,
                "key frames moved": self.mapper.model.moved,
                "blocks refused": self.mapper.model.volume.refused_blocks,
            }
        )
        full = self.mapper.model.volume.refused_blocks > 0
        self.health.set(State.DEGRADED if full else State.OK, "the grid is full (tsdf.max_blocks)" if full else "")

    # -- outputs -------------------------------------------------------------------------------------------------------

    def _publish_news(self) -> None:
        if self._is_news:
            self._publish_model()

    def _publish_model(self) -> None:
        self._is_news = False
        surface = self.mapper.surface()
        header = header_message(self.types, self._stamp_ns, self.config.map_frame)
        self.publish("map/dense_cloud", cloud_message(self.types, header, cloud_of(surface)))
        plans = self.mapper.floor_plans(surface)
        self._advertise_storeys(len(plans))
        for number, plan in enumerate(plans):
            self._publish_plan(_storey_topic(number), plan)
        self._plans = plans
        for agent, current in self._current.items():
            if current.number is not None:
                self._publish_storey(agent)

    def _publish_plan(self, topic: str, plan: FloorPlan) -> None:
        header = header_message(self.types, self._stamp_ns, self.config.map_frame)
        self.publish(topic, occupancy_message(self.types, header, plan.cells, plan.resolution, plan.T_map_plan))

    def _publish_storey(self, agent: str) -> None:
        """Publish the storey that an agent is on, and its plan; nothing where there are fewer plans by now."""
        number = self._current[agent].number
        if number is not None and number < len(self._plans):
            self.publish(below(agent, "storey"), self.types.Int32(data=number))
            self._publish_plan(below(agent, "storey/occupancy"), self._plans[number])

    def _advertise_storeys(self, count: int) -> None:
        for number in range(self._storeys, count):
            self.advertise(_storey_topic(number), "OccupancyGrid", latched=True, depth=1)
        self._storeys = max(self._storeys, count)

    def _on_save(self, _: object, response: Message) -> Message:
        folder, surface = Path(self.config.output_path), self.mapper.surface()
        try:
            write_mesh(folder / "mesh.ply", surface)
            plans = self.mapper.floor_plans(surface)
            for name, plan in zip(plan_names(len(plans)), plans, strict=True):
                write_plan(folder / name, plan)
            response.success, response.message = True, f"{len(surface)} points, {len(plans)} storeys in {folder}"
        except (ValueError, OSError) as error:
            response.success, response.message = False, str(error)
        return response


def _storey_topic(number: int) -> str:
    return f"map/occupancy_{number}" if number else "map/occupancy"


def main() -> None:
    """Entry point of ``ros2 run dense_mapping dense_mapper``."""
    run_node(DenseMapperNode)
