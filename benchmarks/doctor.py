# SPDX-License-Identifier: Apache-2.0
"""What ``slam doctor`` says of faulted copies of a good bag, and of good bags, of which it must say nothing.

    python benchmarks/doctor.py [BAG] [--rgbd BAG] [--good BAG ...]

BAG (bags/demo) has stereo, ToF and perhaps an IMU; its first six seconds are copied with one fault at a time.
``--rgbd``: a bag of a depth camera alone, for the fault that only such a bag can have. Prints a table: fault, what
should be said, whether it was, and what else was said.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from slam_bags.storage.bag import BagReader, BagWriter
from slam_bags.storage.bag_types import BagTypes
from slam_bringup.doctor.examination import examine
from slam_core.messages import grey_from_message, image_from_message, image_message

ROOT = Path(__file__).resolve().parent.parent
SECONDS = 6.0
TYPES = BagTypes()


@dataclass
class Item:
    """A message on its way into the copy."""

    topic: str
    time_ns: int
    message: Any

    def is_of(self, *parts: str) -> bool:
        """Whether the topic holds one of ``parts``."""
        return any(part in self.topic for part in parts)

    @property
    def image(self) -> np.ndarray:
        """The pixels."""
        return image_from_message(self.message)

    def with_image(self, image: np.ndarray) -> Item:
        """The same with other pixels."""
        encoding = self.message.encoding if image.dtype == self.image.dtype else ""
        return Item(self.topic, self.time_ns, image_message(TYPES, self.message.header, image, encoding))

    def moved(self, seconds: float) -> Item:
        """The same with a later stamp."""
        stamp = self.message.header.stamp
        total = stamp.sec * 10**9 + stamp.nanosec + round(seconds * 1e9)
        stamp.sec, stamp.nanosec = divmod(total, 10**9)
        return self


Change = Callable[[Item, int], Item | list[Item] | None]
"""Of an item and its number on its topic to what takes its place."""


def on(*parts: str) -> Callable[[Callable[[Item, int], Any]], Change]:
    """Only items whose topic holds one of ``parts`` are changed."""

    def decorate(change: Callable[[Item, int], Any]) -> Change:
        return lambda item, number: change(item, number) if item.is_of(*parts) else item

    return decorate


@on("stereo/left", "stereo/right")
def swapped(item: Item, _: int) -> Any:
    if item.is_of("camera_info"):
        return item
    other = ("left", "right") if item.is_of("left") else ("right", "left")
    return Item(item.topic.replace(*other), item.time_ns, item.message)


def scaled_baseline(factor: float) -> Change:
    @on("stereo/right/camera_info")
    def change(item: Item, _: int) -> Any:
        item.message.p = item.message.p * np.where(np.arange(12) == 3, factor, 1.0)
        return item

    return change


@on("stereo/left", "stereo/right")
def raw_called_rect(item: Item, _: int) -> Any:
    return Item(item.topic.replace("image_raw", "image_rect"), item.time_ns, item.message)


def turned(side: str, angle_deg: float) -> Change:
    @on(f"stereo/{side}/image")
    def change(item: Item, _: int) -> Any:
        image = grey_from_message(item.message)
        centre = (image.shape[1] / 2, image.shape[0] / 2)
        R = cv2.getRotationMatrix2D(centre, angle_deg, 1.0)
        return item.with_image(cv2.warpAffine(image, R, image.shape[::-1], borderMode=cv2.BORDER_REFLECT))

    return change


@on("tof/range", "tof/depth")
def millimetres_as_metres(item: Item, _: int) -> Any:
    image = item.image
    return item.with_image(image.astype(np.float32) * np.float32(1000.0 if image.dtype != np.uint16 else 1.0))


@on("tof/range", "tof/depth")
def metres_as_millimetres(item: Item, _: int) -> Any:
    image = item.image
    metres = image * 0.001 if image.dtype == np.uint16 else image
    return item.with_image(np.nan_to_num(metres).astype(np.uint16))


@on("tof/range", "tof/depth")
def a_quarter_too_far(item: Item, _: int) -> Any:
    return item.with_image((item.image * 1.25).astype(item.image.dtype))


@on("tof/range", "tof/depth")
def empty_depth(item: Item, _: int) -> Any:
    return item.with_image(np.zeros_like(item.image))


def late(seconds: float, *parts: str) -> Change:
    return on(*parts)(lambda item, _: item.moved(seconds))


@on("tof/")
def third_and_late(item: Item, number: int) -> Any:
    return item.moved(0.15) if number % 3 == 0 else None


def without(*parts: str) -> Change:
    return on(*parts)(lambda item, _: None)


def every_camera_frame(change: Callable[[Any], None]) -> Change:
    @on("/tf_static")
    def apply(item: Item, _: int) -> Any:
        for transform in item.message.transforms:
            change(transform)
        return item

    return apply


def unturned(transform: Any) -> None:
    if "optical" in transform.child_frame_id:
        q = transform.transform.rotation
        q.x, q.y, q.z, q.w = 0.0, 0.0, 0.0, 1.0


def moved_tof(transform: Any) -> None:
    if "tof" in transform.child_frame_id:
        transform.transform.translation.y += 0.3
        transform.transform.translation.z += 0.2


def far_away(transform: Any) -> None:
    t = transform.transform.translation
    t.x, t.y, t.z = 1000 * t.x, 1000 * t.y, 1000 * t.z + 50


def turned_imu(transform: Any) -> None:
    if "imu" in transform.child_frame_id:
        q = transform.transform.rotation
        q.x, q.y, q.z, q.w = np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)


@on("stereo/left/camera_info", "stereo/left/image")
def another_frame(item: Item, _: int) -> Any:
    item.message.header.frame_id = "camera_infra1"
    return item


@on("stereo/")
def uneven(item: Item, _: int) -> Any:
    stamp = item.message.header.stamp
    seconds = stamp.sec + stamp.nanosec * 1e-9
    return item.moved(0.35 * np.sin(1.9 * seconds))


def dropped(share: int) -> Change:
    @on("stereo/")
    def change(item: Item, _: int) -> Any:
        stamp = item.message.header.stamp
        number = round((stamp.sec + stamp.nanosec * 1e-9) * 20)
        return None if (number * 2654435761 >> 7) % 100 < share else item

    return change


@on("stereo/left/image", "stereo/right/image")
def flickering(item: Item, number: int) -> Any:
    return item.with_image((item.image * (0.6 if number % 2 else 1.0)).astype(np.uint8))


@on("stereo/left/image")
def underexposed(item: Item, _: int) -> Any:
    return item.with_image((item.image * 0.4).astype(np.uint8))


@on("stereo/left/image")
def covered(item: Item, _: int) -> Any:
    return item.with_image((item.image * 0.01).astype(np.uint8))


@on("stereo/left/image", "stereo/right/image")
def half_size(item: Item, _: int) -> Any:
    return item.with_image(item.image[::2, ::2].copy())


@on("imu")
def in_g(item: Item, _: int) -> Any:
    a = item.message.linear_acceleration
    a.x, a.y, a.z = a.x / 9.81, a.y / 9.81, a.z / 9.81
    return item


@on("imu")
def in_degrees(item: Item, _: int) -> Any:
    w = item.message.angular_velocity
    w.x, w.y, w.z = np.degrees(w.x) + 30.0, np.degrees(w.y), np.degrees(w.z)
    return item


@on("stereo/", "tof/")
def set_back(item: Item, number: int) -> Any:
    return item.moved(-2.0) if number > 15 else item


@on("stereo/left")
def without_stamp(item: Item, _: int) -> Any:
    item.message.header.stamp.sec = item.message.header.stamp.nanosec = 0
    return item


@on("stereo/left/image")
def broken(item: Item, _: int) -> Any:
    item.message.encoding = "hsv8"
    return item


@on("tof/amplitude")
def shifted_picture(item: Item, _: int) -> Any:
    return item.with_image(np.roll(item.image, 14, axis=1))


class Frozen:
    """Every image of the left camera but the first of four is the one before."""

    def __init__(self) -> None:
        self.last: Any = None

    def __call__(self, item: Item, number: int) -> Any:
        """As :data:`Change`."""
        if not item.is_of("stereo/left/image"):
            return item
        if self.last is None or number % 4 == 0:
            self.last = item.image
        return item.with_image(self.last)


class Twice:
    """The left camera's image on both topics."""

    def __init__(self) -> None:
        self.last: Any = None

    def __call__(self, item: Item, _: int) -> Any:
        """As :data:`Change`."""
        if item.is_of("stereo/left/image"):
            self.last = item.image
        return item.with_image(self.last) if item.is_of("stereo/right/image") and self.last is not None else item


