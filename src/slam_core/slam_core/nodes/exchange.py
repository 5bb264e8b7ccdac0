# SPDX-License-Identifier: Apache-2.0
"""Hands messages from node to node of one process by reference: no copy, no serialisation, no transport.

A node publishes as ever; its message, which refers to the arrays it was made of, goes to the nodes of the process that
listen, and is made a message of ROS only if somebody outside listens as well.

A live node begins a frame only when somebody can go on with it: what is left out is left out by the first node, before
anything was done for it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar, NamedTuple

import numpy as np

from slam_core.messages.base import Message, MessageTypes
from slam_core.types import AnyArray


class Listener(NamedTuple):
    """Takes a topic's messages; ``awaken`` has it look at them.

    ``is_full`` tells if another frame has to wait, None where they are no frames.
    """

    take: Callable[[Message], None]
    awaken: Callable[[], None]
    is_full: Callable[[bool], bool] | None


class Exchange:
    """Publishers and listeners of this process. Nodes are made front to back, listeners after publishers."""

    current: ClassVar[Exchange | None] = None
    """The exchange of the node that is being made, see :meth:`node`; None outside a composed process."""

    def __init__(self) -> None:
        self.node_options: dict[str, Any] = {}
        """Arguments that the node that is being made hands to rclpy's."""
        self._publishers: dict[str, list[Callable[[], None]]] = defaultdict(list)
        self._listeners: dict[str, list[Listener]] = defaultdict(list)

    @contextmanager
    def node(self, arguments: Sequence[str]) -> Iterator[None]:
        """Within the block nodes join the exchange, with command-line arguments of their own."""
        self.node_options = {"cli_args": list(arguments), "use_global_arguments": False}
        Exchange.current = self
        try:
            yield
        finally:
            Exchange.current = None

    def advertise(self, topic: str, on_room: Callable[[], None]) -> None:
        """A node publishes a topic (full name); ``on_room`` is called when a listener may have room for a frame."""
        self._publishers[topic].append(on_room)

    def has_publisher(self, topic: str) -> bool:
        """True if a node of this process publishes the topic."""
        return topic in self._publishers

    def listen(self, topic: str, listener: Listener) -> None:
        """Have a listener take every message of the topic, in the thread of its publisher.

        ``is_full``, of a topic of frames, says whether another one has to wait, given whether it is made ahead.
        """
        self._listeners[topic].append(listener)

    def has_room(self, topics: Iterable[str], ahead: bool) -> bool:
        """True if somebody can use a frame on these topics, or nobody of this process listens to frames there.

        ``ahead``: it may wait for a listener that is busy, as the next one.
        """
        asked = [listener.is_full for topic in topics for listener in self._listeners.get(topic, ())]
        frames = [is_full for is_full in asked if is_full is not None]
        return not frames or not all(is_full(ahead) for is_full in frames)

    def tell_of_room(self, topic: str) -> None:
        """A listener has begun or finished a frame: whoever publishes the topic may make the next one."""
        for on_room in self._publishers.get(topic, ()):
            on_room()

    def has_listeners(self, topic: str) -> bool:
        """True if a node of this process listens."""
        return bool(self._listeners.get(topic))

    def publish(self, topic: str, message: Message) -> list[Callable[[], None]]:
        """Hand a message to the listeners of this process; returns what awakens them."""
        listeners = self._listeners.get(topic, ())
        for listener in listeners:
            listener.take(message)
        return [listener.awaken for listener in listeners]


class SharedMessage:
    """A message that keeps what it was made of; fields that were not given have the defaults of ROS."""

    __slots__ = ("_fields", "_ros", "_type")

    def __init__(self, ros: MessageTypes, type_name: str, fields: dict[str, Any]) -> None:
        object.__setattr__(self, "_ros", ros)
        object.__setattr__(self, "_type", type_name)
        object.__setattr__(self, "_fields", fields)

    def __getattr__(self, name: str) -> Any:
        fields = object.__getattribute__(self, "_fields")
        return fields[name] if name in fields else getattr(getattr(self._ros, self._type)(), name)

    def __setattr__(self, name: str, value: Any) -> None:
        self._fields[name] = value

    def to_ros(self) -> Message:
        """Message for the transport."""
        return getattr(self._ros, self._type)(**{name: self._value(value) for name, value in self._fields.items()})

    def _value(self, value: Any) -> Any:
        if isinstance(value, _Octets):
            return self._ros.octets(value) if value.dtype == np.uint8 else self._ros.signed_octets(value)
        return as_ros(value)


def as_ros(value: Any) -> Any:
    """A value with every shared message in it made one of ROS."""
    if isinstance(value, SharedMessage):
        return value.to_ros()
    return [as_ros(v) for v in value] if isinstance(value, list | tuple) else value


class _Octets(np.ndarray):
    """The bytes of an array, which it refers to."""


class SharedTypes(MessageTypes):
    """Makes messages that refer to their arrays; ``ros`` makes those for the transport."""

    def __init__(self, ros: MessageTypes) -> None:
        self._ros_types = ros

    def load(self, package: str, name: str) -> Any:
        """Factory of the messages of a type."""
        return lambda **fields: SharedMessage(self._ros_types, name, fields)

    def octets(self, array: AnyArray) -> Any:
        """The array's own memory as bytes."""
        return np.ascontiguousarray(array).reshape(-1).view(np.uint8).view(_Octets)

    def signed_octets(self, array: AnyArray) -> Any:
        """The array's own memory as signed bytes."""
        return np.ascontiguousarray(array).reshape(-1).view(np.int8).view(_Octets)
