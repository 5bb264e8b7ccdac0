# SPDX-License-Identifier: Apache-2.0
"""The output of ``slam run``: what needs no dense model is written by a thread while others make that model.

Charts come after it: what draws them and the model's field of voxels take 40 and 90 MB.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from slam_core.runtime.memory import leave_libraries, trim_heap
from slam_viewer.report.mapped_files import write_mapped
from slam_viewer.results import RunResult

if TYPE_CHECKING:
    from slam_viewer.report.report import Charts
    from slam_viewer.report.result_bag import Written


class EarlyOutput:
    """The output of a run in the folder ``out``; ``save_map`` writes the loadable map to a folder.

    Leaving the block waits for what is being made.
    """

    def __init__(self, out: Path, save_map: Callable[[Path], object]) -> None:
        self._out, self._save_map = out, save_map
        self._pool = ThreadPoolExecutor(1, "output")
        self._mapped: Future[list[Written]] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def start(self, result: RunResult) -> None:
        """Begin with what the result without dense model tells."""
        self._mapped = self._pool.submit(self._write_mapped, result)

    def write_rest(self, result: RunResult, *, pictures: bool) -> dict[str, Any]:
        """Write all that is not there yet; the summary is returned. Without ``pictures`` nothing is drawn."""
        from slam_viewer.report.result_bag import write_result_bag

        messages = self._mapped.result() if self._mapped is not None else None
        trim_heap()  # of what the dense model took
        leave_libraries()  # those that draw take 50 MB
        charts = self._pool.submit(_draw, result) if pictures else None
        write_result_bag(self._out / "result.mcap", result, messages)
        made = charts.result() if charts is not None else None
        # What draws and writes is loaded when there is something to draw: mapping needs the memory.
        from slam_viewer.report.output import write_results

        is_mapped = messages is not None
        return write_results(self._out, result, self._save_map, pictures=pictures, charts=made, is_mapped=is_mapped)

    def _write_mapped(self, result: RunResult) -> list[Written]:
        from slam_viewer.report.result_bag import agents_messages

        write_mapped(self._out, result, self._save_map)
        trim_heap()  # saved, a map that is not to go on lets go what it was solved with
        return agents_messages(result)


def _draw(result: RunResult) -> Charts:
    from slam_viewer.report.drawing import load_without_documentation

    load_without_documentation()
    from slam_viewer.report.report import draw_charts

    return draw_charts(result)
