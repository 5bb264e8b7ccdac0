# SPDX-License-Identifier: Apache-2.0
"""Files and charts of a run that need no dense model, made by a thread while others make that model."""

from __future__ import annotations

import gc
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from slam_bringup.pipeline.results import RunResult
from slam_core.memory import give_back

if TYPE_CHECKING:
    from slam_bringup.report.report import Charts
    from slam_bringup.report.result_bag import Written


class EarlyOutput:
    """The output of a run in the folder ``out``; ``save_map`` writes the loadable map to a folder.

    Leaving the block waits for the file or chart that is being made, and makes no other.
    """

    def __init__(self, out: Path, save_map: Callable[[Path], object]) -> None:
        self._out, self._save_map = out, save_map
        self._pool = ThreadPoolExecutor(1, "output")
        self._mapped: Future[list[Written]] | None = None
        self._charts: Future[Charts] | None = None
        self._ended = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended = True
        self._pool.shutdown(cancel_futures=True)

    def start(self, result: RunResult) -> None:
        """Begin with what the result without dense model tells."""
        self._mapped = self._pool.submit(self._write_mapped, result)
        self._charts = self._pool.submit(self._draw, result)

    def write_rest(self, result: RunResult, *, pictures: bool) -> dict[str, Any]:
        """Write all that is not there yet; the summary is returned. Without ``pictures`` nothing is drawn any more."""
        self._ended = not pictures
        give_back()  # images and field of the dense model
        from slam_bringup.report.output import write_results
        from slam_bringup.report.result_bag import write_result_bag

        messages = self._mapped.result() if self._mapped is not None else None
        write_result_bag(self._out / "result.mcap", result, messages)
        charts = self._charts.result() if pictures and self._charts is not None else None
        is_mapped = messages is not None
        return write_results(self._out, result, self._save_map, pictures=pictures, charts=charts, is_mapped=is_mapped)

    def _write_mapped(self, result: RunResult) -> list[Written]:
        self._out.mkdir(parents=True, exist_ok=True)
        self._save_map(self._out / "map")
        give_back()  # what the map was solved with
        # What draws and writes is loaded when there is something to write: mapping needs the memory.
        from slam_bringup.report.drawing import load_without_documentation

        load_without_documentation()
        from slam_bringup.report.output import write_mapped
        from slam_bringup.report.result_bag import agents_messages

        write_mapped(self._out, result)
        return agents_messages(result)

    def _draw(self, result: RunResult) -> Charts:
        from slam_bringup.report.report import draw_charts

        charts = draw_charts(result, self._go_on)
        gc.collect()  # parts of figures name each other
        give_back()
        return charts

    def _go_on(self) -> None:
        if self._ended:
            raise InterruptedError("nobody wants the charts any more")
