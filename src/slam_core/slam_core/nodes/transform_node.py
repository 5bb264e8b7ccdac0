# SPDX-License-Identifier: Apache-2.0
"""A node's transforms: static ones in and out, ``/tf`` out."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls, disable-error-code="attr-defined,union-attr,arg-type,misc"

from __future__ import annotations

from typing import Any

from slam_core.frame_tree import FrameTree
from slam_core.geometry import FloatArray
from slam_core.messages import STATIC_TRANSFORMS_TOPIC, transform_from_message
from slam_core.messages.base import Message
from slam_core.messages.tf_message import transforms_from_octets
from slam_core.nodes.exchange import as_ros
from slam_core.nodes.listening_node import LATCHED_DEPTH, ListeningNode
from slam_core.ros import RosTypes, has_tf2_msgs, sensor_qos


class TransformNode(ListeningNode):
    """Knows the static transforms in ``frames``."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._ros_types = RosTypes()
        self.frames = FrameTree()
        self._static_output: Any = None
        self._listen_to_static_transforms()
        self._tf = self._advertise_tf()

    @property
    def received_subscriptions(self) -> list[Any]:
        """Transforms first: what else has come needs them."""
        return [*self._static_inputs, *super().received_subscriptions]

    @property
    def urgent_subscriptions(self) -> list[Any]:
        """Transforms too."""
        return [*self._static_inputs, *super().urgent_subscriptions]

    def lookup(self, target: str, source: str) -> FloatArray:
        """T_target_source (4, 4) from the static transforms; ValueError, so a counted rejection, if unknown."""
        return self.frames.lookup(target, source)

    def broadcast(self, *transforms: Message) -> None:
        """Send TransformStamped messages on /tf."""
        if self._tf is not None:
            self._tf.publish(self._ros_types.TFMessage(transforms=as_ros(list(transforms))))

    def broadcast_static(self, transform: Message) -> None:
        """Send a TransformStamped message for all who come later too: on /tf_static."""
        profile, kind = sensor_qos(LATCHED_DEPTH, latched=True), self._tf_class()
        if self._static_output is None:
            topic = STATIC_TRANSFORMS_TOPIC if kind is None else "/tf_static"
            self._static_output = self.create_publisher(kind or self._ros_types.TransformStamped, topic, profile)
        sent = as_ros(transform)
        self._static_output.publish(sent if kind is None else self._ros_types.TFMessage(transforms=[sent]))

    def _reject(self, why: str, number: int = 1) -> None:
        self.health.count("rejected", number)
        self.get_logger().warning(why, throttle_duration_sec=1.0)

    def _unconnected(self) -> list[str]:
        static = [] if any(s.get_publisher_count() for s in self._static_inputs) else [STATIC_TRANSFORMS_TOPIC]
        return super()._unconnected() + static

    def _listen_to_static_transforms(self) -> None:
        profile = sensor_qos(LATCHED_DEPTH, latched=True)
        kind = self._ros_types.TransformStamped
        self._static_inputs = [
            self.create_subscription(kind, STATIC_TRANSFORMS_TOPIC, self._on_static_transform, profile)
        ]
        if (kind := self._tf_class()) is not None:
            self._static_inputs.append(
                self.create_subscription(kind, "/tf_static", self._on_tf_static, profile, raw=not has_tf2_msgs())
            )

    def _on_tf_static(self, message: Message) -> None:
        try:
            is_raw = isinstance(message, bytes)
            transforms = transforms_from_octets(self._ros_types, message) if is_raw else message.transforms
        except ValueError as error:
            self._reject(f"/tf_static: message rejected: {error}")
            return
        for transform in transforms:
            self._on_static_transform(transform)

    def _on_static_transform(self, message: Message) -> None:
        try:
            self.frames.add(*transform_from_message(message))
        except ValueError as error:
            self._reject(f"static transform rejected: {error}")

    def _advertise_tf(self) -> Any:
        kind = self._tf_class()
        return None if kind is None else self.create_publisher(kind, "/tf", sensor_qos(100))

    def _tf_class(self) -> Any:
        try:
            return self._ros_types.TFMessage
        except ImportError as error:
            self.get_logger().warning(f"{error}: transforms are published as TransformStamped topics only", once=True)
            return None
