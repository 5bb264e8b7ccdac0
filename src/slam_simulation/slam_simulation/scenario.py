# SPDX-License-Identifier: Apache-2.0
"""A scenario: a building, who walks through it and what they carry, as one YAML file under ``bags/scenarios``.

description: one room, once round, both cameras
seed: 16
rate: 10.0                       # frames per second
frames: 414
sensors: [stereo, tof, imu]      # and wheels, of a rig that drives: wheels: {slip: 0.01, radius_error: 0.02}
                                 # position, in the building's frame: position: {sigma: 0.1, outlier_share: 0.1}
                                 # and pressure of a barometer: pressure: {sigma: 1.5, temperature: 294}
profile: ideal                   # or real: what real rooms and sensors add; single effects: realism: {...}
rooms:
  - {name: office, x: [0, 5], y: [0, 4], style: office}
doorways:
  - {at: [2.5, 4.0]}
objects:
  - {kind: table, at: [2.5, 2.0], size: [1.4, 0.8]}
tags:
  - {id: 7, at: [2.0, 4.0, 1.5], yaw: -90}       # fiducial, on the wall; yaw: the way it faces
cameras:                         # of a rig with several, which has the sensors stereo and tof once for each
  - {name: front}
  - {name: back, at: [-0.1, 0.0, 0.0], yaw: 180}   # place (m) and heading (degrees) on the rig
agents:
  - {name: "", motion: handheld, height: 1.3, path: [[1, 1], [4, 1, 90], [1, 1]]}   # x, y[, yaw[, pitch[, z]]]
                                                 # rides: [{at: 1, height: 9}], in a lift at way point 1
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from slam_core.config import Config, from_mapping, group, parameter
from slam_core.geometry import FloatArray, make_transform, rotation_from_euler
from slam_core.storage.files import read_yaml
from slam_simulation.lift import LiftPath, LiftRide
from slam_simulation.sensors.imu import ImuSensorConfig
from slam_simulation.sensors.position import PositionSensorConfig
from slam_simulation.sensors.pressure import PressureSensorConfig
from slam_simulation.sensors.profiles import PROFILES, REAL, REAL_STEREO, RealismConfig
from slam_simulation.sensors.stereo_sensor import StereoSensorConfig
from slam_simulation.sensors.tof_sensor import TofSensorConfig
from slam_simulation.sensors.wheels import WheelSensorConfig
from slam_simulation.trajectory import MOTION_STYLES, Path, SplinePath, StationPath, resolve_waypoints
from slam_simulation.world.building import WALL_GAP, Doorway, Room, build_doorways, build_shell, room_walls
from slam_simulation.world.furniture import Spot, blank, chair, furnish_wall, gallery, pillar, stairs, table
from slam_simulation.world.moving import add_moving
from slam_simulation.world.tags import TagOnWall
from slam_simulation.world.world import World

SENSORS = ("stereo", "tof", "imu")
"""Sensors of a rig unless a scenario says otherwise."""
_KNOWN = (*SENSORS, "wheels", "position", "pressure")
_SUITE = (*_KNOWN, "realism")
_KINDS = "table, chair, pillar, stairs, gallery, blank"
SCENARIOS = FilePath(__file__).with_name("scenarios")
"""``bags/scenarios`` of the sources, installed with the package."""


@dataclass(frozen=True)
class Agent:
    """Carrier of a rig: namespace, motion style, height of the camera and way points (or stations) of the path."""

    name: str = ""
    motion: str = "rig"
    height: float = 1.2
    path: tuple[tuple[float, ...], ...] = ()
    stations: tuple[tuple[float, ...], ...] = ()
    scans: int = 15
    start_s: float = 0.0
    rides: tuple[LiftRide, ...] = ()

    def __post_init__(self) -> None:
        rides = tuple(ride if isinstance(ride, LiftRide) else _make(LiftRide, ride, self.name) for ride in self.rides)
        object.__setattr__(self, "rides", rides)
        if self.rides and self.stations:
            raise ValueError(f"agent '{self.name}' rides along a path, not from station to station")
        if self.motion not in MOTION_STYLES:
            raise ValueError(f"agent '{self.name}': unknown motion '{self.motion}', known: {', '.join(MOTION_STYLES)}")
        if bool(self.path) == bool(self.stations) or len(self.path) == 1:
            raise ValueError(f"agent '{self.name}' needs either a path of two or more way points or stations")
        for row in (*self.path, *self.stations):
            if not 2 <= len(row) <= 5 or not all(isinstance(value, int | float) for value in row):
                raise ValueError(f"agent '{self.name}': a way point is x, y[, yaw[, pitch[, z]]], got {list(row)}")


@dataclass(frozen=True)
class CameraMount:
    """One of several cameras of a rig: ``name``, its topics' namespace; ``at`` (x, y, z) m, ``yaw`` and ``pitch`` deg.

    A camera is what a rig with one has: a stereo pair, a ToF camera or both, as ``sensors`` says.
    """

    name: str
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    pitch: float = 0.0

    def __post_init__(self) -> None:
        if not self.name.isidentifier() or len(self.at) != 3:
            raise ValueError(f"camera '{self.name}': needs a name of letters, digits and _, and at: [x, y, z]")

    @property
    def T_rig_mount(self) -> FloatArray:
        """Pose (4, 4) on the rig of what would be the rig's own frame if the camera were the only one."""
        return make_transform(rotation_from_euler(np.radians(self.yaw), np.radians(self.pitch)), np.array(self.at))


