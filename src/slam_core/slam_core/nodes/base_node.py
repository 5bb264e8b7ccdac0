# SPDX-License-Identifier: Apache-2.0
"""Base of every node: typed parameters, guarded inputs, diagnostics, watchdog, reset and pause, and a clean end.

    class NdtNode(SlamNode[NdtNodeConfig]):
        def __init__(self) -> None:
            super().__init__("ndt_odometry", NdtNodeConfig)
            self.odometry = ScanOdometry(self.config.odometry)
            self.advertise("ndt/odometry", "Odometry")
            self.listen("tof/points", "PointCloud2", self.on_points)

        def on_points(self, cloud: Message) -> None:
            result = self.odometry.process(stamp_ns(cloud), points_from_message(cloud))
            self.publish("ndt/odometry", odometry_message(self.types, "odom", "base_link", result.pose))

    def main() -> None:
        run_node(NdtNode)  # of slam_core.ros

A callback that raises ``ValueError`` rejects its message: logged, counted, never the end of the node. Header stamps are
the only time. An odd stamp is rejected; where the clock of the inputs has jumped back for good a new session begins
(:mod:`slam_core.nodes.stamp_guard`). Whatever a node has finished is announced on ``/progress`` (Header: stamp, node
name), which is what lets a player wait for it instead of losing messages.
"""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls, disable-error-code="attr-defined,union-attr,arg-type,misc"

from __future__ import annotations

import time
import traceback
from collections import defaultdict
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from typing import Any, ClassVar, Generic, TypeVar

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from std_srvs.srv import SetBool, Trigger

from slam_core.config import Config
from slam_core.health import State
from slam_core.messages import MessageTypes, header_message, stamp_ns
from slam_core.messages.base import Message
from slam_core.nodes.exchange import SharedTypes, as_ros
from slam_core.nodes.job_queue import QueuedCall
from slam_core.nodes.listening_node import LATCHED_DEPTH, Input
from slam_core.nodes.stamp_guard import StampDecision, StampGuard, StampPolicy
from slam_core.nodes.synchronizer import StampSynchronizer
from slam_core.nodes.transform_node import TransformNode
from slam_core.ros import changed_config, declare_config, sensor_qos

C = TypeVar("C", bound=Config)

_POLICIES = dict.fromkeys(("CameraInfo", "PointStamped"), StampPolicy.ANY)
_POLICIES |= dict.fromkeys(("Imu", "PoseWithCovarianceStamped", "Odometry", "FluidPressure"), StampPolicy.FOLLOWS)
"""Types whose messages accompany frames: having processed one says nothing of the frame of its stamp."""

PROGRESS_TOPIC = "/progress"
_CONNECTION_PERIOD_S = 0.2


