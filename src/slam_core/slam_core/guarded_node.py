# SPDX-License-Identifier: Apache-2.0
"""A managed node that no callback can end: what a subscription, timer or service raises is logged and counted.

It is a lifecycle node of ROS 2 that starts by itself: active when it is ready. ``deactivate`` pauses it, ``activate``
goes on, ``cleanup`` resets it.
"""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls, disable-error-code="attr-defined,union-attr,arg-type,misc"

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from slam_core.health import Health


class GuardedNode(LifecycleNode):
    """rclpy's node; subscriptions, timers and services made through it are guarded. ``health`` counts ``faults``."""

    def __init__(self, name: str, **options: Any) -> None:
        self.health = Health()
        self.calls = 0
        """Callbacks called so far: as long as it grows there may be more to receive."""
        self.sleeps = False
        """True while its thread waits for messages: it has to be woken for what another thread hands over."""
        self._paused = False
        self._answering = 0
        super().__init__(name, **options)
        self.trigger_configure()
        self.trigger_activate()

    def reset(self, why: str) -> None:
        """Forget everything."""
        raise NotImplementedError

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take messages."""
        self._paused = False
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Leave messages aside, as after ``~/pause``."""
        self._paused = True
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As ``~/reset``."""
        self.reset("cleaned up")
        return super().on_cleanup(state)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], *rest: Any, **options: Any
    ) -> Any:
        """As rclpy's, guarded, and as :meth:`create_publisher`."""
        options.setdefault("event_callbacks", SubscriptionEventCallbacks(use_default_callbacks=False))
        return super().create_subscription(msg_type, topic, self._guarded(topic, callback), *rest, **options)

    def create_publisher(self, *arguments: Any, **options: Any) -> Any:
        """As rclpy's, without the events that it only logs.

        An executor asks for each of them whenever it waits: those of one node took 0.2 ms a message.
        """
        options.setdefault("event_callbacks", PublisherEventCallbacks(use_default_callbacks=False))
        return super().create_publisher(*arguments, **options)

    def create_timer(self, timer_period_sec: float, callback: Callable[[], None], *rest: Any, **options: Any) -> Any:
        """As rclpy's, guarded."""
        return super().create_timer(timer_period_sec, self._guarded("timer", callback), *rest, **options)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any], *rest: Any, **options: Any
    ) -> Any:
        """As rclpy's, guarded: a request that fails is answered with the reason.

        Where ``callback`` returns something to await, the node does everything else until it is there.
        """

        async def answer(request: Any, response: Any) -> Any:
            self.calls += 1
            self._answering += 1
            try:
                answered = callback(request, response)
                return await answered if inspect.isawaitable(answered) else answered
            except Exception as error:
                self._on_fault(f"service {srv_name}")
                return _failed(srv_type.Response(), f"{type(error).__name__}: {error}")
            finally:
                self._answering -= 1

        options.setdefault("callback_group", ReentrantCallbackGroup())
        return super().create_service(srv_type, srv_name, answer, *rest, **options)

    @property
    def has_work(self) -> bool:
        """True if something waits that :meth:`work` would do."""
        return False

    @property
    def received_subscriptions(self) -> list[Any]:
        """The subscriptions whose messages :meth:`receive` takes; those of others are the executor's."""
        return []

    @property
    def urgent_subscriptions(self) -> list[Any]:
        """Received subscriptions that wake the node; messages of the others are taken with the next one that does."""
        return self.received_subscriptions

    @property
    def needs_executor(self) -> bool:
        """True if only an executor can go on: an answer awaits something, or the node asks services of others."""
        return self._answering > 0 or any(True for _ in self.clients)

    def receive(self) -> None:
        """Take all messages that have come. Whoever spins the node calls it before each piece of work."""

    def work(self) -> bool:
        """Do a piece of what waits; False if nothing does. Whoever spins the node calls it between messages."""
        return False

    def _guarded(self, source: str, callback: Callable[..., None]) -> Callable[..., None]:
        def call(*arguments: Any) -> None:
            self.calls += 1
            try:
                callback(*arguments)
            except Exception:
                self._on_fault(source)

        return call

    def _on_fault(self, source: str) -> None:
        if not self.context.ok():  # the node is ending: what fails then is no fault
            return
        self.health.count("faults")
        self.get_logger().error(f"{source}: fault:\n{traceback.format_exc()}", throttle_duration_sec=1.0)


def _failed(response: Any, why: str) -> Any:
    """A response that says so in the fields that it has."""
    for name, value in (("success", False), ("message", why), ("status_message", why)):
        if hasattr(response, name):
            setattr(response, name, value)
    return response
