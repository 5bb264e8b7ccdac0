# SPDX-License-Identifier: Apache-2.0
"""Parameters of the views that an agent keeps."""

from __future__ import annotations

from dataclasses import dataclass

from slam_core.config import Config, parameter


@dataclass(frozen=True)
class ViewConfig(Config):
    """Pictures and dense key frames, kept at an agent until a post asks for them."""

    megabytes: float = parameter(
        200.0, "views that are kept on disk, at an agent and for each agent at a post, the oldest go first; "
        "0: none are kept at an agent, and it does not listen to its images", unit="MB", minimum=0.0,
    )  # fmt: skip
    distance: float = parameter(0.5, "an image is kept every so much way", unit="m", minimum=0.05)
    angle: float = parameter(20.0, "and from so much turn on", unit="deg", minimum=2.0, maximum=180.0)
    colours: bool = parameter(
        True, "pictures of the left camera are in colour where it has colours: its driver rectifies all for that; "
        "off: they are grey"
    )  # fmt: skip
    width: int = parameter(320, "pictures are halved until they are no wider", unit="px", minimum=32, maximum=2048)
    quality: int = parameter(40, "quality of the JPEG of a picture", unit="%", minimum=5, maximum=95)
    depth_pixels: int = parameter(
        19200, "depth images are thinned, every other pixel of every other row, until they have no more pixels",
        unit="px", minimum=1000, maximum=307200,
    )  # fmt: skip