@dataclass(frozen=True)
class FurnitureObject:
    """A free-standing object.

    ``kind`` table, chair, pillar, stairs, gallery or blank, ``at`` (x, y) m its middle, ``size`` (x, y) m, ``yaw`` deg;
    stairs rise along their x to ``height`` m, at which a gallery has its floor. ``blank``: a white wall without any
    texture, wide and high as ``size`` says, seen from where ``yaw`` points.
    """

    kind: str
    at: tuple[float, float]
    size: tuple[float, float] = (1.6, 0.8)
    yaw: float = 0.0
    height: float = 3.0


@dataclass(frozen=True)
class SensorSuite(Config):
    """Overrides of the sensors' configurations."""

    stereo: StereoSensorConfig = group(StereoSensorConfig)
    tof: TofSensorConfig = group(TofSensorConfig)
    imu: ImuSensorConfig = group(ImuSensorConfig)
    wheels: WheelSensorConfig = group(WheelSensorConfig)
    position: PositionSensorConfig = group(PositionSensorConfig)
    pressure: PressureSensorConfig = group(PressureSensorConfig)
    realism: RealismConfig = group(RealismConfig)
    start_stamp_s: float = parameter(1000.0, "header stamp of the first frame", unit="s", minimum=0.0)


@dataclass(frozen=True)
class Scenario:
    """See the module's description; ``name`` is the file's."""

    name: str
    seed: int
    rate: float
    frames: int
    rooms: tuple[Room, ...]
    agents: tuple[Agent, ...]
    sensors: tuple[str, ...] = SENSORS
    doorways: tuple[Doorway, ...] = ()
    objects: tuple[FurnitureObject, ...] = ()
    tags: tuple[TagOnWall, ...] = ()
    cameras: tuple[CameraMount, ...] = ()
    description: str = ""
    suite: SensorSuite = field(default_factory=SensorSuite)
    full_frames: int = 0
    """Frames of the whole motion, if ``frames`` has been cut."""
    profile: str = ""
    """Profile, see :mod:`slam_simulation.sensors.profiles`; "" is ``ideal`` as long as nobody chooses."""

    def __post_init__(self) -> None:
        if self.rate <= 0.0 or self.frames < 1:
            raise ValueError(
                f"scenario '{self.name}': needs frames >= 1 and rate > 0, got {self.frames} at {self.rate} Hz"
            )
        if not self.rooms or not self.agents:
            raise ValueError(f"scenario '{self.name}' needs at least one room and one agent")
        unknown = set(self.sensors) - set(_KNOWN)
        if unknown:
            raise ValueError(f"scenario '{self.name}': unknown sensors {sorted(unknown)}, known: {', '.join(_KNOWN)}")
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < len(names):
            raise ValueError(f"scenario '{self.name}': two cameras of the rig have one name: {', '.join(names)}")
        for k, room in enumerate(self.rooms):
            if room.like and room.like not in {r.name for r in self.rooms[:k]}:
                raise ValueError(f"room '{room.name}' is like '{room.like}', which is no earlier room")
        for agent in self.agents:
            for x, y, *_ in (*agent.path, *agent.stations):
                if not any(room.contains(x, y, WALL_GAP) for room in self.rooms):
                    raise ValueError(f"agent '{agent.name}' of scenario '{self.name}' leaves all rooms at ({x}, {y}) m")

    @classmethod
    def load(cls, name_or_path: str | FilePath) -> Scenario:
        """The scenario of a YAML file, or of that name under ``bags/scenarios``.

        Raises
        ------
        ValueError
            If it does not exist (with the names that do) or its contents are wrong.
        """
        path = _find(name_or_path)
        values = read_yaml(path)
        if not isinstance(values, Mapping):
            raise ValueError(f"{path}: a scenario is a mapping, got {type(values).__name__}")
        return cls.from_mapping(path.stem, values)

    @classmethod
    def from_mapping(cls, name: str, values: Mapping[str, Any]) -> Scenario:
        """A scenario from the YAML file's contents."""
        own = ("rooms", "agents", "doorways", "objects", "tags", "cameras", "profile", *_SUITE)
        plain = {k: v for k, v in values.items() if k not in own}
        suite = {key: values[key] for key in _SUITE if key in values}
        kinds = {"rooms": Room, "agents": Agent, "doorways": Doorway, "objects": FurnitureObject, "tags": TagOnWall}
        kinds["cameras"] = CameraMount
        for key, kind in kinds.items():
            plain[key] = tuple(_make(kind, row, name) for row in values.get(key, ()))
        plain["sensors"] = tuple(plain.get("sensors", SENSORS))
        made: Scenario = _make(cls, {**plain, "name": name, "suite": from_mapping(SensorSuite, suite)}, name)
        return made.with_profile(str(values["profile"])) if "profile" in values else made

    def with_profile(self, profile: str) -> Scenario:
        """The scenario under a profile; what it sets of ``realism`` itself stays under ``ideal``.

        Raises
        ------
        ValueError
            If there is no such profile.
        """
        if profile not in PROFILES:
            raise ValueError(f"unknown profile '{profile}', known: {', '.join(PROFILES)}")
        if profile == "ideal":
            return replace(self, profile=profile)
        harder = {name: max(value, getattr(self.suite.stereo, name)) for name, value in REAL_STEREO.items()}
        stereo = replace(self.suite.stereo, **harder)
        return replace(self, profile=profile, suite=replace(self.suite, stereo=stereo, realism=REAL))

    def shortened(self, frames: int) -> Scenario:
        """Scenario cut off after ``frames`` frames; the motion stays as it was."""
        if frames < 1:
            raise ValueError(f"a scenario needs at least one frame, got {frames}")
        full = self.full_frames or self.frames
        return replace(self, frames=min(frames, self.frames), full_frames=full)

    def world(self) -> World:
        """The building, furnished from the seed."""
        world = World(self.seed)
        rng = np.random.default_rng([self.seed, 0])
        everything = [room_walls(k, room, list(self.doorways)) for k, room in enumerate(self.rooms)]
        begun: dict[str, tuple[np.random.Generator, int]] = {}
        for k, (room, walls) in enumerate(zip(self.rooms, everything, strict=True)):
            begun[room.name] = copy.deepcopy(rng), len(world.surfaces)
            own, twin = (copy.deepcopy(begun[room.like][0]), begun[room.like][1]) if room.like else (rng, -1)
            build_shell(world, k, room, walls)
            for wall in walls:
                furnish_wall(world, wall, room, own)
            if room.like:
                first = begun[room.name][1]
                alike = [replace(s, looks_like=twin + m) for m, s in enumerate(world.surfaces[first:])]
                world.surfaces[first:] = alike
        build_doorways(world, list(self.doorways), [wall for walls in everything for wall in walls])
        for item in self.objects:
            self._place(world, item, rng)
        world.add(*(tag.surface(self._room_at(tag.at[:2], margin=0.1)) for tag in self.tags))
        add_moving(world, self.suite.realism.moving, self.path(), self.rooms)
        return world

    def _place(self, world: World, item: FurnitureObject, rng: np.random.Generator) -> None:
        room = self._room_at(item.at)
        spot = Spot(room, np.array([*item.at, 0.0]), float(np.radians(item.yaw)))
        if item.kind == "table":
            table(world, spot, item.size, rng)
        elif item.kind == "chair":
            chair(world, spot)
        elif item.kind == "pillar":
            pillar(world, spot, self.rooms[room].height)
        elif item.kind == "stairs":
            stairs(world, spot, item.size, item.height)
        elif item.kind == "gallery":
            gallery(world, spot, item.size, item.height)
        elif item.kind == "blank":
            blank(world, spot, item.size)
        else:
            raise ValueError(f"scenario '{self.name}': unknown object '{item.kind}', known: {_KINDS}")

    def _room_at(self, at: tuple[float, ...], margin: float = 0.0) -> int:
        for k, room in enumerate(self.rooms):
            if room.contains(at[0], at[1], margin):
                return k
        raise ValueError(f"scenario '{self.name}': {at} m lies in no room")

    def path(self, agent: int = 0) -> Path:
        """The motion of one agent, from its first to its last frame."""
        who = self.agents[agent]
        if who.stations:
            return StationPath(resolve_waypoints([list(r) for r in who.stations], who.height), who.scans / self.rate)
        duration = max((self.full_frames or self.frames) - 1, 1) / self.rate
        rng = np.random.default_rng([self.seed, 1, agent])
        waypoints = resolve_waypoints([list(r) for r in who.path], who.height)
        if who.rides:
            return LiftPath(waypoints, who.rides, duration, MOTION_STYLES[who.motion], rng)
        return SplinePath(waypoints, duration, MOTION_STYLES[who.motion], rng)


def _make(kind: Any, row: Any, scenario: str) -> Any:
    """An object of dataclass ``kind`` from a mapping; lists become tuples, errors name the scenario."""
    if not isinstance(row, Mapping):
        raise ValueError(f"scenario '{scenario}': a {kind.__name__.lower()} is a mapping, got {row!r}")
    try:
        return kind(**{key: _frozen(value) for key, value in row.items()})
    except TypeError as error:
        raise ValueError(f"scenario '{scenario}': {kind.__name__.lower()}: {error}") from error


def _frozen(value: Any) -> Any:
    return tuple(_frozen(v) for v in value) if isinstance(value, list) else value


def _find(name_or_path: str | FilePath) -> FilePath:
    path = FilePath(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        if path.is_file():
            return path
        raise ValueError(f"no scenario file {path}")
    known = {p.stem: p for p in sorted(SCENARIOS.glob("*.yaml"))}
    if str(name_or_path) in known:
        return known[str(name_or_path)]
    names = ", ".join(known) or f"none, {SCENARIOS} is missing: install slam_simulation again from a whole clone"
    raise ValueError(f"unknown scenario '{name_or_path}', known: {names}")