FAULTS: dict[str, tuple[str, Change]] = {
    "left and right images exchanged": ("left and right swapped", swapped),
    "baseline with the wrong sign": ("baseline", scaled_baseline(-1.0)),
    "no baseline in the right info": ("baseline", scaled_baseline(0.0)),
    "baseline in millimetres": ("baseline unit", scaled_baseline(1000.0)),
    "raw images called rect": ("not rectified", raw_called_rect),
    "right camera turned by 1.5 deg": ("not rectified", turned("right", 1.5)),
    "right camera upside down": ("nothing in common", turned("right", 180.0)),
    "one camera on both topics": ("one camera twice", Twice()),
    "images of half the size": ("image size", half_size),
    "depth in mm given as m": ("depth unit", millimetres_as_metres),
    "depth in m given as mm": ("depth unit|no depth", metres_as_millimetres),
    "depth 25 % too far": ("depth scale", a_quarter_too_far),
    "depth camera sees nothing": ("no depth", empty_depth),
    "depth camera's mounting 36 cm off": ("depth elsewhere|depth scale", every_camera_frame(moved_tof)),
    "right images 20 ms late": ("stereo stamps apart", late(0.02, "stereo/right")),
    "depth at a third of the rate, 150 ms late": ("depth stamps apart", third_and_late),
    "depth camera's clock an hour ahead": ("two clocks", late(3600.0, "tof/")),
    "images offered best effort": ("best effort", lambda item, _: item),
    "left camera info missing": ("missing camera info", without("stereo/left/camera_info")),
    "right images missing": ("missing images", without("stereo/right")),
    "static transforms missing": ("missing transforms", without("/tf_static")),
    "optical frames without their turn": ("optical frame", every_camera_frame(unturned)),
    "mountings in millimetres": ("mounting", every_camera_frame(far_away)),
    "frame_id that nobody knows": ("unknown frame", another_frame),
    "rate that comes and goes": ("uneven rate", uneven),
    "12 % of the frames dropped": ("lost frames", dropped(12)),
    "exposure that flickers": ("flicker", flickering),
    "left camera underexposed": ("exposed apart", underexposed),
    "left camera covered": ("dark", covered),
    "left camera repeats images": ("frozen camera", Frozen()),
    "time goes back by 2 s": ("time goes back", set_back),
    "left images without stamps": ("no stamp", without_stamp),
    "unknown encoding": ("broken messages", broken),
    "accelerometer in g": ("accelerometer unit", in_g),
    "gyroscope in degrees": ("gyroscope unit", in_degrees),
    "IMU turned by 90 deg": ("gravity", every_camera_frame(turned_imu)),
}
RGBD_FAULTS: dict[str, tuple[str, Change]] = {"picture 14 px beside its depth": ("not registered", shifted_picture)}


