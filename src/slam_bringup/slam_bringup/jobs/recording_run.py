# SPDX-License-Identifier: Apache-2.0
"""The work of ``slam run`` on one recording: from the bag to the folder of results, in this process or on a worker."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from sjsam_node.session.map_session import MapSession, Mode
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames
from slam_bringup.doctor.examination import require_stereo
from slam_bringup.pipeline.configuration import SystemConfig, choose, overrides_for, system_config, with_files
from slam_bringup.pipeline.offline import run_bag
from slam_bringup.pipeline.overrides import Overrides
from slam_bringup.processes.interrupt import MAP, giving_up
from slam_bringup.terminal.console import LOG_NAME, Transcript
from slam_bringup.terminal.mapping_options import map_folder, mode_for, require_map
from slam_core.storage.output_folder import LOGS, OutputFolder
from slam_core.version import VERSION
from slam_viewer.report.early_output import EarlyOutput
from slam_viewer.report.summary_table import summary_table
from slam_viewer.results import STOPPED


@dataclass(frozen=True, eq=False)
class RunOptions:
    """Options of mapping recordings, those of ``slam run``; own: overrides of the user."""

    mode: str | None = None
    mapper: str = "sjsam"
    odometry: str = "none"
    imu: str | None = None
    own: Overrides = field(default_factory=Overrides)
    names: BagNames = field(default_factory=BagNames)
    overwrite: bool = False
    old_map: Path | None = None
    localize_only: bool = False


@dataclass(frozen=True, eq=False)
class Watch:
    """Whoever watches a run: told of every reading, and asked whether the run is to end early."""

    on_reading: Callable[[], None]
    is_stopped: Callable[[], bool]


class Display(Protocol):
    """Shows how far a run is."""

    def mapping(self, readings: int) -> AbstractContextManager[Watch]:
        """While the recording is mapped, of so many readings."""

    def writing(self) -> AbstractContextManager[object]:
        """While the results are written."""


class RecordingRun:
    """A recording that is to be mapped; what is wrong with it or the options shows before anything is written.

    Parameters
    ----------
    bag, output
        The recording, and the folder of its results.
    options
        How it is mapped.

    Raises
    ------
    ValueError
        If the bag cannot be read or lacks what the mode needs, or the options or the old map are not valid.
    """

    def __init__(self, bag: Path, output: Path, options: RunOptions) -> None:
        self._bag, self._output, self._options = bag, output, options
        with SensorBag(bag, options.names) as opened:
            self.readings = sum(opened.count(a, role) for a in opened.agents for role in ("left", "depth", "imu"))
            mode = mode_for(opened, options.mode)
        self._system = _system(bag, mode, options)
        self._session = MapSession(self._system.sjsam, Mode.LOCALISE if options.localize_only else Mode.MAP)
        if (old := map_folder(options.old_map, localize_only=options.localize_only)) is not None:
            self._session.load(old, len).result()
        if mode != "tof":
            require_stereo(bag, options.names)

    def write(self, display: Display) -> tuple[dict[str, Any], bool]:
        """Map the recording and write all results; the summary, and whether it was asked to end early.

        Raises
        ------
        ValueError
            If nothing was mapped, or the folder must not be written.
        """
        results = OutputFolder(self._output, "run", self._bag, overwrite=self._options.overwrite)
        transcript, staged, session = Transcript(VERSION), results.staged(rescue=MAP), self._session
        with (
            session, results, transcript, giving_up(results), staged as folder,
            _saved_if_given_up(session, folder / MAP), EarlyOutput(folder, partial(_save, session)) as early,
        ):  # fmt: skip
            with display.mapping(2 * self.readings) as watch:
                result, _ = run_bag(
                    self._bag,
                    self._system,
                    mapper=self._options.mapper,
                    odometry=self._options.odometry,
                    names=self._options.names,
                    session=session,
                    on_reading=watch.on_reading,
                    stopped=watch.is_stopped,
                    on_mapped=early.start,
                )
            stopped = watch.is_stopped()
            require_map(result)
            result = replace(result, is_localized=self._options.localize_only)
            if stopped:
                result = replace(result, events=(STOPPED, *result.events))
            with display.writing():
                summary = early.write_rest(result, pictures=not stopped)
                transcript.write(folder / LOGS / LOG_NAME, summary_table(summary, self._output))
        return summary, stopped


def _system(bag: Path, mode: str, options: RunOptions) -> SystemConfig:
    overrides = overrides_for(bag, with_files(options.own, options.names.calibration.parameters))
    return choose(system_config(overrides), mode, options.mapper, options.odometry, options.imu)


def _save(session: MapSession, path: Path) -> None:
    session.save(path, is_last=True).result()


@contextmanager
def _saved_if_given_up(session: MapSession, path: Path) -> Iterator[None]:
    """A user who does not want to wait for the rest keeps the map."""
    try:
        yield
    except KeyboardInterrupt:
        if len(session.snapshot) and not path.exists():
            _save(session, path)
        raise
