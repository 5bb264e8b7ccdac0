# SPDX-License-Identifier: Apache-2.0
"""Frame by frame: what every sensor of a rig reports while it moves through a scenario's building.

Every random number is drawn from (scenario seed, agent, frame, sensor), so a frame is the same whatever else is
rendered and on however many threads.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.types import ByteArray, Float32Array, ImuSample, OdometryReading, PositionReading, PressureReading
from slam_simulation.lift import seen_path
from slam_simulation.rendering.raycaster import Rays, camera_rays, make_view, trace
from slam_simulation.scenario import Scenario
from slam_simulation.sensors.imu import ImuSensor
from slam_simulation.sensors.position import PositionSensor
from slam_simulation.sensors.pressure import PressureSensor
from slam_simulation.sensors.stereo_sensor import Motion, StereoSensor, camera_twist
from slam_simulation.sensors.tof_sensor import TofImages, TofSensor
from slam_simulation.sensors.wheels import WheelSensor
from slam_simulation.trajectory import rig_twist
from slam_simulation.world.finishes import finished
from slam_simulation.world.moving import MovingThings
from slam_simulation.world.surface_table import SurfaceTable, compile_world

_SENSORS = 100
"""Sensors of one camera that have random numbers of their own, at most."""


@dataclass(frozen=True, eq=False)
class DepthTruth:
    """True depth of the *rectified* left image.

    Float32 (h, w) m along z, and the surface of each pixel, int32 (h, w).
    """

    depth: Float32Array
    surface: npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """All that one agent's sensors report at one moment; of a rig with several cameras those of ``camera``.

    left, right: raw uint8 images, None for a sensor that is not carried or a frame that was lost; right_stamp_ns
    differs from stamp_ns by the jitter between the cameras. tof: raw images or None. imu, wheels, positions, pressures:
    readings since the previous frame.
    """

    index: int
    agent: str
    camera: str
    stamp_ns: int
    right_stamp_ns: int
    T_world_rig: FloatArray
    left: ByteArray | None
    right: ByteArray | None
    tof: TofImages | None
    imu: tuple[ImuSample, ...]
    wheels: tuple[OdometryReading, ...]
    positions: tuple[PositionReading, ...]
    pressures: tuple[PressureReading, ...]
    truth: DepthTruth | None


class Simulator:
    """Renders the frames of one agent of a scenario.

    Parameters
    ----------
    scenario
        What to simulate.
    agent
        Number of the agent.
    camera
        Number of the camera among the scenario's ``cameras``; 0 of a rig with one. The first one also has the sensors
        that are no cameras.
    world
        The compiled building, if it is shared between agents.
    threads
        Threads that draw; None takes all processors. The images do not depend on it.
    truth
        Also give the true depth of the rectified left image.
    rectified
        Stereo images as an ideal pair would take them, instead of raw ones.
    """

    def __init__(
        self,
        scenario: Scenario,
        agent: int = 0,
        world: SurfaceTable | None = None,
        threads: int | None = None,
        *,
        camera: int = 0,
        truth: bool = False,
        rectified: bool = False,
    ) -> None:
        if not 0 <= agent < len(scenario.agents):
            raise ValueError(
                f"scenario '{scenario.name}' has {len(scenario.agents)} agents, there is no number {agent}"
            )
        self.scenario, self.agent, self.camera = scenario, agent, camera
        self.T_rig_mount = scenario.cameras[camera].T_rig_mount if scenario.cameras else None
        realism = scenario.suite.realism
        world = compile_world(scenario.world()) if world is None else world
        self.world = finished(world, realism.finishes, scenario.seed)
        self._moving = MovingThings(realism.moving, scenario.path())
        self.path = scenario.path(agent)
        self._seen = seen_path(self.path)
        self.stereo = StereoSensor(scenario.suite.stereo, scenario.seed, rectified=rectified, realism=realism)
        self.tof = TofSensor(scenario.suite.tof, scenario.seed, realism)
        self.imu = ImuSensor(scenario.suite.imu, (scenario.seed, 9, agent))
        self.wheels: WheelSensor | None = None
        if "wheels" in scenario.sensors and camera == 0:
            height = scenario.agents[agent].height
            self.wheels = WheelSensor(scenario.suite.wheels, self.path, height, (scenario.seed, 10, agent))
        self.position: PositionSensor | None = None
        if "position" in scenario.sensors and camera == 0:
            self.position = PositionSensor(scenario.suite.position, self.path, (scenario.seed, 11, agent))
        self.pressure: PressureSensor | None = None
        if "pressure" in scenario.sensors and camera == 0:
            self.pressure = PressureSensor(scenario.suite.pressure, self.path, (scenario.seed, 12, agent))
        self.threads = threads or os.cpu_count() or 1
        self._right_late_s = 1e-3 * scenario.suite.stereo.right_late_ms
        self._truth_rays = camera_rays(self.stereo.stereo.camera) if truth else None

    @property
    def agent_name(self) -> str:
        """Namespace of the agent, "" of a single rig."""
        return self.scenario.agents[self.agent].name

    @property
    def camera_name(self) -> str:
        """Namespace of the camera on its rig, "" of one alone."""
        return self.scenario.cameras[self.camera].name if self.scenario.cameras else ""

    @property
    def T_left_tof(self) -> FloatArray:
        """Extrinsics of the ToF camera in the rectified left optical frame."""
        T_left_rig = np.linalg.inv(self.T_rig_left)
        return np.asarray(T_left_rig @ self.T_rig_tof)

    @property
    def T_rig_tof(self) -> FloatArray:
        """Mounting of the ToF camera."""
        return self._mounted(self.tof.T_rig_tof)

    @property
    def T_rig_left(self) -> FloatArray:
        """Mounting of the rectified left camera."""
        T = self.stereo.T_rig_raw[0].copy()
        T[:3, :3] = T[:3, :3] @ self.stereo.infos[0].R.T
        return self._mounted(T)

    def _mounted(self, T: FloatArray) -> FloatArray:
        """The pose (4, 4) of a frame of the camera's mounting, or after it, seen from the rig."""
        return T if self.T_rig_mount is None else self.T_rig_mount @ T

    def _mount_at(self, t: float) -> Motion:
        """Pose and twist, at a time, of the mounting, which is the rig's own frame for a rig with one camera."""
        T, twist = self._seen.pose(t), rig_twist(self._seen, t)
        return (T, twist) if self.T_rig_mount is None else (T @ self.T_rig_mount, camera_twist(twist, self.T_rig_mount))

    @property
    def frames(self) -> int:
        """Number of frames of the scenario."""
        return self.scenario.frames

    def stamp_ns(self, index: int) -> int:
        """Header stamp of a frame."""
        start = self.scenario.suite.start_stamp_s + self.scenario.agents[self.agent].start_s
        return round(start * 1e9) + round(index / self.scenario.rate * 1e9)

    def run(self, frames: int | None = None, every: int = 1, first: int = 0) -> Iterator[SimulatedFrame]:
        """Every ``every``-th frame from ``first`` up to frame ``frames`` (all by default), in order."""
        if every < 1:
            raise ValueError(f"can take every frame or every n-th, got {every}")
        indices = range(first, self.frames if frames is None else min(frames, self.frames), every)
        if self.threads == 1:
            yield from (self._frame(k, None, every) for k in indices)
            return
        with ThreadPoolExecutor(self.threads) as pool:
            for k in indices:
                yield self._frame(k, pool, every)

    def _frame(self, k: int, pool: ThreadPoolExecutor | None, every: int = 1) -> SimulatedFrame:
        scenario, t = self.scenario, k / self.scenario.rate
        T = self.path.pose(t)
        world = self._moving.at(self.world, t)
        left, right = self._stereo(k, t, world, pool)
        tof = None
        if "tof" in scenario.sensors:
            tof = self.tof.capture(world, self._mount_at(t)[0], self._rng(k, 3), pool)
        jitter = scenario.suite.stereo.stamp_jitter_us * 1e3 * self._rng(k, 4).standard_normal()
        return SimulatedFrame(
            index=k,
            agent=self.agent_name,
            camera=self.camera_name,
            stamp_ns=self.stamp_ns(k),
            right_stamp_ns=self.stamp_ns(k) + round(jitter),
            T_world_rig=T,
            left=left,
            right=right,
            tof=tof,
            imu=self._imu_samples(t - every / scenario.rate, t),
            wheels=self._wheel_readings(t - every / scenario.rate, t),
            positions=self._position_readings(t - every / scenario.rate, t),
            pressures=self._pressure_readings(t - every / scenario.rate, t),
            truth=None if self._truth_rays is None else self._truth(self._seen.pose(t), world, self._truth_rays, pool),
        )

    def _rng(self, k: int, sensor: int) -> np.random.Generator:
        return np.random.default_rng([self.scenario.seed, 5, self.agent, k, sensor + _SENSORS * self.camera])

    def _stereo(
        self, k: int, t: float, world: SurfaceTable, pool: ThreadPoolExecutor | None
    ) -> tuple[ByteArray | None, ByteArray | None]:
        if "stereo" not in self.scenario.sensors:
            return None, None
        rng = self._rng(k, 2)
        left, right = (self._mount_at(at) for at in (t, t + self._right_late_s))
        pair = self.stereo.capture(world, (left, right), rng, pool)
        return (None, None) if rng.random() < self.scenario.suite.stereo.drop_probability else pair

    def _imu_samples(self, previous: float, t: float) -> tuple[ImuSample, ...]:
        if "imu" not in self.scenario.sensors or self.camera:
            return ()
        # The first frame brings the sample of its own moment.
        return self.imu.read(self.path, max(previous, -1e-6), t, self.stamp_ns(0))

    def _wheel_readings(self, previous: float, t: float) -> tuple[OdometryReading, ...]:
        return () if self.wheels is None else self.wheels.read(max(previous, -1e-6), t, self.stamp_ns(0))

    def _position_readings(self, previous: float, t: float) -> tuple[PositionReading, ...]:
        return () if self.position is None else self.position.read(max(previous, -1e-6), t, self.stamp_ns(0))

    def _pressure_readings(self, previous: float, t: float) -> tuple[PressureReading, ...]:
        return () if self.pressure is None else self.pressure.read(max(previous, -1e-6), t, self.stamp_ns(0))

    def _truth(self, T: FloatArray, world: SurfaceTable, rays: Rays, pool: ThreadPoolExecutor | None) -> DepthTruth:
        view = make_view(world, T @ self.T_rig_left, rays.bounds)
        hits = trace(view, rays, pool)
        return DepthTruth(hits.depth, np.where(hits.surface >= 0, view.ids[hits.surface], -1).astype(np.int32))


def simulate(scenario: Scenario, agent: int = 0, frames: int | None = None) -> Iterator[SimulatedFrame]:
    """The frames of one agent of a scenario; see :class:`Simulator` for calibration, extrinsics and truth."""
    return Simulator(scenario, agent).run(frames)
