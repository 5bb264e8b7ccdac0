"""The ``feature_extractor`` node: rectified stereo pair and ToF depth in, features with depth out."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

import dataclasses

from slam_core.base_node import SlamNode
from slam_core.geometry import FloatArray
from slam_core.health import State
from slam_core.messages import (
    FEATURE_TOPICS,
    camera_info_from_message,
    depth_from_messages,
    features_messages,
    grey_from_message,
    header_message,
    image_message,
    stamp_ns,
)
from slam_core.messages.base import Message
from slam_core.ros import run_node
from slam_core.types import ByteArray, DepthImage, Features, StereoImages
from stereo_frontend.annotate import annotated_image
from stereo_frontend.calibrated_pairs import SIDES, CalibratedPairs
from stereo_frontend.depth_pairing import DepthPairing
from stereo_frontend.frontend import Frontend, FrontendConfig
from stereo_frontend.rectify import stereo_camera_from_infos
from stereo_frontend.tof_features import normalised_picture

FEW_FEATURES = 20
"""Fewer features than this are reported as DEGRADED."""


class FeatureNode(SlamNode[FrontendConfig]):
    """Publishes ``features``, ``features/descriptors``, ``features/camera_info`` and, where heard,
    ``features/image``.
    """

    def __init__(self) -> None:
        super().__init__("feature_extractor", FrontendConfig)
        self.frontend = Frontend(self.config)
        self.calibrated = CalibratedPairs[tuple[Message, Message]]()
        self.pairing = DepthPairing(self.config.fusion.max_age)
        self.left_frame = self.tof_frame = ""
        for topic, kind in (*FEATURE_TOPICS.items(), ("features/image", "Image")):
            self.advertise(topic, kind)
        if self.config.mode != "tof":
            self._listen_to_stereo()
        if self.config.mode != "stereo":
            self._listen_to_depth()

    def on_reset(self) -> None:
        """Forget thresholds, noise and queues; the calibration stays."""
        self.frontend.reset()
        self.calibrated.clear()
        self.pairing.clear()

    def on_finish(self) -> str:
        """Process the pairs that still wait for a depth image."""
        rest = self.pairing.flush()
        for images, depth in rest:
            self._process_pair(images, depth)
        return f"{len(rest)} waiting pairs processed"

    # -- inputs --------------------------------------------------------------------------------------------------------

    def _listen_to_stereo(self) -> None:
        for side in SIDES:
            self.listen(f"stereo/{side}/camera_info", "CameraInfo", lambda m, s=side: self._on_info(s, m))
        self.listen_together({f"stereo/{side}/image_rect": "Image" for side in SIDES}, self._on_pair)

    def _listen_to_depth(self) -> None:
        topics = {"tof/depth/image": "Image", "tof/noise/image": "Image", "tof/camera_info": "CameraInfo"}
        if self.config.mode == "tof" and self.config.tof.images != "range":
            topics["tof/amplitude/image"] = "Image"
        self.listen_together(topics, self._on_depth)

    def _on_info(self, side: str, message: Message) -> None:
        self.calibrated.set_info(side, camera_info_from_message(message))
        self._release()

    def _on_pair(self, left: Message, right: Message) -> None:
        self.calibrated.add((left, right))
        self._release()

    def _release(self) -> None:
        for left, right in self.calibrated.ready():
            images = self._stereo_images(left, right)
            if self.config.mode == "stereo":
                self._process_pair(images, None)
            else:
                self._process_all(self.pairing.add_pair(images))
        self.health.counters["pairs_without_camera_info"] = self.calibrated.dropped

    def _stereo_images(self, left: Message, right: Message) -> StereoImages:
        infos = self.calibrated.infos
        assert infos is not None
        self.left_frame = left.header.frame_id
        stereo = stereo_camera_from_infos(*infos)
        pictures = grey_from_message(left), grey_from_message(right)
        expected = (stereo.camera.height, stereo.camera.width)
        for picture in pictures:
            if picture.shape != expected:
                raise ValueError(f"rectified image is {picture.shape} px but its camera info says {expected} px")
        return StereoImages(stamp_ns(left), *pictures, stereo)

    def _on_depth(self, depth: Message, noise: Message, info: Message, amplitude: Message | None = None) -> None:
        self.tof_frame = depth.header.frame_id
        image = depth_from_messages(depth, noise, info, amplitude)
        if self.config.mode == "tof":
            picture = image.depth if image.amplitude is None else image.amplitude
            features = self.frontend.process(None, image)
            self._publish(
                features, self.tof_frame, normalised_picture(picture, self.config.tof.clip, self.config.tof.gamma)
            )
        else:
            self._process_all(self.pairing.add_depth(image))

    # -- outputs -------------------------------------------------------------------------------------------------------

    def _process_all(self, pairs: list[tuple[StereoImages, DepthImage | None]]) -> None:
        for images, depth in pairs:
            self._process_pair(images, depth)

    def _process_pair(self, images: StereoImages, depth: DepthImage | None) -> None:
        T_left_tof: FloatArray | None = None if depth is None else self.lookup(self.left_frame, self.tof_frame)
        self._publish(self.frontend.process(images, depth, T_left_tof), self.left_frame, images.left)

    def _publish(self, features: Features, frame_id: str, picture: ByteArray) -> None:
        features = dataclasses.replace(features, frame_id=frame_id or features.frame_id)
        for topic, message in zip(FEATURE_TOPICS, features_messages(self.types, features), strict=True):
            self.publish(topic, message)
        if self.has_listeners("features/image"):
            header = header_message(self.types, features.stamp_ns, features.frame_id)
            self.publish(
                "features/image", image_message(self.types, header, annotated_image(picture, features), "bgr8")
            )
        self._report(len(features))

    def _report(self, number: int) -> None:
        for name, count in self.frontend.counters.counts.items():
            self.health.counters[name] = count
        few = number < FEW_FEATURES
        self.health.set(State.DEGRADED if few else State.OK, f"only {number} features" if few else "")


def main() -> None:
    """Entry point of ``ros2 run stereo_frontend feature_extractor``."""
    run_node(FeatureNode)
