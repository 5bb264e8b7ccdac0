"""The ``ekf_slam`` node: features in, odometry, landmarks and finished submaps out."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.results import EkfResult, TrackingState
from ekf_slam_node.slam import EkfSlam
from slam_core.base_node import SlamNode
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
    odometry_message,
    path_message,
    pose_with_covariance_message,
    stamp_ns,
    submap_messages,
    transform_message,
)
from slam_core.messages.base import Message
from slam_core.ros import run_node
from slam_core.types import Features, ImuSample, PoseEstimate, RelativeMotion, Submap

_STATES = {TrackingState.OK: State.OK, TrackingState.DEGRADED: State.DEGRADED, TrackingState.LOST: State.LOST}


@dataclass(frozen=True)
class EkfNodeConfig(EkfSlamConfig):
    """The filter's parameters and the node's own."""

    odom_frame: str = parameter("odom", "frame of the odometry")
    base_frame: str = parameter("base_link", "frame of the rig; the features' frame is looked up in it")
    path_length: int = parameter(2000, "newest poses shown in ``path``", minimum=1)
    session: int = parameter(
        -1,
        "number of the first session; -1: the second of the first frame's stamp, which no run before had",
        minimum=-1,
    )
    wait_for_motion: bool = parameter(False, "features wait until ``ndt/motion`` has reached their stamp")


class EkfNode(SlamNode[EkfNodeConfig]):
    """Publishes ``odom``, ``pose``, ``path``, ``landmarks``, ``landmark_ellipsoids`` and, as they end, ``submap/*``."""

    def __init__(self) -> None:
        super().__init__("ekf_slam", EkfNodeConfig)
        self.slam: EkfSlam | None = None
        self._next_session = self.config.session
        self._frames = deque[Features]()
        self._aids = deque[tuple[int, RelativeMotion | ImuSample]]()
        self._motion_stamp_ns = -1
        self.path = deque[PoseEstimate](maxlen=self.config.path_length)
        prefix = f"{self.config.agent}/" if self.config.agent else ""
        self.odom_frame = prefix + self.config.odom_frame
        self._advertise_outputs()
        self.listen_together(FEATURE_TOPICS, self.on_features)
        self.listen("ndt/motion", "PoseWithCovarianceStamped", self.on_motion, required=False)
        self.listen("imu", "Imu", self.on_imu, required=False)

    def _advertise_outputs(self) -> None:
        self.advertise("odom", "Odometry")
        self.advertise("pose", "PoseWithCovarianceStamped")
        self.advertise("path", "Path")
        self.advertise("landmarks", "PointCloud2")
        self.advertise("landmark_ellipsoids", "MarkerArray")
        for topic, kind in SUBMAP_TOPICS.items():
            self.advertise(topic, kind, latched=True)

    def on_features(self, cloud: Message, descriptors: Message, camera_info: Message) -> None:
        """One frame; it may have to wait for the motion that leads to it."""
        self._frames.append(features_from_messages(cloud, descriptors, camera_info))
        self._release()

    def on_motion(self, message: Message) -> None:
        """A motion measured by scan registration, or word that it is not known."""
        self._motion_stamp_ns = stamp_ns(message)
        motion = motion_from_message(message)
        if motion is not None:
            self._aids.append((self._motion_stamp_ns, motion))
        self._release()

    def on_imu(self, message: Message) -> None:
        """A reading of the IMU, turned into the axes of the rig."""
        sample = imu_from_message(message)
        R = self.lookup(self.config.base_frame, message.header.frame_id)[:3, :3]
        rate, acceleration = R @ sample.angular_velocity, R @ sample.linear_acceleration
        self._aids.append((sample.stamp_ns, ImuSample(sample.stamp_ns, rate, acceleration)))

    def on_reset(self) -> None:
        """Forget everything; the mounting is looked up anew."""
        if self.slam is not None:
            self._next_session = self.slam.session + 1
        self.slam = None
        self._forget_queues()
        self.path.clear()

    def on_new_session(self) -> None:
        """Process what waits and publish the open submap, then begin anew."""
        while self._frames:
            self._process_frame(self._frames.popleft())
        self._publish_submaps(self.slam.start_session() if self.slam is not None else ())
        self._forget_queues()
        self.path.clear()

    def on_finish(self) -> str:
        """The input has ended: process what waits and publish the open submap."""
        while self._frames:
            self._process_frame(self._frames.popleft())
        submaps = self.slam.finish() if self.slam is not None else ()
        self._publish_submaps(submaps)
        return f"{len(submaps)} open submap published"

    # -- the order of the stamps ---------------------------------------------------------------------------------------

    def _release(self) -> None:
        """Process the frames that need not wait any more."""
        while self._frames and not self._must_wait(self._frames[0]):
            self._process_frame(self._frames.popleft())

    def _must_wait(self, features: Features) -> bool:
        return self.config.wait_for_motion and self._motion_stamp_ns < features.stamp_ns

    def _forget_queues(self) -> None:
        self._frames.clear()
        self._aids.clear()
        self._motion_stamp_ns = -1

    def _process_frame(self, features: Features) -> None:
        """One frame, after all that was measured up to its stamp; the camera's mounting is looked up at the first."""
        if self.slam is None:
            self.slam = self._make_filter(features)
        while self._aids and self._aids[0][0] <= features.stamp_ns:
            self._give_aid(self.slam, self._aids.popleft()[1])
        result = self.slam.process(features)
        self._publish_result(result)
        self._publish_submaps(result.submaps)
        self.health.set(_STATES[result.state], result.reason)
        for name, count in self.slam.counters.counts.items():
            self.health.counters[name] = count

    def _make_filter(self, first: Features) -> EkfSlam:
        session = self._next_session if self._next_session >= 0 else first.stamp_ns // 1_000_000_000
        return EkfSlam(self.config, self.lookup(self.config.base_frame, first.frame_id), session)

    @staticmethod
    def _give_aid(slam: EkfSlam, aid: RelativeMotion | ImuSample) -> None:
        if isinstance(aid, RelativeMotion):
            slam.process_motion(aid)
        else:
            slam.process_imu(aid)

    # -- outputs -------------------------------------------------------------------------------------------------------

    def _publish_result(self, result: EkfResult) -> None:
        pose, types = result.pose, self.types
        self.path.append(pose)
        self.publish("odom", odometry_message(types, self.odom_frame, self.config.base_frame, pose))
        self.publish("pose", pose_with_covariance_message(types, self.odom_frame, pose))
        self.broadcast(transform_message(types, pose.stamp_ns, self.odom_frame, self.config.base_frame, pose.T))
        if self.has_listeners("path"):
            self.publish("path", path_message(types, pose.stamp_ns, self.odom_frame, self.path))
        self._publish_landmarks(result)

    def _publish_landmarks(self, result: EkfResult) -> None:
        header, view = header_message(self.types, result.stamp_ns, self.odom_frame), result.landmarks
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
    run_node(EkfNode)
