# SPDX-License-Identifier: Apache-2.0
"""A jump back of the clock begins one session of a rig, whichever of its cameras tells of it first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ekf_slam_node.stage import FilterStage
from feature_world import PointWorld
from ndt_registration.stage import Scan, ScanEstimate
from sjsam_node.session.map_session import MapSession
from slam_bags.reading.readings import AgentSensors, LaserReading, SessionStart, StereoReading
from slam_bringup.pipeline.configuration import SystemConfig, choose, load_system_config
from slam_bringup.pipeline.mapper import Mapper
from slam_bringup.pipeline.rig_sessions import RigSessions
from slam_bringup.pipeline.sensor_pipeline import AgentItem, SensorPipeline, rig_pipelines
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.camera import Camera
from slam_core.frame_tree import FrameTree
from slam_core.messages import rectified_info
from slam_core.types import Features
from stereo_frontend.sources import RawPair
from stereo_frontend.stage import ExtractedFrame

S = 1_000_000_000
CAMERA = Camera(160, 120, 141.5, 141.5, 79.5, 59.5)


def config(mode: str = "stereo") -> SystemConfig:
    return choose(load_system_config(None), mode, "ekf", "ndt" if mode == "stereo" else "none")


def cameras(*roles: str) -> list[AgentSensors]:
    frames = FrameTree()
    for name in "ab":
        frames.add("base_link", name, np.eye(4))
    infos = rectified_info(CAMERA), rectified_info(CAMERA, 0.1)
    topics = {role: f"/{role}" for role in ("left", "right", *roles)}
    return [
        AgentSensors(name, *infos, None, "depth", frames, name, topics=topics, rig="", camera=name) for name in "ab"
    ]


def room(stamp_ns: int) -> Scan:
    rng = np.random.default_rng(0)
    points = rng.uniform(-3.0, 3.0, (2000, 3))
    points[np.arange(2000), rng.integers(0, 3, 2000)] = 3.0
    return Scan(stamp_ns, points, "base_link")


def scanned(pipelines: dict[str, SensorPipeline], *stamps: int) -> list[bool]:
    """Whether each scan of both cameras has a motion from the one before."""
    found = []
    for stamp in stamps:
        for name in "ab":
            for item in pipelines[name].add(LaserReading(name, room(stamp))):
                assert isinstance(item.value, ScanEstimate)
                found.append(item.value.motion is not None)
    return found


def test_the_first_camera_that_tells_begins_the_session() -> None:
    sessions = RigSessions("ab")
    assert [sessions.begins(name) for name in "abba"] == [True, False, True, False]
    assert [sessions.begins(name) for name in "bbb"] == [True, True, True]


@pytest.mark.parametrize("order", ["ab", "ba"])
def test_scan_odometry_begins_anew_once(order: str) -> None:
    pipelines = rig_pipelines(config(), cameras("scan"), odometry=True, times=StageTimes())
    assert scanned(pipelines, 100 * S, 101 * S) == [False, True]
    list(pipelines[order[0]].add(SessionStart(order[0], S)))
    assert list(pipelines[order[0]].add(LaserReading(order[0], room(S)))) == []
    list(pipelines[order[1]].add(SessionStart(order[1], S)))
    items = [item.value for item in pipelines[order[1]].add(LaserReading(order[1], room(S)))]
    assert [type(value) for value in items] == [ScanEstimate]
    assert scanned(pipelines, 2 * S) == [True]


def test_frames_that_wait_come_before_the_session_or_not_at_all() -> None:
    pipelines = rig_pipelines(config("fuse"), cameras("depth"), odometry=False, times=StageTimes())
    picture = np.zeros((120, 160), np.uint8)
    waiting = StereoReading("b", RawPair(100 * S, picture, picture, "b"))
    assert list(pipelines["b"].add(waiting)) == []
    told = list(pipelines["a"].add(SessionStart("a", S)))
    assert [(item.agent, type(item.value)) for item in told] == [("b", ExtractedFrame), ("a", SessionStart)]
    assert list(pipelines["b"].add(waiting)) == []
    assert [type(item.value) for item in pipelines["b"].add(SessionStart("b", S))] == [SessionStart]


@pytest.mark.parametrize("told", ["a", "b", "ab", "ba"])
def test_the_filter_begins_anew_once(monkeypatch: pytest.MonkeyPatch, told: str) -> None:
    begun: list[FilterStage] = []
    start = FilterStage.start_session
    monkeypatch.setattr(FilterStage, "start_session", lambda stage: begun.append(stage) or start(stage))
    with MapSession(config().sjsam) as session:
        mapper = Mapper(config(), {own.agent: own for own in cameras()}, StageTimes(), session)
        for name in told:
            mapper.process(AgentItem(name, SessionStart(name, S)))
        assert len(begun) == 1
        mapper.finish()


def test_a_late_frame_of_the_time_before_does_not_block_its_camera() -> None:
    def features(stamp_ns: int) -> Features:
        return world.features(np.eye(4), stamp_ns, np.random.default_rng(0))[0]

    points = np.random.default_rng(0).uniform([2.0, -2.0, -1.0], [5.0, 2.0, 1.0], (60, 3))
    world = PointWorld(points, np.eye(64)[:60])
    with MapSession(config().sjsam) as session:
        mapper = Mapper(config("fuse"), {own.agent: own for own in cameras()}, StageTimes(), session)
        for name, value in (
            ("a", SessionStart("a", S)),
            ("b", replace(features(100 * S), frame_id="b")),
            ("b", SessionStart("b", S)),
        ):
            mapper.process(AgentItem(name, value))
        for name in "ab":
            mapper.process(AgentItem(name, replace(features(S), frame_id=name)))
        assert mapper._diaries[""]._features == [2 * len(features(S))]
        mapper.finish()
