# SPDX-License-Identifier: Apache-2.0
"""Node ``supervisor`` of ``slam nodes``: hears when nodes are ready and how far they are, and calls their services."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls, disable-error-code="attr-defined,union-attr,arg-type,misc"

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from slam_bags.nodes.pacing import Connections
from slam_core.nodes.base_node import PROGRESS_TOPIC
from slam_core.ros import RosTypes, sensor_qos, use_fast_dds_profile

_SPIN_S = 0.1
_QUIET_TIMES = 3
"""Turns of ``_SPIN_S`` without progress after which nothing is on its way any more."""
_MATCHING_S = 0.3
_ASK_AGAIN_S = 10.0
_TRANSPORT_VARIABLES = ("ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE")


@contextmanager
def transport_of_the_nodes(environment: Mapping[str, str]) -> Iterator[None]:
    """Within the block a participant is made with the nodes' discovery range and profile."""
    before = dict(os.environ)
    os.environ |= {name: environment[name] for name in _TRANSPORT_VARIABLES if name in environment}
    use_fast_dds_profile()
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


class Supervisor:
    """A node in a context of its own; every method that waits also listens. Use it in a ``with`` block.

    Parameters
    ----------
    environment
        Domain, discovery range and profile of the nodes to watch.
    check
        Called again and again while waiting; it raises if a node has died.
    """

    def __init__(self, environment: Mapping[str, str], check: Callable[[], None]) -> None:
        self._check = check
        self._context = Context()
        with transport_of_the_nodes(environment):
            rclpy.init(
                context=self._context,
                domain_id=int(environment["ROS_DOMAIN_ID"]),
                signal_handler_options=SignalHandlerOptions.NO,
            )
            self._node = Node("supervisor", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.diagnostics: dict[str, dict[str, str]] = {}
        """Latest diagnostic values by full node name."""
        self.reports: Counter[str] = Counter()
        """Diagnostics received so far by full node name."""
        self._connections = Connections()
        self.progress: Counter[str] = Counter()
        """Inputs processed so far by full node name."""
        self.submaps = 0
        self._clients: dict[str, tuple[Any, float]] = {}
        types = RosTypes()
        self._node.create_subscription(types.DiagnosticArray, "/diagnostics", self._on_diagnostics, sensor_qos(1000))
        self._node.create_subscription(types.Header, PROGRESS_TOPIC, self._on_progress, sensor_qos(10_000))
        self._types = types

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._executor.shutdown(timeout_sec=2.0)
        self._node.destroy_node()
        self._context.try_shutdown()

    def count_submaps(self, topics: Iterable[str]) -> None:
        """Count what comes on topics of the type of ``submap/info`` in :attr:`submaps`."""
        for topic in topics:
            self._node.create_subscription(
                self._types.DiagnosticArray, topic, self._on_submap, sensor_qos(1000, latched=True)
            )

    def wait(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Listen until ``condition`` holds; TimeoutError saying ``what`` did not happen after ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            self._executor.spin_once(timeout_sec=_SPIN_S)
            self._check()
            if time.monotonic() > deadline:
                raise TimeoutError(f"{what} did not happen within {timeout_s:.0f} s")

    def wait_until_quiet(self, timeout_s: float) -> None:
        """Listen until nobody has reported progress several times in a row: one time may pass while all stand still."""
        deadline, quiet = time.monotonic() + timeout_s, 0
        while quiet < _QUIET_TIMES and time.monotonic() < deadline:
            seen = self.progress.total()
            self.listen(_SPIN_S)
            quiet = quiet + 1 if self.progress.total() == seen else 0

    def wait_for_reports(self, names: Iterable[str], before: Mapping[str, int], timeout_s: float) -> None:
        """Listen until every node has reported more often than ``before``, but no longer than ``timeout_s``."""
        waiting = list(names)
        deadline = time.monotonic() + timeout_s
        while any(self.reports[n] <= before.get(n, 0) for n in waiting) and time.monotonic() < deadline:
            self.listen(_SPIN_S)

    def listen(self, seconds: float) -> None:
        """Handle what comes in."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)
        self._check()

    def obstacles(self, names: Iterable[str], from_outside: Iterable[str]) -> list[str]:
        """As :meth:`Connections.obstacles`."""
        return self._connections.obstacles(names, from_outside)

    def subscribers(self, topic: str) -> set[str]:
        """Full names of the nodes that subscribe to a topic."""
        known = self._node.get_subscriptions_info_by_topic(topic)
        return {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in known}

    def publishes(self, topic: str) -> bool:
        """True if anybody publishes a topic."""
        return bool(self._node.get_publishers_info_by_topic(topic))

    def prepare(self, services: Iterable[str]) -> None:
        """Have both ends of services that will be called find each other meanwhile."""
        for service in services:
            if service not in self._clients:
                self._clients[service] = self._node.create_client(Trigger, service), time.monotonic()

    def call(self, service: str, timeout_s: float = 60.0, has_effect: Callable[[], bool] = lambda: False) -> str:
        """Call a std_srvs/Trigger service; returns its text. ValueError if it fails, TimeoutError if it is silent.

        The server may not have discovered our end when it answers, and then the answer is lost: a service that is new,
        or was not prepared, has some time for that, and we ask again, unless the call ``has_effect`` already.
        """
        self.prepare([service])
        client, since = self._clients[service]
        if not client.service_is_ready():
            self.wait(client.service_is_ready, timeout_s, f"service {service}")
            since = time.monotonic()
        self.listen(since + _MATCHING_S - time.monotonic())
        futures: list[Any] = []

        def answered() -> bool:
            if time.monotonic() > started + len(futures) * _ASK_AGAIN_S:
                futures.append(client.call_async(Trigger.Request()))
            return has_effect() or any(future.done() for future in futures)

        started = time.monotonic()
        self.wait(answered, timeout_s, f"answer of {service}")
        response = next((future.result() for future in futures if future.done()), Trigger.Response(success=True))
        if not response.success:
            raise ValueError(f"{service}: {response.message}")
        return str(response.message)

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            values = {entry.key: entry.value for entry in status.values}
            self.diagnostics[status.name] = values | {"message": status.message}
            self.reports[status.name] += 1
            self._connections.report(status.name, values)

    def _on_progress(self, header: Any) -> None:
        self.progress[header.frame_id] += 1

    def _on_submap(self, _: Any) -> None:
        self.submaps += 1
