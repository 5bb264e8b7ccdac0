# SPDX-License-Identifier: Apache-2.0
"""The ``tof_driver`` node: raw images of a ToF or any depth camera in, rectified depth with its noise and points out.

    tof/range/image_raw (or tof/depth/image_raw), tof/{amplitude,intensity}/image_raw, tof/camera_info
        -> tof/depth/image, tof/noise/image, tof/points, tof/{amplitude,intensity}/image
    tof/color/image_raw, in the pixels of the depth image -> tof/color/image

With ``source`` folder, video or librealsense this node reads the raw images itself and publishes them too.

One ``tof/camera_info`` serves raw and rectified images, as everywhere in ROS: K and D are those of the raw image, P of
the rectified one. It comes from the camera's own driver; with the parameter ``info`` it comes from a YAML file and this
node publishes it. ``tof/set_camera_info`` writes that file.
"""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from sensor_msgs.srv import SetCameraInfo

from slam_core.camera import CameraInfo
from slam_core.camera_info import CameraInfoFile, read_camera_info
from slam_core.config import parameter
from slam_core.health import State
from slam_core.messages import (
    DEPTH_TOPICS,
    camera_info_from_message,
    camera_info_message,
    cloud_message,
    colour_from_message,
    depth_messages,
    header_message,
    image_message,
    picture_from_message,
    stamp_ns,
)
from slam_core.messages.base import Message
from slam_core.nodes.base_node import SlamNode
from slam_core.nodes.calibration_watch import CalibrationWatch
from slam_core.nodes.frame_sources import SourceTimer
from slam_core.ros import run_node
from slam_core.types import DepthImage
from tof_driver.depth import DepthConfig
from tof_driver.points import depth_cloud
from tof_driver.sources import DepthFolder, DepthVideo, RealSense
from tof_driver.stage import DepthStage, RawDepth


@dataclass(frozen=True)
class TofDriverConfig(DepthConfig):
    """Depth processing, and where the images come from."""

    source: str = parameter("topics", "origin of the raw images", choices=("topics", "folder", "video", "librealsense"))
    path: str = parameter("", "folder, video file, or serial number or recording for librealsense; empty: any camera")
    frame: str = parameter("tof_optical_frame", "frame of the images of a source other than topics")
    rate: float = parameter(0.0, "images per second of a folder or video; 0: as recorded", unit="Hz", minimum=0.0)
    pictures: str = parameter(
        "auto",
        "images beside range (color: as amplitude); auto: amplitude and intensity with measurement range, else none",
        choices=("auto", "both", "amplitude", "intensity", "color", "none"),
    )
    info: str = parameter("", "camera_info YAML file; empty: from the topic tof/camera_info")


_COLOUR = "tof/color/image"
OwnSource = DepthFolder | DepthVideo | RealSense


