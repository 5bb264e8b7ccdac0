# SPDX-License-Identifier: Apache-2.0
"""The bridge to rclpy: message classes, parameters from a :class:`Config`, quality of service, and a node's life.

The node base class is :class:`slam_core.nodes.base_node.SlamNode`.
"""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls, disable-error-code="attr-defined,union-attr,arg-type,misc"

from __future__ import annotations

import array
import importlib
import importlib.util
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, Protocol, TypeVar

import numpy as np
import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from slam_core.config import Config, ParameterInfo, changed, from_mapping, iterate_parameters
from slam_core.guarded_node import GuardedNode
from slam_core.messages import MessageTypes
from slam_core.messages.base import Message
from slam_core.messages.tf_message import tf_message_class
from slam_core.runtime.blas_threads import use_one_blas_thread
from slam_core.runtime.memory import search_less_garbage, share_one_heap
from slam_core.runtime.process_life import INTERRUPTED, end_with_parent, on_request_to_end
from slam_core.types import AnyArray

C = TypeVar("C", bound=Config)

_PROFILE_VARIABLES = {"FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"}
_SIGNAL_PERIOD_S = 0.1
"""Longest time that a node without traffic takes to notice a signal."""
_INSISTED_S = 1.0
"""A SIGINT so long after the first one, or longer, is that of somebody who does not want to wait."""
_SERVICE_PERIOD_S = 0.02
"""Period in which a node that always has work to do looks after timers and services."""
_SERVICE_CALLS = 100
"""Callbacks at a time that it looks after: messages that come faster than that would keep it from its work for ever."""


class RosTypes(MessageTypes):
    """Makes rclpy messages."""

    def load(self, package: str, name: str) -> Any:
        """The message class; without tf2_msgs, one whose messages are bytes."""
        if package == "tf2_msgs" and not has_tf2_msgs():
            return tf_message_class(self.TransformStamped)
        return getattr(importlib.import_module(f"{package}.msg"), name)

    def octets(self, values: AnyArray) -> Any:
        """``array.array('B')``: any other sequence is copied element by element by rclpy."""
        octets = array.array("B")
        octets.frombytes(memoryview(np.ascontiguousarray(values).reshape(-1).view(np.uint8)))
        return octets

    def signed_octets(self, values: AnyArray) -> Any:
        """``array.array('b')``, for the same reason."""
        return array.array("b", np.ascontiguousarray(values, dtype=np.int8).tobytes())


def declare_config(
    node: Node,
    config_type: type[C],
    prefix: str = "",
    ignore: tuple[str, ...] = (),
    changeable: tuple[str, ...] = (),
) -> C:
    """Declare every parameter of ``config_type`` and return the configuration with the values set from outside.

    The node must declare parameters from overrides automatically, so that unknown names are seen and refused. All but
    the ``changeable`` ones are read-only from then on.

    Raises
    ------
    ValueError
        For an unknown name below ``prefix``, a wrong type or a value out of range.
    """
    given = {name: _plain(p.value) for name, p in node.get_parameters_by_prefix(prefix.rstrip(".")).items()}
    foreign = ("use_sim_time", "start_type_description_service", "qos_overrides.", *ignore)
    config = from_mapping(config_type, {k: v for k, v in given.items() if prefix or not k.startswith(foreign)})
    for name, value, info in iterate_parameters(config, prefix):
        descriptor = _descriptor(name, value, info, name not in changeable)
        _declare(node, name, list(value) if isinstance(value, tuple) else value, descriptor)
    return config


def changed_config(config: C, parameters: Iterable[Parameter]) -> C:
    """The configuration with some parameters changed at run time; ValueError says why one cannot be so."""
    return changed(config, {p.name: _plain(p.value) for p in parameters})


def _declare(node: Node, name: str, value: Any, descriptor: Message) -> None:
    if node.has_parameter(name):
        node.set_parameters([Parameter(name, value=value)])
        node.set_descriptor(name, descriptor)
    else:
        node.declare_parameter(name, value, descriptor)