class SlamNode(TransformNode, Generic[C]):
    """Base of all nodes, see the example above. ``config`` is the checked configuration, ``types`` makes messages."""

    CHANGEABLE: ClassVar[tuple[str, ...]] = ()
    """Parameters that may change while the node runs."""

    def __init__(self, name: str, config_type: type[C]) -> None:
        super().__init__(name)
        self.config: C = declare_config(self, config_type, ignore=("input.",), changeable=self.CHANGEABLE)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self.types: MessageTypes = self._ros_types if self._exchange is None else SharedTypes(self._ros_types)
        self._stamps = defaultdict[str, StampGuard[Message]](StampGuard)
        self._synchronizers: list[StampSynchronizer[Message]] = []
        self._outputs: dict[str, Any] = {}
        self._latched: set[str] = set()
        self._alone: set[str] = set()
        self._silence_text = ""
        self._skipped = 0
        self._held_back = False
        self._input_stamp_ns = 0
        self._reported_state = State.OK
        self._progress = self.create_publisher(
            self._ros_types.Header, PROGRESS_TOPIC, sensor_qos(self.input_config.depth)
        )
        self._diagnostics = self.create_publisher(self._ros_types.DiagnosticArray, "/diagnostics", sensor_qos(100))
        self.create_service(Trigger, "~/reset", self._on_reset_service)
        self.create_service(SetBool, "~/pause", self._on_pause_service)
        self.create_service(Trigger, "~/finish", self._on_finish_service)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._reported_unconnected: list[str] | None = None
        self.create_timer(1.0, self._tick, clock=steady)
        self._connection_timer = self.create_timer(_CONNECTION_PERIOD_S, self._report_connections, clock=steady)

    # -- for the nodes -------------------------------------------------------------------------------------------------

    def listen(
        self,
        topic: str,
        type_name: str,
        callback: Callable[[Message], None],
        *,
        latched: bool = False,
        required: bool = True,
        stamps: StampPolicy | None = None,
        clock: str = "",
    ) -> None:
        """Subscribe. The silence of ``required`` inputs is reported. ``type_name`` as in MESSAGE_PACKAGES.

        ``stamps`` says whether the topic's stamps must run in order, by default by its type; ``clock`` whose they are,
        where a node hears rigs whose clocks need not agree.
        """
        policy = stamps or _POLICIES.get(type_name, StampPolicy.FRAMES)
        announce = policy is StampPolicy.FRAMES

        def handle(stamp: int, message: Message) -> None:
            self._enqueue(topic, stamp, callback, message, announce=announce, keep=latched)

        self._add_input(topic, topic, type_name, handle, latched, required, policy, clock)

    def listen_together(
        self,
        topics: Mapping[str, str],
        callback: Callable[..., None],
        *,
        latched: bool = False,
        required: bool = True,
        stamps: StampPolicy = StampPolicy.FRAMES,
        clock: str = "",
    ) -> None:
        """Subscribe to several topics (topic: type); ``callback`` gets the messages of one stamp in that order."""
        names, source = list(topics), " + ".join(topics)

        def on_set(stamp: int, messages: tuple[Message, ...]) -> None:
            self._enqueue(source, stamp, callback, *messages, keep=latched)

        tolerance_ns = round(self.input_config.pairing_tolerance_s * 1e9)
        infos = [topic for topic, kind in topics.items() if kind == "CameraInfo"]
        depth = self.input_config.depth
        pairs = StampSynchronizer[Message](names, on_set, tolerance_ns=tolerance_ns, depth=depth, companions=infos)
        self._synchronizers.append(pairs)
        for topic, type_name in topics.items():
            add = partial(pairs.add, topic)
            self._add_input(source, topic, type_name, add, latched, required, stamps, clock)

    def advertise(
        self, topic: str, type_name: str, *, latched: bool = False, depth: int | None = None, alone: bool = False
    ) -> None:
        """Offer a topic: reliable; ``latched`` ones (maps) keep what they sent for those who come later.

        ``alone``: another publisher of the same topic is reported, since those who listen could not tell them apart.
        """
        depth = depth or (LATCHED_DEPTH if latched else self.input_config.depth)
        kind = getattr(self._ros_types, type_name)
        self._outputs[topic] = self.create_publisher(kind, topic, sensor_qos(depth, latched))
        self._latched |= {topic} if latched else set()
        self._alone |= {topic} if alone else set()
        self._offer(self.resolve_topic_name(topic))

    def publish(self, topic: str, message: Message) -> None:
        """Send on an advertised topic: in a composed process by reference, and outside where anybody listens."""
        if self._exchange is None:
            self._outputs[topic].publish(message)
            return
        self._awaken_listeners(self._exchange.publish(self.resolve_topic_name(topic), message))
        if topic in self._latched or self._outputs[topic].get_subscription_count() > 0:
            self._outputs[topic].publish(as_ros(message))

    def has_listeners(self, topic: str) -> bool:
        """True if anybody subscribes to an advertised topic: costly pictures are made only then."""
        inside = self._exchange is not None and self._exchange.has_listeners(self.resolve_topic_name(topic))
        return inside or bool(self._outputs[topic].get_subscription_count() > 0)

    def on_reset(self) -> None:
        """Forget everything (``~/reset``); override where there is state."""

    def on_new_session(self) -> None:
        """The clock of the inputs has jumped back: begin anew with the next message; what is mapped must survive."""
        self.on_reset()

    def on_finish(self) -> str | Awaitable[str]:
        """The input has ended: publish what is still open. Override where there is any; returns a line for the log.

        A node that has to wait for it returns something to await, and goes on with all else meanwhile.
        """
        return "nothing open"

    def on_close(self) -> None:
        """The node ends; override to close files."""

    def on_config(self, config: C) -> None:
        """Parameters of ``CHANGEABLE`` are about to change; override where something is made from them."""

    def _on_set_parameters(self, parameters: list[Any]) -> Any:
        own = [p for p in parameters if p.name in self.CHANGEABLE]
        try:
            config = changed_config(self.config, own)
            self.on_config(config)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self.config = config
        return SetParametersResult(successful=True)

    # -- inputs --------------------------------------------------------------------------------------------------------

    def _add_input(
        self,
        source: str,
        topic: str,
        type_name: str,
        handler: Callable[[int, Message], None],
        latched: bool,
        required: bool,
        policy: StampPolicy,
        clock: str,
    ) -> None:
        name, kind = self.resolve_topic_name(topic), getattr(self._ros_types, type_name)
        self._add_entry(topic, Input(name, kind, handler, latched, required, policy, source, clock))

    def _receive(self, entry: Input, message: Message) -> None:
        entry.seen_at_s = time.monotonic()
        self._has_ended = False
        if self._paused:
            self.health.count("ignored_while_paused")
            return
        stamp = stamp_ns(message)
        if entry.policy is StampPolicy.ANY:
            entry.handler(stamp, message)
            return
        starts = entry.policy is StampPolicy.FRAMES
        self._act_on(entry, self._stamps[entry.clock].add(entry.topic, stamp, message, starts_sessions=starts))

    def _act_on(self, entry: Input, decision: StampDecision[Message]) -> None:
        """Count what a decision rejects, and hand on what it releases."""
        if decision.fault is not None:
            self._reject(f"{entry.topic}: message rejected: {decision.reason}", len(decision.rejected))
            self.health.count(decision.fault.value.replace(" ", "_"), len(decision.rejected))
        if decision.new_session:
            self._flush()
            why = f"{decision.reason} on {entry.topic}"
            self._jobs.add(QueuedCall("session", lambda: self.start_session(why)))
        self._held_back = len(decision.released) > 1
        for released_ns, released in decision.released:
            if entry.policy is StampPolicy.FRAMES:
                entry.gaps.add(released_ns)
            entry.handler(released_ns, released)

    def _enqueue(
        self,
        source: str,
        stamp: int,
        callback: Callable[..., None],
        *messages: Message,
        announce: bool = True,
        keep: bool = False,
    ) -> None:
        """Have the callback run in its turn; frames may be left out unless one is to ``keep`` them.

        Nor are those that came at once because their stamps had to be confirmed.
        """
        skip = None if keep or not announce or self._held_back else lambda: self._announce(stamp)
        job = QueuedCall(source, lambda: self._process(source, stamp, callback, *messages, announce=announce), skip)
        self._jobs.add(job)

    def _process(
        self, source: str, stamp: int, callback: Callable[..., None], *messages: Message, announce: bool = True
    ) -> None:
        started = time.perf_counter()
        if announce:
            self._tell_of_room(source)
        try:
            callback(*messages)
            self.health.processed(time.perf_counter() - started, is_frame=announce)
        except ValueError as error:
            self._reject(f"{source}: message rejected: {error}")
        except Exception:
            self._reject(f"{source}: message rejected after a fault:\n{traceback.format_exc()}")
        if announce:
            self._input_stamp_ns = stamp
            self._report_change()
            self._announce(stamp)

    def _announce(self, stamp: int) -> None:
        """Tell a player that the frame of a stamp needs no more waiting for."""
        self._progress.publish(header_message(self._ros_types, stamp, self.get_fully_qualified_name()))

    # -- reset, pause, finish ------------------------------------------------------------------------------------------

    def start_session(self, why: str) -> None:
        """Go on in a new session: nothing that is mapped is forgotten."""
        self.get_logger().warning(f"new session: {why}", throttle_duration_sec=1.0)
        self.health.count("sessions")
        self.on_new_session()
        self.health.set(State.OK, f"new session: {why}")

    def reset(self, why: str) -> None:
        """Flush the queues and forget everything."""
        self.get_logger().warning(f"reset: {why}", throttle_duration_sec=1.0)
        self.health.count("resets")
        self._flush()
        self._jobs.clear()
        for guard in self._stamps.values():
            guard.restart()
        self.on_reset()
        self.health.set(State.OK, f"reset: {why}")

    def _flush(self) -> None:
        for synchronizer in self._synchronizers:
            synchronizer.clear()
        for entry in self._inputs.values():
            entry.gaps.restart()

    def _on_reset_service(self, _: Any, response: Any) -> Any:
        self.reset("asked by service")
        response.success = True
        return response

    def _on_pause_service(self, request: Any, response: Any) -> Any:
        self._paused = bool(request.data)
        response.success, response.message = True, "paused" if self._paused else "running"
        return response

    async def _on_finish_service(self, _: Any, response: Any) -> Any:
        self.receive()  # what has come so far belongs to the input
        inputs = {entry.topic: entry for entry in self._inputs.values()}
        for guard in self._stamps.values():
            for topic, decision in guard.finish():
                self._act_on(inputs[topic], decision)
        self._has_ended = True
        self.finish_work()
        try:
            line = self.on_finish()
            response.success, response.message = True, line if isinstance(line, str) else await line
        except ValueError as error:
            response.success, response.message = False, str(error)
        self.report_now()
        return response

    # -- diagnostics ---------------------------------------------------------------------------------------------------

    def _tick(self) -> None:
        self._match_publishers()
        silence = "; ".join(filter(None, (self._silence(), self._rivals())))
        if silence and not self._silence_text:
            self.get_logger().warning(silence)
        self._silence_text = silence
        if self._unconnected():
            self._connection_timer.reset()
        self.report_now()

    def _rivals(self) -> str:
        """Other nodes that publish what only this one should, or ""."""
        texts, own = [], self.get_fully_qualified_name()
        for topic in sorted(self._alone):
            publishers = self.get_publishers_info_by_topic(self.resolve_topic_name(topic))
            if others := sorted({f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in publishers} - {own}):
                texts.append(f"{topic} is published by {', '.join(others)} too: remap it there")
        return "; ".join(texts)

    def _report_connections(self) -> None:
        """Tell whoever waits for the nodes at once; when all inputs are connected, a look every second is enough."""
        if (unconnected := self._unconnected()) != self._reported_unconnected:
            self._reported_unconnected = unconnected
            self.report_now()
        if not unconnected:
            self._connection_timer.cancel()

    def _report_change(self) -> None:
        """A change of state is reported at once, with the stamp of the input that brought it."""
        if self.health.state != self._reported_state:
            self._reported_state = self.health.state
            self.report_now()

    def report_now(self) -> None:
        """Publish diagnostics, every second and where somebody may wait for them."""
        self._diagnostics.publish(self._diagnostic_message())

    def _diagnostic_message(self) -> Message:
        self.health.counters["unpaired"] = sum(s.unpaired for s in self._synchronizers)
        self.health.counters["skipped"] = self._jobs.skipped.total()
        self.health.counters["missing"] = max((entry.gaps.missing for entry in self._inputs.values()), default=0)
        late = self._lateness()
        values = self.health.report(time.monotonic(), self._silence_text)
        values["unconnected"] = " ".join(self._unconnected())
        values["input_stamp_ns"] = str(self._input_stamp_ns)
        status = self._ros_types.DiagnosticStatus(
            level=bytes([State[values["state"]]]),
            name=self.get_fully_qualified_name(),
            message="; ".join(filter(None, (values["reason"], late))) or "OK",
            values=[self._ros_types.KeyValue(key=key, value=value) for key, value in values.items()],
        )
        header = self._ros_types.Header(stamp=self.get_clock().now().to_msg())
        return self._ros_types.DiagnosticArray(header=header, status=[status])

    def _lateness(self) -> str:
        """Complaint about frames left out since the last report because the node is too slow, or ""."""
        skipped = self._jobs.skipped.total()
        new, self._skipped = skipped - self._skipped, skipped
        return f"{new} frames left out: they come faster than they are processed" if new else ""
