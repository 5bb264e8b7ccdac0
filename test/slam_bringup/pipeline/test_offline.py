# SPDX-License-Identifier: Apache-2.0
"""The stages of a run: each a thread ahead of the next, none lost, none left running."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from slam_bags.reading.readings import AgentSensors
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_bringup.pipeline.prefetch import prefetch
from slam_bringup.pipeline.run_record import StateChanges
from slam_bringup.pipeline.sensor_pipeline import SensorPipeline
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.frame_tree import FrameTree

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"


class Source:
    """Numbers, until ``fails_at``; ``closed`` once nobody wants more."""

    def __init__(self, fails_at: int = 1000) -> None:
        self.fails_at, self.closed = fails_at, False

    def items(self) -> Iterator[int]:
        try:
            for k in range(1000):
                if k == self.fails_at:
                    raise ValueError("unreadable")
                yield k
        finally:
            self.closed = True


def doubled(items):
    for k in items:
        time.sleep(0)
        yield 2 * k


def stage(items):
    """A stage that hands over three items at a time."""
    return prefetch(items, lambda k: k % 3 == 0, 8)


def squared(items):
    for k in stage(doubled(items)):
        yield k * k


def test_stages_keep_every_item_in_order():
    assert list(stage(squared(stage(Source().items())))) == [4 * k * k for k in range(1000)]


def test_an_error_of_the_first_stage_reaches_the_last_after_what_came_before_it():
    seen = []
    with pytest.raises(ValueError, match="unreadable"):
        seen.extend(stage(squared(stage(Source(fails_at=7).items()))))
    assert len(seen) == 7


def test_whoever_stops_early_stops_every_stage():
    before, source = threading.active_count(), Source()
    last = stage(squared(stage(source.items())))
    assert next(last) == 0
    last.close()
    deadline = time.monotonic() + 10.0
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert source.closed
    assert threading.active_count() == before


def test_changes_of_state_are_told_with_the_time_since_the_start():
    changes = StateChanges()
    changes.add(0, "OK", "")  # of a node that has not seen a frame
    for k, state in enumerate(["OK", "OK", "LOST", "LOST", "OK", "OK", "OK", "OK"]):
        changes.add(1403715273 * 10**9 + k * 10**8, state, "too few features" if state == "LOST" else "")
    assert changes.events == ["0.2 s: LOST, too few features", "0.4 s: OK"]
    assert changes.lost_share == 0.25


@pytest.mark.parametrize(
    ("mode", "odometry", "hint"),
    [
        ("stereo", "ndt", "leave --odometry out"),
        ("fuse", "ndt", "--mode stereo without --odometry"),
        ("fuse", "none", "try --mode stereo"),
    ],
)
def test_who_lacks_a_tof_camera_is_told_what_would_do(mode, odometry, hint):
    sensors = AgentSensors("", None, None, None, "depth", FrameTree(), topics={"left": "/l", "right": "/r"})
    config = choose(load_system_config(None), mode, "sjsam", odometry)
    with pytest.raises(ValueError, match=hint):
        SensorPipeline(config, sensors, odometry != "none", StageTimes())


def test_a_run_that_is_told_to_stop_keeps_what_it_has():
    asked = iter(range(1000))
    config = choose(load_system_config(None), "stereo", "sjsam", "none")
    result, _ = run_bag(DEMO, config, stopped=lambda: next(asked) >= 20)
    assert 8 <= result.frames <= 12
    assert len(result.agents[0].trajectory) == result.frames
    assert len(result.landmarks.positions) > 50
    assert len(result.dense) == 0  # it would keep whoever wants the end waiting
    assert not result.dropped


THESIS = {
    "feature_extractor": {"features": {"detector": "censure", "surf": {"extended": False}}},
    "ekf_slam": {"association": {"method": "ccda"}, "submap": {"start": "conditional", "max_distance": 0.3}},
    "sjsam": {"smoothing": {"estimator": {"rows": "block", "iterations": 1}}},
}
OTHERS = {
    "feature_extractor": {"features": {"detector": "rootsift"}},
    "ekf_slam": {"association": {"method": "jcbb"}, "submap": {"max_distance": 0.3}},
    "sjsam": {"smoothing": {"estimator": {"robust": {"loss": "cauchy"}}}},
}


@pytest.mark.parametrize(("values", "numbers"), [(THESIS, 64), (OTHERS, 128)])
def test_every_choice_of_method_maps(tmp_path, values, numbers):
    file = tmp_path / "config.yaml"
    file.write_text(yaml.safe_dump({node: {"ros__parameters": group} for node, group in values.items()}))
    asked = iter(range(1000))
    config = choose(load_system_config(file), "stereo", "sjsam", "none")
    result, session = run_bag(DEMO, config, stopped=lambda: next(asked) >= 36)
    submaps = session.snapshot.submaps
    assert len(submaps) >= 2
    assert {submap.descriptors.shape[1] for submap in submaps} == {numbers}
    evaluation = result.agents[0].evaluation()
    assert evaluation is not None
    assert evaluation.ate.rmse < 0.02
