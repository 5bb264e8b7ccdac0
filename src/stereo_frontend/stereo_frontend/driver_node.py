# SPDX-License-Identifier: Apache-2.0
"""The ``stereo_driver`` node: raw pairs from a camera, a video, a folder or topics; rectified pairs out.

With ``source: topics`` raw images and camera infos of any vendor's driver (or a bag) come in on
``stereo/{left,right}/image_raw`` and ``.../camera_info``. The other sources publish those topics themselves, with
camera infos from YAML files. ``stereo/{left,right}/set_camera_info`` writes new ones.
"""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from sensor_msgs.srv import SetCameraInfo

from slam_core.camera import CameraInfo
from slam_core.camera_info import CameraInfoFile, read_camera_info
from slam_core.config import Config, parameter
from slam_core.messages import (
    camera_info_from_message,
    camera_info_message,
    grey_and_colour_from_message,
    grey_from_message,
    header_message,
    image_message,
    stamp_ns,
)
from slam_core.messages.base import Message
from slam_core.nodes.base_node import SlamNode
from slam_core.nodes.calibration_watch import CalibrationWatch
from slam_core.nodes.frame_sources import SourceTimer
from slam_core.ros import run_node
from stereo_frontend.sources import FolderSource, RawPair, SideBySideSource
from stereo_frontend.stage import StereoStage
from stereo_frontend.stereo.calibrated_pairs import SIDES

_INFO_TOPIC = "stereo/{}/camera_info"
_COLOUR_TOPIC = "stereo/left/image_rect_color"


@dataclass(frozen=True)
class StereoDriverConfig(Config):
    """Source of the images and their calibration."""

    source: str = parameter("topics", "origin of the raw pairs", choices=("topics", "camera", "video", "folder"))
    path: str = parameter("0", "camera number or device, video file, or folder of images; unused with source topics")
    compressed: bool = parameter(False, "subscribe to image_raw/compressed instead of image_raw")
    left_info: str = parameter("", "camera_info YAML of the left camera; empty: from the topic")
    right_info: str = parameter("", "camera_info YAML of the right camera; empty: from the topic")
    left_frame: str = parameter("stereo_left_optical_frame", "frame of the left images of a camera, video or folder")
    right_frame: str = parameter("stereo_right_optical_frame", "frame of the right images of a camera, video or folder")
    rate: float = parameter(0.0, "pairs per second of a video or folder; 0: as recorded", unit="Hz", minimum=0.0)
    frame_width: int = parameter(0, "width asked of a camera for both images; 0 leaves it", unit="px", minimum=0)
    frame_height: int = parameter(0, "height asked of a camera; 0 leaves it", unit="px", minimum=0)


