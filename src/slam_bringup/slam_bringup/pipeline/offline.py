r"""The chain of the launch file without ROS: the same classes, called frame by frame.

    readings of a bag -> depth -> features ----------> EKF-SLAM -> submaps -> SJSAM -> trajectory and map
                           \-> scan odometry (optional) --^

Reading, features, their depth, filter and joining run on a thread each. Every stage keeps its own order, so the result
does not depend on that.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Generator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from dense_mapping.surface import Surface
from slam_bringup.bags.readings import ImuReading, Reading
from slam_bringup.bags.sensor_bag import SensorBag
from slam_bringup.bags.sensor_topics import BagNames
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.dense_run import dense_model
from slam_bringup.pipeline.eyes import AgentEyes, FilterInput, Glimpse
from slam_bringup.pipeline.mapper import Mapper
from slam_bringup.pipeline.results import EMPTY_TRAJECTORY, AgentResult, LandmarkMap, RunResult
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.trajectory import Trajectory

T = TypeVar("T")
_LOG = logging.getLogger(__name__)
_AHEAD = 8
"""Images, or what became of them, that a stage may be ahead of the next."""


def run_bag(
    path: Path,
    config: SystemConfig,
    *,
    mapper: str = "sjsam",
    odometry: str = "none",
    names: BagNames | None = None,
    on_reading: Callable[[], None] = lambda: None,
    stopped: Callable[[], bool] = lambda: False,
) -> tuple[RunResult, Mapper]:
    """Map a bag, offline and as fast as it goes.

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
    on_reading
        Called after every reading of the bag, for a progress bar.
    stopped
        Asked after every reading: whether to end here, with what is mapped so far.

    Raises
    ------
    ValueError
        If the bag cannot be read or lacks what the mode needs.

    An error after the first frames ends the run early: the result holds what was mapped, and names it as ``failure``.
    """
    cv2.setNumThreads(1)  # every stage has a thread; OpenCV's own would only wait beside them, spinning
    times = StageTimes()
    start = time.perf_counter()
    with SensorBag(path, names) as bag:
        eyes = {agent: AgentEyes(config, bag.sensors[agent], odometry != "none", times) for agent in bag.agents}
        mapping = Mapper(config, {agent: e.T_rig_optical for agent, e in eyes.items()}, times)
        failure = ""
        try:
            try:
                for item in _ahead(_filter_inputs(bag, eyes, on_reading, stopped), _is_of_an_image):
                    mapping.process(item)
            except Exception as error:
                if not any(record.filtered for record in mapping.records.values()):
                    raise
                failure = _told(error, "the run ended early")
            mapping.finish()
        finally:
            mapping.stop()
        wall_s = time.perf_counter() - start
        dropped = dict(bag.left_out)
        agents = _agent_results(bag, mapping)
        dense = Surface.empty()
        try:
            if not stopped():  # who wants the end now does not want to wait for it
                with times.measure("dense model"):
                    dense = dense_model(bag, config, {a.name: a.trajectory for a in agents}).surface()
        except Exception as error:
            failure = failure or _told(error, "no dense model was made")
        mapping.records[bag.agents[0]].events[:0] = bag.warnings
    choice = (config.feature_extractor.mode, mapper, odometry)
    result = _run_result(path, choice, mapping, agents, dense, dropped, times, wall_s)
    return replace(result, failure=failure, events=(failure,) * bool(failure) + result.events), mapping


def _told(error: Exception, consequence: str) -> str:
    """An error as one line for a person; where it came from goes to the log."""
    _LOG.debug(consequence, exc_info=error)
    kind = "" if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: "
    return f"{consequence}: {kind}{error}"


def _filter_inputs(
    bag: SensorBag, eyes: dict[str, AgentEyes], on_reading: Callable[[], None], stopped: Callable[[], bool]
) -> Generator[FilterInput, None, None]:
    """Reading, finding features and measuring their depth, each on a thread of its own."""
    with closing(_ahead(_glimpses(bag, eyes, on_reading, stopped), _is_of_an_image)) as glimpses:
        for item in glimpses:
            yield eyes[item.agent].complete(item)


def _glimpses(
    bag: SensorBag, eyes: dict[str, AgentEyes], on_reading: Callable[[], None], stopped: Callable[[], bool]
) -> Generator[FilterInput | Glimpse, None, None]:
    with closing(_ahead(bag.readings(), _is_of_an_image)) as readings:
        for reading in readings:
            yield from eyes[reading.agent].process(reading)
            on_reading()
            if stopped():
                break
    for agent_eyes in eyes.values():
        yield from agent_eyes.finish()


def _is_of_an_image(item: Reading | FilterInput | Glimpse) -> bool:
    return not isinstance(item, ImuReading) and not (isinstance(item, FilterInput) and item.imu is not None)


def _ahead(items: Generator[T, None, None], ends_batch: Callable[[T], bool]) -> Generator[T, None, None]:
    """The same items, made by another thread a few batches ahead of their use.

    Handing over wakes threads: IMU samples, ten to a frame, go together with the image that they come before.
    """
    made: queue.Queue[tuple[list[T] | None, BaseException | None]] = queue.Queue(_AHEAD)
    stopped = threading.Event()

    def make() -> None:
        error: BaseException | None = None
        batch: list[T] = []
        with closing(items):
            try:
                for item in items:
                    batch.append(item)
                    if not ends_batch(item):
                        continue
                    made.put((batch, None))
                    batch = []
                    if stopped.is_set():
                        return
            except BaseException as caught:  # handed to the consumer, who raises it
                error = caught
        made.put((batch, None))
        made.put((None, error))

    thread = threading.Thread(target=make, name="images", daemon=True)
    thread.start()
    try:
        while True:
            ready, error = made.get()
            if error is not None:
                raise error
            if ready is None:
                return
            yield from ready
    finally:
        stopped.set()
        while thread.is_alive():  # it may wait for room; the bag must not be closed under it
            with suppress(queue.Empty):
                made.get(timeout=0.05)


def _agent_results(bag: SensorBag, mapping: Mapper) -> tuple[AgentResult, ...]:
    trajectories = mapping.global_map.trajectory()
    return tuple(
        AgentResult(
            name=agent,
            trajectory=Trajectory.from_estimates(trajectories.get(agent, [])),
            filtered=Trajectory.from_estimates(record.filtered),
            scan_odometry=Trajectory.from_estimates(record.scans),
            truth=bag.ground_truth(agent) or EMPTY_TRAJECTORY,
            feature_counts=np.array(record.feature_counts, dtype=np.int64),
        )
        for agent, record in mapping.records.items()
    )


def _run_result(
    path: Path,
    choice: tuple[str, str, str],
    mapping: Mapper,
    agents: tuple[AgentResult, ...],
    dense: Surface,
    dropped: dict[str, int],
    times: StageTimes,
    wall_s: float,
) -> RunResult:
    mode, mapper, odometry = choice
    landmarks = mapping.global_map.landmarks()
    stamps = [agent.filtered.stamps_ns for agent in agents if len(agent.filtered)]
    events = [f"{name}: {e}" if name else e for name, record in mapping.records.items() for e in record.events]
    return RunResult(
        bag=path.name,
        mode=mode,
        mapper=mapper,
        odometry=odometry,
        agents=agents,
        landmarks=LandmarkMap(landmarks.positions, landmarks.covariances, landmarks.sightings),
        dense=dense,
        submaps=len(mapping.reports),
        loop_closures=sum(len(report.closures) for report in mapping.reports),
        frames=sum(len(s) for s in stamps),
        dropped=dropped,
        rejections=mapping.rejections(),
        sensor_s=max((s[-1] - s[0]) / 1e9 for s in stamps) if stamps else 0.0,
        wall_s=wall_s,
        stage_ms=dict(times.ms),
        events=tuple(events),
        solver=next((r.solver for r in reversed(mapping.reports) if r.solver), ""),
    )
