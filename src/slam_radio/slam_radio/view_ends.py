# SPDX-License-Identifier: Apache-2.0
"""Views at the two ends of a link: images in at an agent, what is asked for and what comes at a post."""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np

from slam_core.camera import Camera
from slam_core.geometry import FloatArray
from slam_core.messages import (
    camera_info_from_message,
    colour_from_message,
    compressed_image_message,
    depth_from_messages,
    header_message,
    path_from_message,
    pose_stamped_message,
    stamp_ns,
)
from slam_core.messages.base import Message
from slam_core.messages.key_frames import KEY_FRAME_TOPICS, AnchoredKeyFrame, key_frame_messages
from slam_core.nodes.stamp_guard import StampPolicy
from slam_core.trajectory import Trajectory
from slam_core.types import DepthImage, PoseEstimate, Submap
from slam_radio.link_end import End
from slam_radio.views.depth_code import depth_of_levels
from slam_radio.views.places import moment_of
from slam_radio.views.view_files import ViewFiles
from slam_radio.views.view_format import DENSE, KINDS, PICTURE, PlacedImage, rgb_of
from slam_radio.views.view_inbox import ViewInbox
from slam_radio.views.view_sender import ViewSender
from slam_radio.views.view_taker import ViewTaker
from slam_radio.wire.view_messages import ViewKey, unpack_look, unpack_unseen

_COLOURS = "stereo/left/image_rect_color"
_PICTURES = (_COLOURS, "stereo/left/image_rect", "tof/color/image")
"""Topics of pictures: one that is heard puts those after it out of use, until it is silent."""
_SILENT_NS = 2_000_000_000
_DEPTH = {"tof/depth/image": "Image", "tof/noise/image": "Image", "tof/camera_info": "CameraInfo"}
_INFOS = {"stereo": "stereo/left/camera_info", "tof": "tof/camera_info"}
WANTED = {PICTURE: "wanted_picture", DENSE: "wanted_key_frame"}
"""Topics at the post that ask for a view."""
_ANY: dict[str, Any] = {"required": False, "stamps": StampPolicy.ANY}
_GREY = 128
"""Colour of a key frame without a picture."""
_KEPT = 50
"""Views that whoever comes later gets too."""


class AgentViews:
    """Keeps an agent's images and sends what the post lacks."""

    def __init__(self, end: End, agent: str) -> None:
        self.end, self.node = end, end.node
        config = self.node.config
        folder = self.node.state_folder / "views" / agent
        self.files = ViewFiles(folder, 1e6 * config.views.megabytes)
        self.taker = ViewTaker(config.views, self.files)
        self.sender = ViewSender(self.files, config.bytes_per_second, config.resend_after_s)
        if self.files.strangers:
            end.tell_strangers({folder: self.files.strangers}, "sent")
        self._cameras: dict[str, Camera] = {}
        self._heard: dict[int, int] = {}
        """Newest stamp (ns) of a topic of pictures, by its place among them."""
        self._colours: Message | None = None
        end.hear(f"slam/{agent}/look", self.on_look)
        if config.views.megabytes > 0.0:
            for rank, topic in enumerate(_PICTURES):
                if topic == _COLOURS and not config.views.colours:
                    continue  # a driver that nobody hears does not make them
                self.node.listen(topic, "Image", partial(self.on_picture, rank), **_ANY)
            self.node.listen(_INFOS["stereo"], "CameraInfo", self.on_info, **_ANY)
            self.node.listen_together(_DEPTH, self.on_depth, **_ANY)

    def on_info(self, message: Message) -> None:
        """Keep the calibration of the left camera."""
        self._cameras["stereo"] = camera_info_from_message(message).rectified

    def on_picture(self, rank: int, message: Message) -> None:
        """Keep a picture, if it is due and of the best camera that is heard."""
        sensor = _PICTURES[rank].split("/")[0]
        if sensor == "tof":
            self._colours = message
        stamp = self._heard[rank] = stamp_ns(message)
        has_better = any(other < rank and abs(stamp - t) <= _SILENT_NS for other, t in self._heard.items())
        if has_better or not self.taker.wants(PICTURE):
            return
        T_base_camera = self._mount(message)
        self.taker.add_picture(stamp, T_base_camera, colour_from_message(message), self._cameras.get(sensor))

    def on_depth(self, depth: Message, noise: Message, info: Message) -> None:
        """Keep a depth image, if it is due, with its colours where they have come."""
        if not self.taker.wants(DENSE):
            return
        image = depth_from_messages(depth, noise, info)
        self._cameras["tof"] = image.camera
        colours = self._colours
        is_same = colours is not None and stamp_ns(colours) == image.stamp_ns
        self.taker.add_depth(image, self._mount(depth), colour_from_message(colours) if is_same else None)

    def on_pose(self, T_odom_base: FloatArray) -> None:
        """Take the newest pose by odometry."""
        self.taker.set_pose(T_odom_base)

    def on_submap(self, submap: Submap) -> None:
        """Keep the images of a submap that has ended."""
        self.node.health.count("views kept", self.taker.end_submap(submap))
        if reasons := self.taker.unkept:
            self.node.health.count("views that cannot be kept", len(reasons))
            self.node.get_logger().warning(
                f"{len(reasons)} images of submap {submap.index} cannot be kept: {reasons[0]}"
            )

    def on_look(self, _: str, data: bytes) -> None:
        """Note which views the post lacks."""
        self.sender.lack(unpack_look(data), time.monotonic())

    def _mount(self, message: Message) -> FloatArray:
        return np.asarray(self.node.lookup(self.node.config.base_frame, message.header.frame_id))

    def show(self) -> None:
        """Counts in the diagnostics."""
        self.node.health.take({
            "views on disk": len(self.files.sizes), "pieces sent": self.sender.sent,
            "views that cannot be read": self.sender.damaged,
        })  # fmt: skip

    def close(self) -> None:
        """Keep the images for the next start."""
        self.files.close()


