# SPDX-License-Identifier: Apache-2.0
"""Common parts of ``slam run``, ``slam nodes`` and ``slam live``: arguments, options, and their meaning."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import Any

import click

from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import ROLES
from slam_bringup.pipeline.configuration import MAPPERS, ODOMETRIES
from slam_bringup.pipeline.overrides import Overrides, read_overrides
from slam_bringup.terminal.paths import UserPath, calibration_option, overwrite_option, rig_option
from slam_viewer.results import RunResult
from stereo_frontend.fiducials.detector import DICTIONARIES
from stereo_frontend.frontend_config import MODES

_TOPICS = "slam_bringup.topics"


def _keep_topic(context: click.Context, option: click.Parameter, topic: str | None) -> None:
    if topic:
        role = str(option.name).removesuffix("_topic")
        context.meta.setdefault(_TOPICS, []).append(f"{role}={topic}")


def _with_kept(context: click.Context, _: click.Parameter, topics: tuple[str, ...]) -> tuple[str, ...]:
    """The topics given by role, with those of options such as ``--odometry-topic``, which are read before them."""
    return (*topics, *context.meta.get(_TOPICS, ()))


_TAGS = "slam_bringup.tags"
_TAG_PARAMETERS = {
    "tags": ("feature_extractor", "tags.dictionary"),
    "tag_size": ("feature_extractor", "tags.size"),
    "known_tags": ("sjsam", "tags.known"),
}
"""Node and parameter of each option about fiducial tags."""


def _keep_tags(context: click.Context, option: click.Parameter, value: Any) -> None:
    if value is not None:
        context.meta.setdefault(_TAGS, {})[option.name] = str(value.resolve()) if isinstance(value, Path) else value


def tag_parameters() -> dict[str, dict[str, Any]]:
    """Parameters by node that the command line's options about tags set."""
    found: dict[str, dict[str, Any]] = {}
    for option, value in click.get_current_context().meta.get(_TAGS, {}).items():
        node, name = _TAG_PARAMETERS[option]
        found.setdefault(node, {})[name] = value
    return found


def own_overrides(config: Path | None) -> Overrides:
    """Overrides of the user: those of a file, then those of options with a name of their own."""
    own = Overrides() if config is None else read_overrides(config)
    return own.with_values(tag_parameters(), "command line")


# fmt: off
_BAG_OPTIONS = (
    click.option(
        "-o", "--output", type=UserPath(file_okay=False), required=True, help="folder to write"
    ),
    click.option(
        "--mapper", type=click.Choice(MAPPERS), default="sjsam", show_default=True, help="one filter, or submaps"
    ),
    click.option("--imu", type=click.Choice(("auto", "on", "off")), help="use of an IMU [auto: if there is one]"),
    overwrite_option("results of another bag or command, or results that were changed since"),
)
_RIG_OPTIONS = (
    click.option("--mode", type=click.Choice(MODES), help="where depth comes from [stereo; tof without stereo]"),
    click.option("--odometry", type=click.Choice(ODOMETRIES), default="none", show_default=True, help="scan odometry"),
    click.option(
        "--config", type=UserPath(exists=True, dir_okay=False),
        help="YAML, one group per node, as in docs/parameters.md",
    ),
    click.option(
        "--odometry-topic", metavar="TOPIC", is_eager=True, expose_value=False, callback=_keep_topic,
        help="odometry of wheels, legs or another estimator (nav_msgs/Odometry) [odometry, if there is one]",
    ),
    click.option(
        "--position-topic", metavar="TOPIC", is_eager=True, expose_value=False, callback=_keep_topic,
        help="positions of UWB or GNSS in a fixed frame (geometry_msgs/PoseWithCovarianceStamped, docs/positions.md) "
        "[position, if there is one]",
    ),
    click.option(
        "--pressure-topic", metavar="TOPIC", is_eager=True, expose_value=False, callback=_keep_topic,
        help="air pressure of a barometer (sensor_msgs/FluidPressure, docs/storeys.md) [pressure, if there is one]",
    ),
    click.option(
        "--topic", "topics", multiple=True, metavar="ROLE=TOPIC", callback=_with_kept,
        help=f"a topic that is not named like the nodes' (may be repeated); roles: {', '.join(ROLES)}",
    ),
    calibration_option(),
    rig_option(),
    click.option(
        "--base-frame", default="", metavar="FRAME",
        help="the frame whose poses are wanted [base_link; else the root above the camera]",
    ),
    click.option(
        "--map", "old_map", type=UserPath(exists=True, file_okay=False),
        help="go on in the map of a finished run, which is only read: its folder OUT, or OUT/map",
    ),
    click.option(
        "--tags", type=click.Choice(DICTIONARIES), expose_value=False, callback=_keep_tags,
        help="fiducial tags to search for (docs/fiducials.md)",
    ),
    click.option(
        "--tag-size", type=float, metavar="M", expose_value=False, callback=_keep_tags,
        help="edge of a tag's black square, m [0.16]",
    ),
    click.option(
        "--known-tags", type=UserPath(exists=True, dir_okay=False), expose_value=False, callback=_keep_tags,
        help="YAML of tags whose poses in the building are known: the map is in that frame",
    ),
    click.option("--localize-only", is_flag=True, help="with --map: only find the way in that map"),
)
# fmt: on