class TofDriverNode(SlamNode[TofDriverConfig]):
    """Publishes the topics of :data:`slam_core.messages.DEPTH_TOPICS`."""

    MAKES_AHEAD = False

    def __init__(self) -> None:
        super().__init__("tof_driver", TofDriverConfig)
        self.stage = DepthStage(depth_config(self.config))
        self.calibrations = CalibrationWatch()
        self._pictures = self._picture_names()
        if self.config.info:
            self.stage.set_info(_read(self.config.info))
        self.source = None if self.config.source == "topics" else self._open_source()
        self._topics = self._advertise_outputs()
        if self.source is None:
            self._listen_to_inputs()
        else:
            self._start_source(self.source)
        self.create_service(SetCameraInfo, "tof/set_camera_info", self._on_set_info)

    def on_reset(self) -> None:
        """Forget what waits, and use the newest calibration."""
        self.stage.reset()
        for info in self.calibrations.restart().values():
            self.stage.set_info(info)

    def on_new_session(self) -> None:
        """Forget what waits; the map goes on, with its calibration."""
        self.stage.reset()

    def on_close(self) -> None:
        """Let go of the camera."""
        if self.source is not None:
            self.source.close()

    # -- topics --------------------------------------------------------------------------------------------------------

    def _picture_names(self) -> tuple[str, ...]:
        chosen = self.config.pictures
        if chosen == "auto":
            chosen = "both" if self.config.measurement == "range" else "none"
        return {"both": ("amplitude", "intensity"), "none": ()}.get(chosen, (chosen,))

    def _roles(self) -> tuple[str, ...]:
        """Roles that the pictures are taken for."""
        return tuple("amplitude" if name == "color" else name for name in self._pictures)

    def _advertise_outputs(self) -> tuple[str, ...]:
        """Offer the topics that this camera has; a camera info that comes from a topic is there already."""
        unused = {f"tof/{name}/image" for name in ("amplitude", "intensity") if name not in self._roles()}
        if not self.config.info and self.source is None:
            unused.add("tof/camera_info")
        self.advertise(_COLOUR, "Image")
        used = tuple(topic for topic in DEPTH_TOPICS if topic not in unused)
        for topic in used:
            self.advertise(topic, DEPTH_TOPICS[topic], alone=topic == "tof/camera_info")
        return used

    def _listen_to_inputs(self) -> None:
        if not self.config.info:
            self.listen("tof/camera_info", "CameraInfo", self._on_info)
        names = (self.config.measurement, *self._pictures)
        self.listen_together({f"tof/{name}/image_raw": "Image" for name in names}, self._on_images)
        if "color" not in self._pictures:
            self.listen(f"{_COLOUR}_raw", "Image", self._on_colour, required=False)

    # -- inputs --------------------------------------------------------------------------------------------------------

    def _on_info(self, message: Message) -> None:
        info = camera_info_from_message(message)
        if self.calibrations.hear("tof", info):
            self.stage.set_info(info)
        self._publish_ready()

    def _on_images(self, *messages: Message) -> None:
        self.calibrations.require_unchanged()
        pictures = dict(zip(self._roles(), map(picture_from_message, messages[1:]), strict=True))
        header = messages[0].header
        image = picture_from_message(messages[0])
        self.stage.add(RawDepth(stamp_ns(messages[0]), image, **pictures, frame_id=header.frame_id))
        self._publish_ready()
        if "color" in self._pictures:
            self._on_colour(messages[1])

    def _on_colour(self, message: Message) -> None:
        picture = self.stage.colour(colour_from_message(message)) if self.has_listeners(_COLOUR) else None
        if picture is not None:
            header = header_message(self.types, stamp_ns(message), message.header.frame_id)
            self.publish(_COLOUR, image_message(self.types, header, picture, "rgb8"))

    def _publish_ready(self) -> None:
        for depth in self.stage.ready():
            self._publish(depth)
            self.health.set(State.DEGRADED if self.stage.diagnostic else State.OK, self.stage.diagnostic)
        self.health.take(self.stage.counters)

    def _publish(self, depth: DepthImage) -> None:
        assert self.stage.info is not None
        header = header_message(self.types, depth.stamp_ns, depth.frame_id)
        outputs = depth_messages(self.types, depth, cloud_message(self.types, header, depth_cloud(depth)))
        outputs = outputs._replace(camera_info=camera_info_message(self.types, header, self.stage.info))
        for topic, message in zip(DEPTH_TOPICS, outputs, strict=True):
            if topic in self._topics:
                self.publish(topic, message)

    # -- own sources ---------------------------------------------------------------------------------------------------

    def _open_source(self) -> OwnSource:
        if not self.config.info and self.config.source != "librealsense":
            raise ValueError(f"source '{self.config.source}' needs the parameter info (a YAML file)")
        try:
            return self._make_source()
        except OSError as error:
            raise ValueError(str(error)) from error

    def _make_source(self) -> OwnSource:
        c, names = self.config, (self.config.measurement, *self._pictures)
        if c.source == "folder":
            return DepthFolder(Path(c.path).expanduser(), names, c.rate or 10.0)
        if c.source == "video":
            return DepthVideo(str(Path(c.path).expanduser()), names)
        if names != ("depth",):
            raise ValueError("source 'librealsense' gives depth alone: set measurement depth and pictures none")
        source = RealSense(c.path, lambda: int(self.get_clock().now().nanoseconds))
        if not c.info:
            self.stage.set_info(source.info)
        return source

    def _start_source(self, source: OwnSource) -> None:
        for name in (self.config.measurement, *self._pictures):
            self.advertise(f"tof/{name}/image_raw", "Image")
        self._player = SourceTimer(self, source, self.config.rate or source.rate, self._publish_raw)

    def _publish_raw(self, raw: RawDepth) -> None:
        header = header_message(self.types, raw.stamp_ns, self.config.frame)
        roles = {self.config.measurement: raw.image}
        roles |= {n: getattr(raw, role) for n, role in zip(self._pictures, self._roles(), strict=True)}
        for name, image in roles.items():
            self.publish(f"tof/{name}/image_raw", image_message(self.types, header, image))
        self.stage.add(replace(raw, frame_id=self.config.frame))
        self._publish_ready()

    # -- calibration ---------------------------------------------------------------------------------------------------

    def _on_set_info(self, request: Any, response: Any) -> Any:
        try:
            response.status_message = self._store_info(camera_info_from_message(request.camera_info))
            response.success = True
        except (ValueError, OSError) as error:
            response.success, response.status_message = False, str(error)
        return response

    def _store_info(self, info: CameraInfo) -> str:
        if not self.config.info:
            raise ValueError(
                "the camera info comes from the topic tof/camera_info: set the parameter info to a YAML file"
            )
        CameraInfoFile(info, "tof").write(Path(self.config.info).expanduser())
        self.stage.set_info(info)
        return f"written to {self.config.info} and in use; begin a new map, and reset feature_extractor (~/reset)"


def depth_config(config: TofDriverConfig) -> DepthConfig:
    """The part of the node's configuration that is the algorithm's."""
    return DepthConfig(**{f.name: getattr(config, f.name) for f in fields(DepthConfig)})


def _read(path: str) -> CameraInfo:
    try:
        return read_camera_info(Path(path).expanduser()).info
    except OSError as error:
        raise ValueError(f"info: {error}") from error


def main() -> None:
    """Entry point of ``ros2 run tof_driver tof_driver``."""
    run_node(TofDriverNode)