class PostViews:
    """Asks agents for views of places and moments, and publishes those that come."""

    def __init__(self, end: End, agents: Iterable[str]) -> None:
        self.end, self.node = end, end.node
        config, folder = self.node.config, self.node.state_folder / "asked_views"  # an agent of this state has "views"
        self.inboxes = {a: ViewInbox(a, folder / a, 1e6 * config.views.megabytes) for a in agents}
        self._paths: dict[str, Trajectory] = {}
        self._submaps: dict[str, dict[tuple[int, int], tuple[int, int, frozenset[int]]]] = {a: {} for a in self.inboxes}
        """First and last stamp of each submap, and those of the poses of its path, ns."""
        for agent, inbox in self.inboxes.items():
            if inbox.files.strangers:
                end.tell_strangers({inbox.files.path: inbox.files.strangers}, "shown")
            self.node.listen(f"{agent}/map/path", "Path", partial(self.on_path, agent), latched=True, **_ANY)
            end.hear(f"slam/{agent}/unseen", partial(self.on_unseen, agent))
            self.node.advertise(f"{agent}/view/pose", "PoseStamped", latched=True, depth=_KEPT)
            self.node.advertise(f"{agent}/view/picture/compressed", "CompressedImage", latched=True, depth=_KEPT)
            for topic, kind in KEY_FRAME_TOPICS.items():
                self.node.advertise(f"{agent}/{topic}", kind, latched=True, depth=_KEPT)
        for wanted, topic in WANTED.items():
            self.node.listen(topic, "PointStamped", partial(self.on_wanted, wanted), **_ANY)

    def on_submap(self, agent: str, submap: Submap) -> None:
        """Note the time of a submap."""
        stamps = frozenset(pose.stamp_ns for pose in submap.path)
        self._submaps[agent][submap.session, submap.index] = submap.start_stamp_ns, submap.end_stamp_ns, stamps

    def on_path(self, agent: str, message: Message) -> None:
        """Keep where an agent was by the map."""
        poses = [PoseEstimate(stamp, T, np.zeros((6, 6))) for stamp, T in path_from_message(message)]
        self._paths[agent] = Trajectory.from_estimates(poses)

    def on_wanted(self, kind: int, message: Message) -> None:
        """Ask for the view of a place of the map, or of a moment or the newest submap of an agent.

        Raises
        ------
        ValueError
            If no agent was there, or at that time.
        """
        frame = message.header.frame_id
        if frame in self.inboxes:
            agent, stamp = (
                frame,
                stamp_ns(message) or max((end for _, end, _ in self._submaps[frame].values()), default=0),
            )
        elif frame == self.node.config.map_frame:
            agent, stamp = moment_of(self._paths, np.array([message.point.x, message.point.y, message.point.z]))
        else:
            raise ValueError(
                f"a place is wanted in the frame '{self.node.config.map_frame}', or of an agent: '{frame}'"
            )
        view = self.inboxes[agent].ask(ViewKey(kind, self._session_at(agent, stamp), stamp))
        self.node.health.count("views asked for")
        outcome = "asked for" if view is None else "is here"
        self.node.get_logger().info(f"{KINDS[kind]} of {agent} at {stamp * 1e-9:.3f} s {outcome}")
        if view is not None:
            self.publish(agent, view)

    def _session_at(self, agent: str, stamp: int) -> int:
        """Session of a stamp: of several whose clocks overlap that with a pose of just this stamp, else the newest.

        Raises
        ------
        ValueError
            If no submap has come of this time.
        """
        at = [(stamp in poses, session) for (session, _), (start, end, poses) in self._submaps[agent].items()
              if start <= stamp <= end]  # fmt: skip
        if not at:
            raise ValueError(f"no submap of {agent} has come that was made at {stamp * 1e-9:.3f} s")
        return max(at)[1]

    def on_piece(self, agent: str, view: PlacedImage | None) -> None:
        """Publish a view that is whole."""
        self.node.health.count("pieces received")
        if view is not None:
            self.node.health.count("views received")
            self.publish(agent, view)

    def on_unseen(self, agent: str, _: str, data: bytes) -> None:
        """An agent has no image of what was asked for."""
        if count := self.inboxes[agent].give_up(unpack_unseen(data)):
            self.node.health.count("views that agents do not have", count)
            self.node.get_logger().warning(f"{agent} has no image of {count} of the moments that were asked for")

    def publish(self, agent: str, view: PlacedImage) -> None:
        """Publish a view: for the page with its pose in the map as it is now, for the dense model with its submap."""
        types = self.node.types
        header = header_message(types, view.stamp_ns, agent)
        path = self._paths.get(agent)
        if path is not None and len(path):
            T_map_start = path.interpolate(np.array([view.start_stamp_ns]))[0]
            T_map_camera, frame = T_map_start @ view.T_start_camera, self.node.config.map_frame
            self.node.publish(f"{agent}/view/pose", pose_stamped_message(types, view.stamp_ns, frame, T_map_camera))
        if view.depth is None:
            picture = compressed_image_message(types, header, view.jpeg, "jpeg")
            self.node.publish(f"{agent}/view/picture/compressed", picture)
            return
        for topic, message in zip(KEY_FRAME_TOPICS, key_frame_messages(types, key_frame_of(view, agent)), strict=True):
            self.node.publish(f"{agent}/{topic}", message)

    def show(self) -> None:
        """Counts in the diagnostics, and views that the start has found whole: all nodes of this process listen now."""
        for agent, inbox in self.inboxes.items():
            for view in inbox.finished:
                self.publish(agent, view)
            inbox.finished = []
        inboxes = self.inboxes.values()
        self.node.health.take({
            "views wanted": sum(len(i.wanted) for i in inboxes), "pieces repeated": sum(i.repeated for i in inboxes),
            "views given up": sum(i.given_up for i in inboxes),
        })  # fmt: skip

    def reset(self) -> None:
        """Forget what has come and what was asked for."""
        for inbox in self.inboxes.values():
            inbox.forget()

    def close(self) -> None:
        """Keep what has come for the next start."""
        for inbox in self.inboxes.values():
            inbox.close()


def key_frame_of(view: PlacedImage, agent: str) -> AnchoredKeyFrame:
    """The depth image of a view that has one, with its colours, or grey."""
    assert view.depth is not None
    assert view.steps is not None
    width, height = view.size
    depth, sigma = depth_of_levels(view.depth, view.steps)
    image = DepthImage(view.stamp_ns, depth, sigma, Camera(width, height, *view.intrinsics), frame_id=agent)
    colours = rgb_of(view.jpeg) if view.jpeg else np.full((height, width, 3), _GREY, dtype=np.uint8)
    return AnchoredKeyFrame(image, colours, view.start_stamp_ns, view.T_start_camera)