def _descriptor(name: str, value: Any, info: ParameterInfo, read_only: bool) -> Message:
    description = info.text() + (" (read when the node starts)" if read_only else "")
    descriptor = ParameterDescriptor(name=name, description=description, read_only=read_only, dynamic_typing=True)
    low, high = info.minimum, info.maximum
    if low is None and high is None:
        return descriptor
    if isinstance(value, float):
        largest = sys.float_info.max
        bounds = (-largest if low is None else float(low), largest if high is None else float(high))
        descriptor.floating_point_range = [FloatingPointRange(from_value=bounds[0], to_value=bounds[1], step=0.0)]
    elif isinstance(value, int) and not isinstance(value, bool):
        bounds_int = (-(2**63) if low is None else int(low), 2**63 - 1 if high is None else int(high))
        descriptor.integer_range = [IntegerRange(from_value=bounds_int[0], to_value=bounds_int[1], step=0)]
    return descriptor


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, array.array | np.ndarray) else value


def sensor_qos(depth: int, latched: bool = False, *, best_effort: bool = False) -> QoSProfile:
    """Keep the last ``depth`` messages; reliable unless ``best_effort``; transient-local if ``latched``."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def incompatibility(offered: QoSProfile, wanted: QoSProfile) -> str:
    """Reason for which a publisher's offer does not serve a subscription, or ""."""
    reasons = []
    if (offered.reliability, wanted.reliability) == (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE):
        reasons.append("offers best effort, reliable is asked for (input.reliability)")
    if (offered.durability, wanted.durability) == (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL):
        reasons.append("offers volatile, transient local is asked for")
    return " and ".join(reasons)


def has_tf2_msgs() -> bool:
    """True if tf2_msgs can be imported: it is part of every ROS installation but has no wheel on PyPI."""
    return importlib.util.find_spec("tf2_msgs") is not None


def message_class(type_name: str) -> Any:
    """The class of ``package/msg/Name``, to send and receive bytes, or None where the package is not installed."""
    package, _, name = type_name.split("/")
    try:
        return RosTypes().load(package, name)
    except (ImportError, AttributeError):
        return None


def ros_type_name(kind: Any) -> str:
    """``package/msg/Name`` of a message class."""
    return f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"


def use_fast_dds_profile(*, small_packets: bool = False) -> None:
    """Let Fast DDS carry large messages through shared memory, unless the environment says what it shall do.

    With ``small_packets`` those that go to another host are cut into packets that fit a network's: on a link that loses
    some, only these have to be sent again. In shared memory that takes ten times as long, 20 ms for an image of 1 MB.
    """
    if not _PROFILE_VARIABLES & os.environ.keys():
        name = "fastdds_small_packets.xml" if small_packets else "fastdds.xml"
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(Path(__file__).with_name(name))


class RunnableNode(Protocol):
    """Interface of a node to :func:`run_node`, beside rclpy's own."""

    def on_close(self) -> None:
        """Close what is open."""

    def destroy_node(self) -> None:
        """As rclpy's."""

    def get_logger(self) -> Any:
        """As rclpy's."""


def spin(node: RunnableNode, executor: SingleThreadedExecutor, stopped: threading.Event) -> None:
    """Receive messages and do the node's work until asked to stop.

    All that has come is received before the next job is done, so that the node itself knows what waits and what to
    leave out, not the transport.
    """
    waiting, served_s = MessageWait(node) if isinstance(node, GuardedNode) else None, 0.0
    while rclpy.ok(context=executor.context) and not stopped.is_set():
        if waiting is None or not isinstance(node, GuardedNode):
            executor.spin_once(timeout_sec=_SIGNAL_PERIOD_S)
            continue
        if not node.has_work:
            _wait(node, waiting, executor)
        elif time.monotonic() > served_s + _SERVICE_PERIOD_S:
            _serve(node, waiting, executor)
            served_s = time.monotonic()
        node.receive()
        node.work()


