# SPDX-License-Identifier: Apache-2.0
"""The stereo front end without ROS, in two stages: raw pairs to rectified ones, and these, with depth, to features.

RawPair -> StereoStage -> StereoImages --> FeatureStage -> Features
                     DepthImage, Mask -----^
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from slam_core.camera import CameraInfo
from slam_core.frame_tree import FrameTree
from slam_core.types import DepthImage, Features, Mask, StereoImages
from stereo_frontend.depth.tof_features import CLIP, GAMMA, normalised_picture
from stereo_frontend.fiducials.tag_features import TagFeatures
from stereo_frontend.frontend import Frontend
from stereo_frontend.frontend_config import FrontendConfig, FrontendReport
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.masks import Masking
from stereo_frontend.nearest_pairing import NearestPairing
from stereo_frontend.sources import RawPair
from stereo_frontend.stereo.calibrated_pairs import CalibratedPairs
from stereo_frontend.stereo.corrected_info import corrected_right
from stereo_frontend.stereo.rectification_error import RectificationError
from stereo_frontend.stereo.rectify import StereoRectifier


class StereoStage:
    """Rectifies pairs, oldest first, once both camera infos are known.

    Parameters
    ----------
    rectified
        The pairs are rectified already and the infos' P describes them: they are checked and passed through.
    """

    def __init__(self, *, rectified: bool = False) -> None:
        self._rectified = rectified
        self._pairs = CalibratedPairs[RawPair]()
        self._rectifier: StereoRectifier | None = None
        self._error: RectificationError | None = None

    @property
    def infos(self) -> tuple[CameraInfo, CameraInfo] | None:
        """Left and right camera info in use; None until both are known."""
        return self._pairs.infos

    @property
    def counters(self) -> dict[str, int]:
        """Counts of what was dropped, by name."""
        return {"pairs_without_camera_info": self._pairs.dropped}

    def set_info(self, side: str, info: CameraInfo) -> None:
        """Use a calibration of "left" or "right"."""
        if self._pairs.set_info(side, CameraInfo(info.rectified, P=info.P) if self._rectified else info):
            self._rectifier = None

    def correct(self, error: RectificationError | None) -> None:
        """Rectify with the infos' error taken out, from the next pair on; None: with the infos as they are."""
        self._error, self._rectifier = error, None

    def add(self, pair: RawPair) -> None:
        """Take a pair; :meth:`ready` returns it rectified."""
        self._pairs.add(pair)

    def ready(self) -> Iterator[StereoImages]:
        """The pairs whose calibration is known.

        Raises
        ------
        ValueError
            If the infos do not describe a stereo pair, or an image does not fit them; the pairs after it are kept.
        """
        while self.infos is not None and (pair := self._pairs.pop()) is not None:
            if self._rectifier is None:
                left, right = self.infos
                right = right if self._error is None else corrected_right(right, self._error)[0]
                self._rectifier = StereoRectifier(left, right)
            yield self._rectifier(pair.stamp_ns, pair.left, pair.right, pair.colour, pair.frame_id)

    def reset(self) -> None:
        """Forget what waits; the calibration stays."""
        self._pairs.clear()


@dataclass(frozen=True, eq=False)
class ExtractedFrame:
    """One instant whose keypoints are found but not yet measured: :meth:`FeatureStage.measure` does that."""

    images: StereoImages | None
    depth: DepthImage | None
    keypoints: tuple[Keypoints, Keypoints] | None