def rig_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options that a rig needs, recorded or live."""
    return reduce(lambda decorated, option: option(decorated), reversed(_RIG_OPTIONS), command)


def mapping_options(*, many: bool = False) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command the argument BAG, or one or ``many`` of them, and the options of mapping."""
    bag = click.argument("bag", type=UserPath(exists=True))
    bags = click.argument("bags", nargs=-1, required=True, metavar="BAG...", type=UserPath(exists=True))
    options = (bags if many else bag, *_BAG_OPTIONS)
    return lambda command: reduce(lambda made, option: option(made), reversed(options), rig_options(command))


def worker_options(what: str = "") -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command the options that say where its tasks run; ``what`` begins their help."""
    scheduler = click.option(
        "--scheduler", metavar="ADDRESS",
        help=f"{what}run on the Dask cluster of this scheduler, tcp://HOST:8786 or tls://...",
    )  # fmt: skip
    workers = click.option(
        "--workers", type=click.IntRange(min=0), metavar="N",
        help=f"{what}processes on this machine; 0: in this one alone "
        "[as many as processors; 0 without the package distributed]",
    )  # fmt: skip
    return lambda command: scheduler(workers(command))


def map_folder(old: Path | None, *, localize_only: bool) -> Path | None:
    """Folder of the map that ``--map`` names: OUT/map of a run's folder OUT, else itself; None without one.

    Raises
    ------
    ValueError
        If there is none to locate in.
    """
    if old is None and localize_only:
        raise ValueError("--localize-only needs a map to locate in: name the folder of a finished run with --map")
    return old / "map" if old is not None and (old / "map").is_dir() else old


def mode_for(bag: SensorBag, mode: str | None) -> str:
    """The mode asked for, or the one that the bag's sensors suggest."""
    first_rig = next(iter(bag.rigs.values()))
    return mode or ("stereo" if any(bag.count(agent, "left") for agent in first_rig) else "tof")


def require_map(result: RunResult) -> None:
    """Refuse a run that has mapped nothing; the message says what became of the images."""
    if len(result.landmarks.positions) > 0:
        return
    losses = "; ".join((*(f"{count} x {reason}" for reason, count in result.dropped.items()), *result.events))
    if result.frames == 0:
        raise ValueError(f"not one frame of {result.bag} could be used: {losses or 'it has none'}")
    question = (
        "Is the depth in metres where it is floating point, and in millimetres where it is 16 bit?"
        if result.mode == "tof"
        else "Are left and right swapped, do the camera infos belong to these cameras?"
    )
    raise ValueError(
        f"nothing of {result.bag} was mapped in {result.frames} frames: {losses or 'too short'}. {question} "
        "slam doctor looks at the recording"
    )
