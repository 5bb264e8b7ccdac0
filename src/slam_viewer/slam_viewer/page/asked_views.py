# SPDX-License-Identifier: Apache-2.0
"""Pictures and dense key frames on request: buttons that ask for them, and the pictures that come."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from slam_core.geometry import OPTICAL_FROM_RIG, FloatArray, make_transform
from slam_core.messages import (
    colour_from_message,
    header_message,
    pose_from_message,
    stamp_ns,
)
from slam_core.messages.base import Message
from slam_core.nodes.stamp_guard import StampPolicy
from slam_viewer.page.page import ViewerPage

_PICTURE, _KEY_FRAME = "wanted_picture", "wanted_key_frame"
_MOST_SHOWN = 50
"""Pictures in the scene; the oldest make room."""
_ANY: dict[str, Any] = {"required": False, "latched": True, "stamps": StampPolicy.ANY}


class AskedViews:
    """Requests of the leader to the agents, by the ``radio_link`` of the post.

    Parameters
    ----------
    node
        The viewer, as far as it is needed: its topics, its types and its configuration.
    page
        The page; a place is clicked in its scene.
    place_of
        Point (3,) m of the map that a click's origin and direction mean; None where that is not known.
    """

    def __init__(
        self, node: Any, page: ViewerPage, place_of: Callable[[FloatArray, FloatArray], FloatArray | None]
    ) -> None:
        self._node, self._page, self._place_of = node, page, place_of
        self._poses: dict[tuple[str, int], FloatArray] = {}
        self._shown = 0
        for topic in (_PICTURE, _KEY_FRAME):
            node.advertise(topic, "PointStamped")
        agents: Sequence[str] = node.config.agents
        for agent in agents:
            node.listen(_topic(agent, "view/pose"), "PoseStamped", partial(self._on_pose, agent), **_ANY)
            picture = _topic(agent, "view/picture/compressed")
            node.listen(picture, "CompressedImage", partial(self._on_picture, agent), **_ANY)
        with page.camera:
            self._buttons = [
                self._button("Ask for a picture of a place: then click into the scene", partial(self._click, _PICTURE)),
                self._button("Ask for depth of a place: then click into the scene", partial(self._click, _KEY_FRAME)),
                *(self._button(f"Ask {a} for its newest picture", partial(self.ask, _PICTURE, a)) for a in agents if a),
            ]  # fmt: skip

    def _button(self, text: str, do: Callable[[], None]) -> Any:
        button = self._page.server.gui.add_button(text, visible=False)
        button.on_click(lambda _: do())
        return button

    def offer(self, *, is_post: bool) -> None:
        """Show the buttons where there is a post that can ask."""
        for button in self._buttons:
            button.visible = is_post

    def ask(self, topic: str, frame: str, point: FloatArray | None = None) -> None:
        """Publish what is wanted: a point (3,) m of the frame of the map, or the newest of the agent ``frame``."""
        types = self._node.types
        x, y, z = (0.0, 0.0, 0.0) if point is None else point.tolist()
        message = types.PointStamped(header=header_message(types, 0, frame), point=types.Point(x=x, y=y, z=z))
        self._node.publish(topic, message)

    def _click(self, topic: str) -> None:
        self._page.on_click(partial(self._on_click, topic))

    def _on_click(self, topic: str, origin: FloatArray, direction: FloatArray) -> None:
        if (place := self._place_of(origin, direction)) is not None:
            self.ask(topic, self._node.config.map_frame, place)

    def _on_pose(self, agent: str, message: Message) -> None:
        self._poses[agent, stamp_ns(message)] = pose_from_message(message.pose)
        for key in list(self._poses)[:-_MOST_SHOWN]:
            del self._poses[key]

    def _on_picture(self, agent: str, message: Message) -> None:
        picture, stamp = colour_from_message(message), stamp_ns(message)
        self._page.show_picture(picture, f"{agent or 'rig'}: picture on request, taken at {stamp * 1e-9:.1f} s")
        if (T := self._poses.get((agent, stamp))) is not None:
            T_map_rig = make_transform(T[:3, :3] @ OPTICAL_FROM_RIG, T[:3, 3])
            self._shown = self._shown % _MOST_SHOWN + 1
            self._page.show_camera(T_map_rig, picture, number=self._shown)


def _topic(agent: str, name: str) -> str:
    """A topic below an agent's namespace."""
    return f"{agent}/{name}" if agent else name