class MessageWait:
    """Waits for a node's messages in a quarter of an executor's time, and tells when the executor has to be asked.

    The executor collects what it waits for in Python each time, twice for a message. The set of this class is made once
    and again when the node's subscriptions, services or timers have changed, which only the node's own thread does.
    """

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._entities: list[Any] = []
        self._additions: list[tuple[Callable[[Any], int], Any]] = []
        self._others: set[int] = set()

    def wait(self, timeout_s: float) -> bool:
        """Wait until something comes; True if it is something else than messages that ``node.receive`` takes."""
        node = self._node
        entities = [*node.subscriptions, *node.guards, *node.timers, *node.services]
        if entities != self._entities:
            self._make_set()
            self._entities = entities
        self._set.clear_entities()
        for add, handle in self._additions:
            add(handle)
        for subscription in node.urgent_subscriptions:
            self._set.add_subscription(subscription.handle)
        self._set.wait(int(1e9 * timeout_s))
        ready = (p for kind in ("subscription", "timer", "service") for p in self._set.get_ready_entities(kind))
        return not self._others.isdisjoint(ready)

    def _make_set(self) -> None:
        node, make = self._node, rclpy_implementation.WaitSet
        received = node.received_subscriptions
        subscriptions = [s for s in node.subscriptions if s not in received]
        guards, timers, services = list(node.guards), list(node.timers), list(node.services)
        number = len(subscriptions) + len(received)
        self._set = make(number, len(guards), len(timers), 0, len(services), 0, node.context.handle)
        others = (
            *((self._set.add_subscription, entity.handle) for entity in subscriptions),
            *((self._set.add_timer, entity.handle) for entity in timers),
            *((self._set.add_service, entity.handle) for entity in services),
        )
        self._others = {handle.pointer for _, handle in others}
        self._additions = [*others, *((self._set.add_guard_condition, guard.handle) for guard in guards)]


def _wait(node: GuardedNode, waiting: MessageWait, executor: SingleThreadedExecutor) -> None:
    """Until something comes, from the network or from another thread."""
    node.sleeps = True
    timeout_s = 0.0 if node.has_work else _SIGNAL_PERIOD_S
    if node.needs_executor:
        executor.spin_once(timeout_sec=timeout_s)
    elif waiting.wait(timeout_s):
        executor.spin_once(timeout_sec=0.0)
    node.sleeps = False


def _serve(node: GuardedNode, waiting: MessageWait, executor: SingleThreadedExecutor) -> None:
    """Call back all that is ready: timers and services too, of which a node that has work to do hears only here."""
    if not node.needs_executor and not waiting.wait(0.0):
        return
    for _ in range(_SERVICE_CALLS):
        calls = node.calls
        executor.spin_once(timeout_sec=0.0)
        if calls == node.calls:
            return


def _ask_to_end(stopped: threading.Event, asked_s: list[float], number: int, _frame: FrameType | None) -> None:
    """Handle a signal; a terminal and ``ros2 launch`` each send one, and launch sends SIGTERM after 5 s."""
    if asked_s and number == signal.SIGINT and time.monotonic() > asked_s[0] + _INSISTED_S:
        os._exit(INTERRUPTED)
    asked_s.append(time.monotonic())
    stopped.set()


def run_node(
    node_type: Callable[[], RunnableNode], args: list[str] | None = None, *, small_packets: bool = False
) -> None:
    """Run a node until SIGINT, SIGTERM, SIGHUP or shutdown: exit code 0; a bad parameter ends it with one line and 2.

    A signal only asks for the end: rclpy's own handlers would shut the context down under a callback that still
    publishes. The message in hand is finished first. A SIGINT a second after that ends the process at once, whatever it
    waits for, with exit code 130. ``small_packets``: it speaks to other hosts (:func:`use_fast_dds_profile`).
    """
    share_one_heap()
    search_less_garbage()
    use_one_blas_thread()
    use_fast_dds_profile(small_packets=small_packets)
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    stopped = threading.Event()
    on_request_to_end(partial(_ask_to_end, stopped, []))
    executor = SingleThreadedExecutor()
    node: RunnableNode | None = None
    try:
        end_with_parent()
        node = node_type()
        executor.add_node(node)
        node.get_logger().info("ready")
        spin(node, executor, stopped)
    except ExternalShutdownException:
        pass
    except ValueError as error:
        if node is not None:
            raise
        print(f"cannot start: {error}", file=sys.stderr)
        sys.exit(2)
    except Exception:
        # A node may shut its context down itself, from another thread: what then fails is no fault.
        if rclpy.ok():
            raise
    finally:
        executor.shutdown(timeout_sec=2.0)
        if node is not None:
            node.on_close()
            node.destroy_node()
        rclpy.try_shutdown()


def below(agent: str, name: str) -> str:
    """A topic or frame below an agent's namespace."""
    return f"{agent}/{name}" if agent else name
