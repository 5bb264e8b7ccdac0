# SPDX-License-Identifier: Apache-2.0
r"""The chain of the launch file without ROS: the same classes, called frame by frame.

    readings of a bag -> depth -> features ----------> EKF-SLAM -> submaps -> SJSAM -> trajectory and map
                           \-> scan odometry (optional) --^

Reading, features, their depth, filter and joining run on a thread each. Every stage keeps its own order, so the result
does not depend on that.
"""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Callable, Generator
from contextlib import closing
from pathlib import Path

import cv2

from sjsam_node.session.map_session import MapSession
from slam_bags.reading.readings import AirReading, FixReading, ImuReading, PoseReading, Reading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.mapper import Mapper
from slam_bringup.pipeline.prefetch import IMAGES_AHEAD, prefetch
from slam_bringup.pipeline.run_record import describe_error, run_result
from slam_bringup.pipeline.sensor_pipeline import AgentItem, SensorPipeline, rig_pipelines
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.runtime.memory import leave_libraries, trim_heap
from slam_core.types import ImuSample, OdometryReading, PositionReading, PressureReading
from slam_viewer.results import RunResult

_LOG = logging.getLogger(__name__)
_BESIDE_IMAGES = (
    ImuReading | ImuSample | PoseReading | OdometryReading | FixReading | PositionReading | AirReading | PressureReading
)
_FEATURES_AHEAD = 8
"""Frames with features that may wait for the filter, which takes longer where a submap ends."""


def run_bag(
    path: Path,
    config: SystemConfig,
    *,
    mapper: str = "sjsam",
    odometry: str = "none",
    names: BagNames | None = None,
    session: MapSession | None = None,
    on_reading: Callable[[], None] = lambda: None,
    stopped: Callable[[], bool] = lambda: False,
    on_mapped: Callable[[RunResult], None] = lambda result: None,
) -> tuple[RunResult, MapSession]:
    """The result of mapping a bag, offline and as fast as it goes, and the session of its map.

    Parameters
    ----------
    path
        The bag.
    config
        Already adapted to mode, mapper and odometry by :func:`slam_bringup.pipeline.configuration.choose`.
    mapper, odometry
        Named in the result; ``odometry`` other than "none" runs scan odometry as well.
    names
        Topics and frames of the bag that are not named like the nodes' own.
    session
        What becomes of the submaps; by default they are joined into a new map.
    on_reading
        Called after every reading of the bag, and again when the dense model has seen it, for a progress bar.
    stopped
        Asked after every reading: whether to end here, with what is mapped so far and without a dense model.
    on_mapped
        Called with the result without a dense model, before that is made.

    Raises
    ------
    ValueError
        If the bag cannot be read or lacks what the mode needs.

    An error after the first frames ends the run early: the result holds what was mapped, and names it as ``failure``.
    """
    _LOG.info("%s: mode %s, mapper %s, odometry %s", path, config.feature_extractor.mode, mapper, odometry)
    cv2.setNumThreads(1)  # every stage has a thread; OpenCV's own would only wait beside them, spinning
    times = StageTimes()
    start = time.perf_counter()
    with SensorBag(path, names) as bag:
        leave_libraries()  # which modules were loaded with; kernels take as much
        trim_heap()
        pipelines = _pipelines(bag, config, odometry != "none", times)
        mapping = Mapper(config, bag.sensors, times, session or MapSession(config.sjsam))
        failure = _map(mapping, _measured(bag, pipelines, on_reading, stopped))
        record = mapping.record(time.perf_counter() - start, dict(bag.left_out), failure)
        record = record.with_front_ends(
            {agent: pipeline.front_end() for agent, pipeline in pipelines.items()},
            {agent: pipeline.log.frames for agent, pipeline in pipelines.items()},
            bag.rigs,
        )
        _LOG.info("mapped %d submaps in %.1f s; the dense model is next", record.submaps, record.wall_s)
        session = mapping.session
        del pipelines, mapping  # with their images and filters, 60 MB in cycles
        gc.collect()
        trim_heap()
        with times.measure("dense model"):
            result = run_result(
                bag,
                config,
                record,
                mapper=mapper,
                odometry=odometry,
                on_reading=on_reading,
                stopped=stopped,
                on_mapped=on_mapped,
            )
    return result, session


def _pipelines(bag: SensorBag, config: SystemConfig, odometry: bool, times: StageTimes) -> dict[str, SensorPipeline]:
    """The pipelines of all cameras of all rigs."""
    pipelines: dict[str, SensorPipeline] = {}
    for agents in bag.rigs.values():
        pipelines |= rig_pipelines(config, [bag.sensors[agent] for agent in agents], odometry, times)
    return pipelines


def _map(mapping: Mapper, items: Generator[AgentItem, None, None]) -> str:
    """Map all items; the reason is returned if an error ended the run early, and raised before the first frame."""
    failure = ""
    try:
        for item in prefetch(items, _is_of_an_image, _FEATURES_AHEAD):
            mapping.process(item)
    except Exception as error:
        if not mapping.has_frames:
            raise
        failure = describe_error(error, "the run ended early")
    trim_heap()
    mapping.finish()
    return failure


def _measured(
    bag: SensorBag, pipelines: dict[str, SensorPipeline], on_reading: Callable[[], None], stopped: Callable[[], bool]
) -> Generator[AgentItem, None, None]:
    """Reading, finding features and measuring their depth, each on a thread of its own."""
    with closing(prefetch(_extracted(bag, pipelines, on_reading, stopped), _is_of_an_image, IMAGES_AHEAD)) as items:
        for item in items:
            yield pipelines[item.agent].measure(item)


def _extracted(
    bag: SensorBag, pipelines: dict[str, SensorPipeline], on_reading: Callable[[], None], stopped: Callable[[], bool]
) -> Generator[AgentItem, None, None]:
    with closing(prefetch(bag.readings(), _is_of_an_image, IMAGES_AHEAD)) as readings:
        for reading in readings:
            yield from pipelines[reading.agent].add(reading)
            on_reading()
            if stopped():
                break
    for pipeline in pipelines.values():
        yield from pipeline.finish()


def _is_of_an_image(item: Reading | AgentItem) -> bool:
    value = item.value if isinstance(item, AgentItem) else item
    return not isinstance(value, _BESIDE_IMAGES)
