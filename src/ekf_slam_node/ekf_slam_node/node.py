# SPDX-License-Identifier: Apache-2.0
"""The ``ekf_slam`` node: features in, odometry, landmarks and finished submaps out."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import partial

from ekf_slam_node.results import EkfResult, LandmarkView, TrackingState
from ekf_slam_node.stage import FilterConfig, FilterStage
from slam_core.config import parameter
from slam_core.health import State
from slam_core.messages import (
    FEATURE_TOPICS,
    SUBMAP_TOPICS,
    ellipsoid_markers,
    features_from_messages,
    header_message,
    imu_from_message,
    landmark_cloud,
    motion_from_message,
    odometry_from_message,
    odometry_message,
    path_message,
    pressure_from_message,
    stamp_ns,
    submap_messages,
    transform_message,
)
from slam_core.messages.base import Message
from slam_core.nodes.stage_node import StageNode
from slam_core.ros import below, run_node
from slam_core.types import PoseEstimate, Submap

_SUBMAPS_KEPT = 200
"""For a joiner that comes late or was cut off; each takes about a megabyte."""

_STATES = {TrackingState.OK: State.OK, TrackingState.DEGRADED: State.DEGRADED, TrackingState.LOST: State.LOST}


@dataclass(frozen=True)
class EkfNodeConfig(FilterConfig):
    """The filter's parameters and the node's own."""

    odom_frame: str = parameter("odom", "frame of the odometry")
    base_frame: str = parameter("base_link", "frame of the rig; the features' frame is looked up in it")
    path_length: int = parameter(2000, "newest poses shown in ``path``", minimum=1)
    session: int = parameter(
        -1,
        "number of the first session; -1: the second of the first frame's stamp, which no run before had",
        minimum=-1,
    )


class EkfNode(StageNode[EkfNodeConfig]):
    """Publishes ``odom``, ``path``, ``landmarks``, ``landmark_ellipsoids`` and, as they end, ``submap/*``."""

    CHANGEABLE = ("path_length",)

    def __init__(self) -> None:
        super().__init__("ekf_slam", EkfNodeConfig)
        self.stage: FilterStage = FilterStage(self.config, self.frames, self.config.base_frame, self.config.session)
        self.path = deque[PoseEstimate](maxlen=self.config.path_length)
        prefix = f"{self.config.agent}/" if self.config.agent else ""
        self.odom_frame = prefix + self.config.odom_frame
        self._advertise_outputs()
        for camera in self.config.cameras or ("",):
            topics = {below(camera, topic): kind for topic, kind in FEATURE_TOPICS.items()}
            self.listen_together(topics, partial(self.on_features, camera))
        self.listen("ndt/motion", "PoseWithCovarianceStamped", self.on_motion, required=False)
        self.listen("imu", "Imu", self.on_imu, required=False)
        self.listen("odometry", "Odometry", self.on_odometry, required=False)
        self.listen("pressure", "FluidPressure", self.on_pressure, required=False)

    def _advertise_outputs(self) -> None:
        self.advertise("odom", "Odometry")
        self.advertise("path", "Path")
        self.advertise("landmarks", "PointCloud2")
        self.advertise("landmark_ellipsoids", "MarkerArray")
        for topic, kind in SUBMAP_TOPICS.items():
            self.advertise(topic, kind, latched=True, depth=_SUBMAPS_KEPT)

    def on_features(self, camera: str, cloud: Message, descriptors: Message, camera_info: Message) -> None:
        """One frame, of one camera; it may have to wait for the motion that leads to it, and for other cameras."""
        self.stage.add_features(features_from_messages(cloud, descriptors, camera_info), camera)
        self.publish_ready()

    def on_motion(self, message: Message) -> None:
        """A motion measured by scan registration, or word that it is not known."""
        self.stage.add_motion(stamp_ns(message), motion_from_message(message))
        self.publish_ready()

    def on_imu(self, message: Message) -> None:
        """A reading of the IMU."""
        self.stage.add_imu(imu_from_message(message))
        self.publish_ready()

    def on_odometry(self, message: Message) -> None:
        """A pose of wheels, legs or another estimator."""
        self.stage.add_odometry(odometry_from_message(message))
        self.publish_ready()

    def on_pressure(self, message: Message) -> None:
        """A pressure of the air."""
        self.stage.add_pressure(pressure_from_message(message))
        self.publish_ready()

    def on_config(self, config: EkfNodeConfig) -> None:
        """The path may become longer or shorter."""
        self.path = deque(self.path, maxlen=config.path_length)

    def on_reset(self) -> None:
        """Forget everything; the mounting is looked up anew."""
        self.stage.reset()
        self.path.clear()

    def on_new_session(self) -> None:
        """Process what waits and publish the open submap, then begin anew."""
        self.stage.give_up()
        self.publish_ready()
        self._publish_submaps(self.stage.start_session())
        self.path.clear()

    def on_finish(self) -> str:
        """The input has ended: process what waits and publish the open submap."""
        self.stage.give_up()
        self.publish_ready()
        submaps = self.stage.finish()
        self._publish_submaps(submaps)
        return f"{len(submaps)} open submap published"

    # -- outputs -------------------------------------------------------------------------------------------------------

    def publish_ready(self) -> None:
        """Publish the results of all frames that need not wait."""
        for frame in self.stage.ready():
            result = frame.estimate
            self._publish_result(result)
            self._publish_submaps(result.submaps)
            self.health.set(_STATES[result.state], result.reason)
            self.health.take(self.stage.counters.counts)
            self.health.show("rolling_shutter", self.stage.shutter_finding or "none seen")
            self.health.show("imu_clock", self.stage.clock_finding or "as the images'")
            self.health.show("odometry", self.stage.odometry_finding or "none heard")
            self.health.show("lift_rides", self.stage.rides_finding or "none")
            self.health.show("lift_rides_ns", " ".join(f"{a}-{b}" for a, b in self.stage.ride_spans))
            self.health.show("moving_objects", self.stage.moving_objects or "none seen")

    def _publish_result(self, result: EkfResult) -> None:
        pose, types, twist = result.pose, self.types, (result.twist, result.twist_covariance)
        self.path.append(pose)
        self.publish("odom", odometry_message(types, self.odom_frame, self.config.base_frame, pose, twist))
        self.broadcast(transform_message(types, pose.stamp_ns, self.odom_frame, self.config.base_frame, pose.T))
        if self.has_listeners("path"):
            self.publish("path", path_message(types, pose.stamp_ns, self.odom_frame, self.path))
        if self.has_listeners("landmarks") or self.has_listeners("landmark_ellipsoids"):
            self._publish_landmarks(result.stamp_ns, self.stage.landmark_view())

    def _publish_landmarks(self, stamp_ns: int, view: LandmarkView) -> None:
        header = header_message(self.types, stamp_ns, self.odom_frame)
        if self.has_listeners("landmarks"):
            cloud = landmark_cloud(self.types, header, view.positions, view.covariances, view.ids, view.sightings)
            self.publish("landmarks", cloud)
        if self.has_listeners("landmark_ellipsoids"):
            markers = ellipsoid_markers(self.types, header, view.positions, view.covariances, view.ids)
            self.publish("landmark_ellipsoids", markers)

    def _publish_submaps(self, submaps: tuple[Submap, ...]) -> None:
        for submap in submaps:
            messages = submap_messages(self.types, submap, compact=self.config.submap.compact)
            for topic, message in zip(SUBMAP_TOPICS, messages, strict=True):
                self.publish(topic, message)


def main() -> None:
    """Entry point of ``ros2 run ekf_slam_node ekf_slam``."""
    run_node(EkfNode, small_packets=True)
