# SPDX-License-Identifier: Apache-2.0
"""The ``feature_extractor`` node: rectified stereo pair and ToF depth in, features with depth out."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

from functools import partial

from slam_core.health import State
from slam_core.messages import (
    FEATURE_TOPICS,
    camera_info_from_message,
    depth_from_messages,
    features_messages,
    grey_and_colour_from_message,
    grey_from_message,
    header_message,
    image_message,
    mask_from_message,
    stamp_ns,
)
from slam_core.messages.base import Message
from slam_core.nodes.calibration_watch import CalibrationWatch
from slam_core.nodes.stage_node import StageNode
from slam_core.nodes.stamp_guard import StampPolicy
from slam_core.ros import run_node
from slam_core.types import ByteArray, Features
from stereo_frontend.depth.tof_features import CLIP, GAMMA, normalised_picture
from stereo_frontend.detection.annotate import annotated_image
from stereo_frontend.frontend_config import FrontendConfig
from stereo_frontend.sources import RawPair
from stereo_frontend.stage import ExtractedFrame, FeatureStage, StereoStage
from stereo_frontend.stereo.calibrated_pairs import SIDES

FEW_FEATURES = 20
"""Fewer features than this are reported as DEGRADED."""


class FeatureNode(StageNode[FrontendConfig]):
    """Publishes features, their descriptors and camera info.

    ``features/image`` is published where somebody hears it.
    """

    def __init__(self) -> None:
        super().__init__("feature_extractor", FrontendConfig)
        self.pairs = StereoStage(rectified=True)
        self.calibrations, self.depth_calibration = CalibrationWatch(), CalibrationWatch()
        self.stage: FeatureStage = FeatureStage(self.config, self.frames)
        for topic, kind in (*FEATURE_TOPICS.items(), ("features/image", "Image")):
            self.advertise(topic, kind)
        if self.config.mode != "tof":
            self._listen_to_stereo()
        if self.config.mode != "stereo":
            self._listen_to_depth()
        if self.config.mask.use != "never":
            topic = "tof/mask" if self.config.mode == "tof" else "mask"
            self.listen(topic, "Image", self._on_mask, required=False, stamps=StampPolicy.FOLLOWS)

    def on_reset(self) -> None:
        """Forget thresholds, noise and queues, and use the newest calibration."""
        self.on_new_session()
        self.depth_calibration.restart()
        for side, info in self.calibrations.restart().items():
            self.pairs.set_info(side, info)

    def on_new_session(self) -> None:
        """Forget thresholds, noise and queues; the map goes on, with its calibration."""
        self.stage.reset()
        self.pairs.reset()

    def on_finish(self) -> str:
        """Process the pairs that still wait for a depth image."""
        self.stage.finish()
        return f"{self.publish_ready()} waiting frames processed"

    # -- inputs --------------------------------------------------------------------------------------------------------

    def _listen_to_stereo(self) -> None:
        for side in SIDES:
            self.listen(f"stereo/{side}/camera_info", "CameraInfo", partial(self._on_info, side))
        self.listen_together({f"stereo/{side}/image_rect": "Image" for side in SIDES}, self._on_pair)

    def _listen_to_depth(self) -> None:
        topics = {"tof/depth/image": "Image", "tof/noise/image": "Image", "tof/camera_info": "CameraInfo"}
        picture = self._tof_picture()
        if picture:
            topics[f"tof/{picture}/image"] = "Image"
        self.listen_together(topics, self._on_depth)

    def _tof_picture(self) -> str:
        """Image that is needed beside depth, or ""; a node cannot know what there will be, so auto means amplitude.

        In modes ``replace`` and ``fuse`` the amplitude tells of errors of the range.
        """
        images = self.config.tof.images
        if images in ("intensity", "range"):
            return "intensity" if images == "intensity" and self.config.mode == "tof" else ""
        return "amplitude"

    def _on_info(self, side: str, message: Message) -> None:
        info = camera_info_from_message(message)
        if self.calibrations.hear(side, info):
            self.pairs.set_info(side, info)
        self.publish_ready()

    def _on_pair(self, left: Message, right: Message) -> None:
        self.calibrations.require_unchanged()
        grey, colour = grey_and_colour_from_message(left)
        self.pairs.add(RawPair(stamp_ns(left), grey, grey_from_message(right), left.header.frame_id, colour))
        self.publish_ready()

    def _on_depth(self, depth: Message, noise: Message, info: Message, picture: Message | None = None) -> None:
        self.depth_calibration.hear("tof", camera_info_from_message(info))
        self.depth_calibration.require_unchanged()
        pictures = {} if picture is None else {self._tof_picture(): picture}
        self.stage.add_depth(depth_from_messages(depth, noise, info, **pictures))
        self.publish_ready()

    def _on_mask(self, message: Message) -> None:
        self.stage.add_mask(mask_from_message(message))
        self.publish_ready()

    # -- outputs -------------------------------------------------------------------------------------------------------

    def publish_ready(self) -> int:
        """Publish the features of all that need not wait; returns of how many frames."""
        for images in self.pairs.ready():
            self.stage.add_images(images)
        number = 0
        for frame in self.stage.extracted():
            self._publish(self.stage.measure(frame), frame)
            number += 1
        return number

    def _publish(self, features: Features, frame: ExtractedFrame) -> None:
        for topic, message in zip(FEATURE_TOPICS, features_messages(self.types, features), strict=True):
            self.publish(topic, message)
        if self.has_listeners("features/image"):
            header = header_message(self.types, features.stamp_ns, features.frame_id)
            annotated = annotated_image(self._picture(frame), features)
            self.publish("features/image", image_message(self.types, header, annotated, "bgr8"))
        self._report(len(features))

    def _picture(self, frame: ExtractedFrame) -> ByteArray:
        if frame.images is not None:
            return frame.images.picture()
        assert frame.depth is not None
        depth = frame.depth
        grey = next((picture for picture in (depth.amplitude, depth.intensity) if picture is not None), None)
        if grey is None:
            return normalised_picture(depth.depth, CLIP, 1.0)
        return normalised_picture(grey, CLIP, GAMMA)

    def _report(self, number: int) -> None:
        report = self.stage.report()
        fallbacks = {"gpu_fallbacks": int(report.device_diagnostic != "")}
        self.health.take(self.stage.counters | self.pairs.counters | fallbacks)
        for name, value in report.rectification.items():
            self.health.show(f"rectification_{name}", value)
        for name, value in report.ranges.items():
            self.health.show(f"ranges_{name}", value)
        self.health.show("correction", report.correction.text if report.correction else "")
        self.health.show("picture", report.picture)
        self.health.show("device", report.device)
        if report.device_diagnostic:
            self.get_logger().warning(report.device_diagnostic, once=True)
        self.health.show("advice", "; ".join(report.advice))
        few = f"only {number} features" if number < FEW_FEATURES else ""
        diagnostic = few or self.stage.diagnostic
        self.health.set(State.DEGRADED if diagnostic else State.OK, diagnostic)


def main() -> None:
    """Entry point of ``ros2 run stereo_frontend feature_extractor``."""
    run_node(FeatureNode)
