# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures: the public data sets (skipped with a reason where absent) and seeded random numbers."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is loaded, as slam_core.runtime.blas_threads

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from tutorial_run import made_once, run_tutorial

settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")  # no test judges time

ROOT = Path(__file__).resolve().parent.parent
LONG = Path(__file__).with_name("long_tests.txt")
"""Names of the tests that take longer than half a second, which ``--fast`` leaves out; ``--write-long`` writes it."""
LONG_S = 0.5


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fast", action="store_true", help="leave out what takes long, and what needs ROS or data sets")
    parser.addoption("--write-long", action="store_true", help=f"add the tests that take long to {LONG.name}")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    # What takes long begins first, or one process would be at it alone in the end.
    long_ones = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in long_ones)
    if not config.getoption("--fast"):
        return
    long = set(LONG.read_text(encoding="utf-8").split("\n"))
    kept: list[pytest.Item] = []
    left_out: list[pytest.Item] = []
    for item in items:
        is_left_out = item.nodeid in long or any(map(item.get_closest_marker, ("slow", "ros", "data")))
        (left_out if is_left_out else kept).append(item)
    config.hook.pytest_deselected(items=left_out)
    items[:] = kept


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if not config.getoption("--write-long"):
        return
    seconds: dict[str, float] = {}
    for report in (r for reports in terminalreporter.stats.values() for r in reports if hasattr(r, "duration")):
        seconds[report.nodeid] = seconds.get(report.nodeid, 0.0) + report.duration
    long = {name for name, duration in seconds.items() if duration > LONG_S}
    LONG.write_text("\n".join(sorted({*LONG.read_text(encoding="utf-8").split("\n"), *long} - {""})) + "\n", "utf-8")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the public data sets: $INDOOR_SLAM_DATA or ../shared/data beside the checkout."""
    path = Path(os.environ.get("INDOOR_SLAM_DATA", ROOT.parent / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"no public data sets at {path} (set INDOOR_SLAM_DATA)")
    return path


@pytest.fixture(scope="session")
def tutorial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the commands of the tutorial were run as typed, once for all processes of the tests."""
    return made_once(tmp_path_factory.getbasetemp(), "tutorial", run_tutorial)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(12345)


@pytest.fixture(scope="session", autouse=True)
def state_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Nodes keep their copies here, not in the user's state, and go on from nobody else's."""
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS domain that no other test or program on this machine uses; nodes started meanwhile are in it."""
    from slam_bringup.processes.processes import PrivateDomain

    with PrivateDomain() as number:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        yield number


@pytest.fixture
def full_disk() -> Callable[[], AbstractContextManager[None]]:
    """A context in which the system refuses to make any file larger than 16 KiB, as a full disk does."""

    @contextmanager
    def is_full() -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (2**14, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return is_full
