# SPDX-License-Identifier: Apache-2.0
"""Processor time of the rectified colour images that a stereo driver makes for an agent's ``radio_link``.

    python benchmarks/radio/colour_pictures.py [--size 640 480] [--images 300]

Made-up images and a lens with distortion. Prints for a colour image: to rectify it and to make its message (all that
there is in one process, where messages are handed on by reference), to serialise it in the driver and to deserialise it
in the ``radio_link`` (of processes of their own; what the middleware does between them is left out); then those two
for the grey image, which ``radio_link`` hears anyway. Milliseconds, medians. Needs ROS.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

from slam_core.camera import Camera, CameraInfo
from slam_core.messages import header_message, image_message
from slam_core.ros import RosTypes
from stereo_frontend.stereo.rectify import Rectifier


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--images", type=int, default=300)
    arguments = parser.parse_args()
    width, height = arguments.size
    lens = Camera(width, height, 0.7 * width, 0.7 * width, width / 2, height / 2, "plumb_bob", (-0.28, 0.07, 0.0, 0.0))
    rectifier, types = Rectifier(CameraInfo(lens)), RosTypes()
    rng = np.random.default_rng(1)
    pictures = [rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(8)]
    times: dict[str, list[float]] = {}

    def timed(name: str, action: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = action()
        times.setdefault(name, []).append(1e3 * (time.process_time() - start))
        return result

    for k in range(arguments.images):
        picture, header = pictures[k % len(pictures)], header_message(types, k, "left")
        colour = timed("rectified", lambda p=picture: rectifier.colour(p))
        message = timed("message", lambda c=colour, h=header: image_message(types, h, c, "rgb8"))
        data = timed("serialised", lambda m=message: serialize_message(m))
        timed("deserialised", lambda d=data: deserialize_message(d, types.Image))
        grey = image_message(types, header, np.ascontiguousarray(picture[..., 0]))
        data = timed("serialised, grey", lambda m=grey: serialize_message(m))
        timed("deserialised, grey", lambda d=data: deserialize_message(d, types.Image))
    print(f"{width} x {height} px: " + ", ".join(f"{name} {np.median(values):.2f}" for name, values in times.items()))


if __name__ == "__main__":
    main()