class StereoDriverNode(SlamNode[StereoDriverConfig]):
    """Publishes ``stereo/{left,right}/image_rect``; with a source of its own ``image_raw`` and ``camera_info`` too.

    ``image_rect`` is grey; of a colour camera there is ``stereo/left/image_rect_color`` beside it.
    """

    MAKES_AHEAD = False

    def __init__(self) -> None:
        super().__init__("stereo_driver", StereoDriverConfig)
        self.stage = StereoStage()
        self.calibrations = CalibrationWatch()
        self.files = {"left": self.config.left_info, "right": self.config.right_info}
        self.right_frame = self.config.right_frame
        self._open_files()
        for side in SIDES:
            self.advertise(f"stereo/{side}/image_rect", "Image")
            self.create_service(SetCameraInfo, f"stereo/{side}/set_camera_info", partial(self._on_set_info, side))
        self.advertise(_COLOUR_TOPIC, "Image")
        for side in filter(self.files.get, SIDES):
            self.advertise(_INFO_TOPIC.format(side), "CameraInfo", alone=True)
        self.source = None if self.config.source == "topics" else self._open_source()
        if self.source is None:
            self._listen_to_topics()
        else:
            self._start_source(self.source)

    def on_reset(self) -> None:
        """Forget what waits, and use the newest calibration."""
        self.stage.reset()
        for side, info in self.calibrations.restart().items():
            self.stage.set_info(side, info)

    def on_new_session(self) -> None:
        """Forget what waits; the map goes on, with its calibration."""
        self.stage.reset()

    def on_close(self) -> None:
        """Let go of the camera."""
        if self.source is not None:
            self.source.close()

    # -- topics --------------------------------------------------------------------------------------------------------

    def _listen_to_topics(self) -> None:
        for side in SIDES:
            if not self.files[side]:
                self.listen(f"stereo/{side}/camera_info", "CameraInfo", partial(self._on_info, side))
        ending, kind = ("/compressed", "CompressedImage") if self.config.compressed else ("", "Image")
        self.listen_together({f"stereo/{side}/image_raw{ending}": kind for side in SIDES}, self._on_pair)

    def _on_info(self, side: str, message: Message) -> None:
        info = camera_info_from_message(message)
        if self.calibrations.hear(side, info):
            self.stage.set_info(side, info)
        self._publish_rectified()

    def _on_pair(self, left: Message, right: Message) -> None:
        self.calibrations.require_unchanged()
        self.right_frame = right.header.frame_id
        grey, colour = grey_and_colour_from_message(left)
        self.stage.add(RawPair(stamp_ns(left), grey, grey_from_message(right), left.header.frame_id, colour))
        self._publish_rectified()

    # -- own sources ---------------------------------------------------------------------------------------------------

    def _open_source(self) -> SideBySideSource | FolderSource:
        if not all(self.files.values()):
            raise ValueError(
                f"source '{self.config.source}' needs the parameters left_info and right_info (YAML files)"
            )
        try:
            return self._make_source()
        except OSError as error:
            raise ValueError(str(error)) from error

    def _make_source(self) -> SideBySideSource | FolderSource:
        c = self.config
        if c.source == "folder":
            return FolderSource(Path(c.path).expanduser(), c.rate or 10.0)
        size = (c.frame_width, c.frame_height) if c.frame_width and c.frame_height else None
        clock = (lambda: int(self.get_clock().now().nanoseconds)) if c.source == "camera" else None
        return SideBySideSource(c.path, clock, size)

    def _start_source(self, source: SideBySideSource | FolderSource) -> None:
        for side in SIDES:
            self.advertise(f"stereo/{side}/image_raw", "Image")
        self._player = SourceTimer(self, source, self.config.rate or source.rate, self._publish_pair)

    def _publish_pair(self, pair: RawPair) -> None:
        frames = self.config.left_frame, self.config.right_frame
        for side, frame, image in zip(SIDES, frames, (pair.picture(), pair.right), strict=True):
            header = header_message(self.types, pair.stamp_ns, frame)
            encoding = "mono8" if image.ndim == 2 else "rgb8"
            self.publish(f"stereo/{side}/image_raw", image_message(self.types, header, image, encoding))
        self.stage.add(replace(pair, frame_id=self.config.left_frame))
        self._publish_rectified()

    # -- both ----------------------------------------------------------------------------------------------------------

    def _publish_rectified(self) -> None:
        """Both rectified images, with the left one's stamp: they are one instant; camera infos that come from files."""
        for images in self.stage.ready():
            frames = images.frame_id, self.right_frame
            infos = self.stage.infos
            assert infos is not None
            for side, frame, image, info in zip(SIDES, frames, (images.left, images.right), infos, strict=True):
                header = header_message(self.types, images.stamp_ns, frame)
                if self.files[side]:
                    self.publish(_INFO_TOPIC.format(side), camera_info_message(self.types, header, info))
                self.publish(f"stereo/{side}/image_rect", image_message(self.types, header, image))
            colour = images.colour() if self.has_listeners(_COLOUR_TOPIC) else None
            if colour is not None:
                header = header_message(self.types, images.stamp_ns, images.frame_id)
                self.publish(_COLOUR_TOPIC, image_message(self.types, header, colour, "rgb8"))
        self.health.take(self.stage.counters)

    # -- calibration ---------------------------------------------------------------------------------------------------

    def _open_files(self) -> None:
        for side, path in self.files.items():
            if path:
                try:
                    self.stage.set_info(side, read_camera_info(Path(path).expanduser()).info)
                except OSError as error:
                    raise ValueError(f"{side}_info: {error}") from error

    def _on_set_info(self, side: str, request: Any, response: Any) -> Any:
        try:
            response.status_message = self._store_info(side, camera_info_from_message(request.camera_info))
            response.success = True
        except (ValueError, OSError) as error:
            response.success, response.status_message = False, str(error)
        return response

    def _store_info(self, side: str, info: CameraInfo) -> str:
        if not self.files[side]:
            raise ValueError(
                f"the {side} camera info comes from its topic: set the parameter {side}_info to a YAML file"
            )
        CameraInfoFile(info, side).write(Path(self.files[side]).expanduser())
        self.stage.set_info(side, info)
        return f"written to {self.files[side]} and in use; begin a new map, and reset feature_extractor (~/reset)"


def main() -> None:
    """Entry point of ``ros2 run stereo_frontend stereo_driver``."""
    run_node(StereoDriverNode)