class FeatureStage:
    """Brings pairs and depth images together as the mode asks, and finds features in them.

    Parameters
    ----------
    frames
        Knows where the depth camera sits beside the left one, in modes ``replace`` and ``fuse``.
    """

    def __init__(self, config: FrontendConfig, frames: FrameTree) -> None:
        self._mode = config.mode
        self._frames = frames
        self._frontend = Frontend(config)
        self._tags = TagFeatures(config.tags) if config.tags.is_used else None
        self._masking = Masking(config.mask)
        self._pairing = NearestPairing[StereoImages, DepthImage]("depth image", config.fusion.max_age)
        self._ready: deque[tuple[StereoImages | None, DepthImage | None]] = deque()

    @property
    def counters(self) -> dict[str, int]:
        """Counts of what was accepted and rejected, by name."""
        masked = {"keypoints_masked": self._frontend.masked} if self._masking.counters.counts else {}
        tags = {} if self._tags is None else self._tags.counters.counts
        return self._frontend.counters.counts | self._masking.counters.counts | masked | tags

    def report(self) -> FrontendReport:
        """Findings of the front end about the images so far."""
        report = self._frontend.report()
        advice = "" if self._tags is None else self._tags.advice
        return replace(report, advice=(*report.advice, advice)) if advice else report

    @property
    def diagnostic(self) -> str:
        """Reason for which features lack depth or a mask that they should have, or have bad depth, or ""."""
        clock = self._frontend.pair_clock.diagnostic
        return "; ".join(filter(None, (self._pairing.diagnostic, self._masking.diagnostic, clock)))

    @property
    def oldest_waiting_ns(self) -> int | None:
        """Stamp of the oldest frame that waits for a depth image or a mask."""
        stamps = (self._pairing.oldest_waiting_ns, self._masking.oldest_waiting_ns)
        return min((stamp for stamp in stamps if stamp is not None), default=None)

    def add_images(self, images: StereoImages) -> None:
        """Take a rectified pair, which may have to wait for a depth image or a mask."""
        if self._mode != "tof":
            self._take(self._masking.add_frame(images))

    def add_depth(self, depth: DepthImage) -> None:
        """Take a depth image."""
        if self._mode == "tof":
            self._take(self._masking.add_frame(depth))
        elif self._mode != "stereo":
            self._ready += self._pairing.add_companion(depth)

    def add_mask(self, mask: Mask) -> None:
        """Take a mask of the left image, in mode ``tof`` of the depth image."""
        self._take(self._masking.add_mask(mask))

    def _take(self, frames: Iterable[StereoImages | DepthImage]) -> None:
        """Frames that have their masks go on, pairs to wait for a depth image if they have to."""
        for frame in frames:
            if isinstance(frame, DepthImage):
                self._ready.append((None, frame))
            elif self._mode == "stereo":
                self._ready.append((frame, None))
            else:
                self._ready += self._pairing.add_frame(frame)

    def extracted(self) -> Iterator[ExtractedFrame]:
        """Yield the frames that need not wait any more, with their keypoints, oldest first."""
        while self._ready:
            images, depth = self._ready.popleft()
            yield ExtractedFrame(images, depth, self._frontend.extract(images))

    def measure(self, frame: ExtractedFrame) -> Features:
        """Features of an extracted frame, in the order of :meth:`extracted`; may run in another thread than that.

        Raises
        ------
        ValueError
            If the images contradict each other, or the mounting of the depth camera is not known.
        """
        images, depth = frame.images, frame.depth
        T_left_tof = None
        if images is not None and depth is not None:
            T_left_tof = self._frames.lookup(images.frame_id, depth.frame_id)
        features = self._frontend.measure(frame.keypoints, images, depth, T_left_tof)
        source = images or depth
        assert source is not None
        return self._with_tags(replace(features, frame_id=source.frame_id), images, depth)

    def _with_tags(self, features: Features, images: StereoImages | None, depth: DepthImage | None) -> Features:
        """The features and the fiducial tags of the left image, or of a depth camera without one.

        Tags are landmarks: a frame that tells the pose alone measures none.
        """
        if self._tags is None or features.is_pose_only:
            return features
        if images is not None:
            return self._tags.with_tags(
                features, self._tags.of_pair(images, self._frontend.self_calibration, self._frontend.pair_clock)
            )
        grey = None if depth is None else next((g for g in (depth.intensity, depth.amplitude) if g is not None), None)
        if depth is None or grey is None:
            return features
        picture = normalised_picture(grey, CLIP, GAMMA)
        return self._tags.with_tags(features, self._tags.of_depth(depth, picture))

    def give_up(self) -> None:
        """Let go on what waits for a depth camera or for masks that a live node has not heard for long."""
        self._take(self._masking.give_up())
        self._ready += self._pairing.give_up()

    def finish(self) -> None:
        """The input has ended: nothing waits any more."""
        self._take(self._masking.flush())
        self._ready += self._pairing.flush()

    def reset(self) -> None:
        """Forget thresholds, noise and what waits."""
        self._frontend.reset()
        if self._tags is not None:
            self._tags = TagFeatures(self._tags.config)
        self.clear()

    def clear(self) -> None:
        """Forget what waits, while another thread may measure."""
        self._masking.clear()
        self._pairing.clear()
        self._ready.clear()
