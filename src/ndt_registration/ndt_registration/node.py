# SPDX-License-Identifier: Apache-2.0
"""The ``ndt_odometry`` node.

Point clouds or laser scans of one sensor, and an IMU where there is one, in, the rig's odometry and motions out.
"""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from ndt_registration.clouds.cloud import finite_points
from ndt_registration.odometry import OdometryConfig, OdometryResult, OdometryStatus
from ndt_registration.stage import Scan, ScanOdometryStage
from slam_core.config import parameter
from slam_core.geometry import FloatArray
from slam_core.health import State
from slam_core.messages import (
    header_message,
    imu_from_message,
    motion_message,
    odometry_message,
    path_message,
    points_from_message,
    points_from_scan,
    points_message,
    stamp_ns,
)
from slam_core.messages.base import Message
from slam_core.motion import mean_twist
from slam_core.nodes.stage_node import StageNode
from slam_core.ros import below, run_node
from slam_core.types import AnyArray, PoseEstimate, RelativeMotion


@dataclass(frozen=True)
class NdtNodeConfig(OdometryConfig):
    """Scan odometry's parameters and the node's own."""

    odom_frame: str = parameter("odom", "frame of the odometry")
    base_frame: str = parameter("base_link", "frame of the rig; the cloud's frame is looked up in it")
    cameras: tuple[str, ...] = parameter(
        (),
        "names of the depth cameras of a rig that has several, each with its own topics below its name "
        "(``front/tof/points``); empty: one camera or laser",
    )
    path_length: int = parameter(2000, "newest poses shown in ``ndt/path``", minimum=1)


class NdtNode(StageNode[NdtNodeConfig]):
    """Publishes ``ndt/odometry``, ``ndt/motion`` (one for every scan, unknown ones too) and pictures of both."""

    def __init__(self) -> None:
        super().__init__("ndt_odometry", NdtNodeConfig)
        self.stage: ScanOdometryStage = ScanOdometryStage(
            self.config, self.frames, self.config.base_frame, self.config.cameras
        )
        self.source = ""
        self.path = deque[PoseEstimate](maxlen=self.config.path_length)
        self.advertise("ndt/odometry", "Odometry")
        self.advertise("ndt/motion", "PoseWithCovarianceStamped")
        self.advertise("ndt/path", "Path")
        self.advertise("ndt/points_aligned", "PointCloud2")
        for camera in self.config.cameras:
            self.listen(below(camera, "tof/points"), "PointCloud2", partial(self.on_points_of, camera))
        if not self.config.cameras:
            self.listen("tof/points", "PointCloud2", self.on_points)
            self.listen("scan", "LaserScan", self.on_laser_scan, required=False)
        self.listen("imu", "Imu", self.on_imu, required=False)

    def on_points(self, cloud: Message) -> None:
        """A scan in space."""
        self._add("tof/points", cloud, points_from_message)

    def on_points_of(self, camera: str, cloud: Message) -> None:
        """A scan of one of several cameras."""
        self.stage.add_scan(Scan(stamp_ns(cloud), points_from_message(cloud), cloud.header.frame_id), camera)
        self.publish_ready()

    def on_laser_scan(self, message: Message) -> None:
        """A scan in the plane of a laser scanner, on a rig that stays level."""
        self._add("scan", message, points_from_scan)
        self.do_without("tof/points")

    def _add(self, source: str, message: Message, points_of: Callable[[Message], AnyArray]) -> None:
        """Take a scan of the sensor that was heard first.

        Raises
        ------
        ValueError
            For those of another one, whose map would be another one too.
        """
        if self.source not in ("", source):
            raise ValueError(f"scans of {self.source} are registered already: remap the topic that is not wanted")
        self.stage.add_scan(Scan(stamp_ns(message), points_of(message), message.header.frame_id))
        self.source = source
        self.publish_ready()

    def on_imu(self, message: Message) -> None:
        """A reading of the IMU."""
        self.stage.add_imu(imu_from_message(message))
        self.publish_ready()

    def on_reset(self) -> None:
        """Forget everything: the next scan is the origin."""
        self.stage.reset()
        self.source = ""
        self.path.clear()

    def on_finish(self) -> str:
        """Register the scans that still wait for the IMU."""
        self.stage.finish()
        self.publish_ready()
        return "all scans registered"

    def publish_ready(self) -> None:
        """Publish the poses of all scans that need not wait."""
        for estimate in self.stage.ready():
            self._publish(estimate.pose, estimate.motion)
            if self.has_listeners("ndt/points_aligned"):
                points = finite_points(estimate.scan.points)
                self._publish_aligned(points, estimate.T_odom_sensor, estimate.pose.stamp_ns)
            self._report(estimate.result)

    def _publish(self, pose: PoseEstimate, motion: RelativeMotion | None) -> None:
        odom, base = self.config.odom_frame, self.config.base_frame
        self.path.append(pose)
        self.publish("ndt/motion", motion_message(self.types, base, pose.stamp_ns, motion))
        twist = None if motion is None else mean_twist(motion)
        self.publish("ndt/odometry", odometry_message(self.types, odom, base, pose, twist))
        if self.has_listeners("ndt/path"):
            self.publish("ndt/path", path_message(self.types, pose.stamp_ns, odom, self.path))

    def _publish_aligned(self, points: FloatArray, T_odom_sensor: FloatArray, stamp: int) -> None:
        aligned = points @ T_odom_sensor[:3, :3].T + T_odom_sensor[:3, 3]
        header = header_message(self.types, stamp, self.config.odom_frame)
        self.publish("ndt/points_aligned", points_message(self.types, header, aligned))

    def _report(self, result: OdometryResult) -> None:
        self.health.take(self.stage.counters.counts)
        self._show(result)
        degraded = result.status is OdometryStatus.FAILED or self.stage.diagnostic
        self.health.set(State.DEGRADED if degraded else State.OK, result.reason)

    def _show(self, result: OdometryResult) -> None:
        """Show the newest registration in ``/diagnostics``."""
        registration = result.registration
        if registration is None:
            return
        self.health.show("iterations", registration.iterations)
        self.health.show("nearest_voxel_likelihood", f"{registration.score:.3f}")
        self.health.show("transform_probability", f"{registration.score * registration.overlap:.3f}")
        self.health.show("overlap", f"{registration.overlap:.3f}")
        self.health.show("inlier_rmse_m", f"{registration.inlier_rmse:.4f}")
        self.health.show("not_determined", "; ".join(registration.degenerate) or "none")


def main() -> None:
    """Entry point of ``ros2 run ndt_registration ndt_odometry``."""
    run_node(NdtNode)
