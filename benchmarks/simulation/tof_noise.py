# SPDX-License-Identifier: Apache-2.0
"""ToF noise against distance and reflectance, measured on a wall, beside what the sensor is specified to have.

python benchmarks/simulation/tof_noise.py
"""

from __future__ import annotations

import numpy as np

from slam_simulation.sensors.tof_sensor import TofSensor, TofSensorConfig
from slam_simulation.world.surface_table import SurfaceTable, compile_world
from slam_simulation.world.world import Material, Rectangle, World

SCANS = 20
MIDDLE = slice(82, 122)


def wall(distance: float, brightness: float) -> SurfaceTable:
    """A plastered wall across the x axis."""
    world = World(1)
    y, z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    lamp = Rectangle(np.array([1.0, -0.2, 4.0]), np.array([0.4, 0.0, 0.0]), -0.4 * y, Material("metal"))
    world.add_lamp(lamp, 1.0)
    world.add(Rectangle(np.array([distance, 9.0, -6.0]), -18.0 * y, 12.0 * z, Material("plaster", brightness)))
    return compile_world(world)


def main() -> None:
    config = TofSensorConfig(tilt_deg=(0.0, 0.0, 0.0), position=(0.0, 0.0, 0.0))
    sensor, rng = TofSensor(config, seed=1), np.random.default_rng(0)
    length = np.sqrt(1.0 + (sensor.rays.rays[..., :2] ** 2).sum(axis=-1))[MIDDLE, MIDDLE]
    print("distance m  brightness  amplitude  sigma mm  stated mm  bias mm  mean |pattern| mm")
    for brightness in (1.0, 0.4, 0.1):
        for distance in (0.7, 1.0, 2.0, 3.0, 5.0, 7.0):
            world = wall(distance, brightness)
            scans = [sensor.capture(world, np.eye(4), rng, None) for _ in range(SCANS)]
            error = np.stack([s.range[MIDDLE, MIDDLE] - distance * length for s in scans])
            amplitude = np.mean([s.amplitude[MIDDLE, MIDDLE] for s in scans], axis=0)
            noise = 1e3 * np.sqrt(np.mean(error.var(axis=0, ddof=1)))
            stated = 1e3 * np.sqrt(np.mean(sensor.range_sigma(amplitude) ** 2))
            pattern = 1e3 * np.abs(error.mean(axis=0)).mean()
            print(
                f"{distance:10.1f} {brightness:11.1f} {amplitude.mean():10.1f} {noise:9.2f} {stated:10.2f} "
                f"{1e3 * error.mean():8.2f} {pattern:18.2f}"
            )
    print("specification: sigma below 3 mm at 2 m; wraps at 7.5 m")


if __name__ == "__main__":
    main()