def copy(source: Path, target: Path, change: Change, *, best_effort: bool = False) -> Path:
    """The first seconds of a bag, changed; compressed images become raw ones."""
    numbers: dict[str, Iterator[int]] = {}
    with BagReader(source) as old, BagWriter(target) as new:
        types = {name: info.type_name for name, info in old.topics.items()}
        declared: set[str] = set()
        for topic, time, data in old.raw():
            if time > old.start_ns + SECONDS * 1e9:
                break
            item = raw(Item(topic, time, old.decode(types[topic], data)))
            changed = change(item, next(numbers.setdefault(item.topic, count())))
            for out in [changed] if isinstance(changed, Item) else changed or []:
                if best_effort and "image" in out.topic and out.topic not in declared:
                    new.declare(out.topic, out.message.__msgtype__, best_effort=True)
                    declared.add(out.topic)
                new.write(out.topic, out.message, out.time_ns)
    return target


def raw(item: Item) -> Item:
    if not hasattr(item.message, "format"):
        return item
    image = image_message(TYPES, item.message.header, grey_from_message(item.message))
    return Item(item.topic.removesuffix("/compressed"), item.time_ns, image)


def says(bag: Path) -> list[str]:
    """Names of the checks that find something, a bag that cannot be examined included."""
    try:
        return list(dict.fromkeys(finding.check for finding in examine(bag)))
    except ValueError as error:
        return [f"refused: {error}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", nargs="?", type=Path, default=ROOT / "bags" / "demo")
    parser.add_argument("--rgbd", type=Path, help="a bag of a depth camera with pictures of the same size")
    parser.add_argument("--good", type=Path, nargs="*", default=[], help="bags of which nothing must be said")
    parser.add_argument("--only", default="", help="faults whose name holds this text")
    arguments = parser.parse_args()
    table = Table("fault", "should be said", "said", "also said")
    missed = tried = 0
    with BagReader(arguments.bag) as bag:
        has_imu = any(topic.endswith("imu") for topic in bag.topics)
    plan = [(arguments.bag, *row) for row in FAULTS.items()]
    plan += [(arguments.rgbd, *row) for row in RGBD_FAULTS.items()] if arguments.rgbd else []
    with tempfile.TemporaryDirectory() as folder:
        for source, fault, (wanted, change) in plan:
            if arguments.only not in fault or ("IMU" in fault or "meter" in fault or "gyro" in fault) > has_imu:
                continue
            target = Path(folder) / "faulted"
            found = says(copy(source, target, change, best_effort=wanted == "best effort"))
            hits = [name for name in found if name in wanted.split("|")]
            missed += not hits
            tried += 1
            table.add_row(fault, wanted, "yes" if hits else "MISSED", ", ".join(n for n in found if n not in hits))
        for good in arguments.good:
            table.add_row(
                f"none: {good.name}", "nothing", "nothing" if not (found := says(good)) else "", ", ".join(found)
            )
    Console(width=140).print(table)
    print(f"{missed} of {tried} missed")


if __name__ == "__main__":
    main()
