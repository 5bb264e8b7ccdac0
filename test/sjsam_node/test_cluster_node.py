# SPDX-License-Identifier: Apache-2.0
"""The node ``sjsam`` with a Dask cluster of processes: killed in mid-join or gone, the saved map has the same bytes."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from submap_world import Agent, circle, ring_world

pytest.importorskip("rclpy")
pytest.importorskip("distributed")
pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.usefixtures("domain")]

from dask_cluster import Cluster, running_cluster  # noqa: E402
from joiner_process import call, neighbour, running, send  # noqa: E402

from ros_probe import Probe  # noqa: E402
from slam_core.messages import SUBMAP_TOPICS, submap_messages  # noqa: E402
from slam_core.types import Submap  # noqa: E402

PATIENT = "from sjsam_node.regions import live; live.WAIT_S = 60.0"
"""A busy machine is slow; a lost scheduler is noticed at once."""
SETTINGS = ("autosave_period_s:=0.0", "smoothing.region.size:=8")


@pytest.fixture(scope="module")
def submaps() -> list[Submap]:
    rng = np.random.default_rng(5)
    return Agent(ring_world(3.0, rng, 12.0), circle(3.0, 2.0), rng).submaps()


def counted(probe: Probe, name: str) -> int:
    """The newest value of a count in the node's diagnostics."""
    values = [int(v.value) for m in probe.received["/diagnostics"] for s in m.status for v in s.values if v.key == name]
    return values[-1] if values else 0


def give(probe: Probe, submaps: list[Submap]) -> None:
    """Send submaps, and wait for nothing."""
    for submap in submaps:
        for topic, message in zip(SUBMAP_TOPICS, submap_messages(probe.types, submap), strict=True):
            probe.send(topic, message)


def mapped(
    folder: Path, submaps: list[Submap], own: Cluster | None, then: str = ""
) -> tuple[dict[str, bytes], int, int]:
    """The saved map's files, and how many tasks were done elsewhere and here; ``then`` happens in mid-join."""
    given = () if own is None else (f"scheduler:={own.address}",)
    with running(f"map_path:={folder}", *SETTINGS, *given, before=PATIENT) as node, neighbour() as probe:
        probe.listen("/diagnostics", probe.types.DiagnosticArray)
        first = 3 * len(submaps) // 4  # it comes by where it has been: there is something to compare
        give(probe, submaps[:first])
        if then:
            probe.wait(lambda: counted(probe, "tasks elsewhere") >= 3, "no task is done elsewhere")
            assert own is not None
            getattr(own, then)()
        give(probe, submaps[first:])
        send(probe, [], 4 * len(submaps) + 1)
        probe.wait(lambda: counted(probe, "submaps joined") == len(submaps), "submaps are lost")
        elsewhere, here = counted(probe, "tasks elsewhere"), counted(probe, "tasks here")
        assert call(probe, "save_map").success
        assert node.poll() is None
    return {p.name: p.read_bytes() for p in folder.iterdir()}, elsewhere, here


@pytest.fixture
def expected(submaps: list[Submap], tmp_path: Path) -> dict[str, bytes]:
    return mapped(tmp_path / "alone", submaps, None)[0]


def test_a_killed_worker_or_scheduler_costs_no_submap_and_changes_no_byte(
    submaps: list[Submap], expected: dict[str, bytes], tmp_path: Path
) -> None:
    with running_cluster(2) as own:
        found, elsewhere, here = mapped(tmp_path / "worker", submaps, own, "kill_worker")
        assert found == expected
        assert elsewhere > len(submaps)
        assert here == 0
        found, elsewhere, here = mapped(tmp_path / "scheduler", submaps, own, "kill")
        assert found == expected
        assert elsewhere > 0
        assert here > 0
        # Nobody answers: the node begins by itself.
        _, elsewhere, _ = mapped(tmp_path / "none", submaps[:6], own)
        assert elsewhere == 0


def test_a_cluster_of_other_versions_is_refused_in_one_line(tmp_path: Path) -> None:
    with running_cluster(1) as own:
        own.run_on_workers("import sjsam_node.regions.worker_setup as w; w.VERSION = '0.0'")
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        with running(f"scheduler:={own.address}", *SETTINGS, **pipes) as node:
            said, _ = node.communicate(timeout=60)
    assert node.returncode == 2
    assert "cannot start: the cluster at" in said
    assert "has this program 0.0, here is" in said
