# SPDX-License-Identifier: Apache-2.0
"""The driver's sigma against the true depth of the simulated building, seen by the simulated CamCube."""

from __future__ import annotations

import numpy as np

from slam_simulation.rendering.raycaster import camera_rays, make_view, trace
from slam_simulation.scenario import Scenario
from slam_simulation.simulator import Simulator
from tof_driver.depth import DepthConfig, DepthProcessor


def test_normalised_errors_are_standard_normal() -> None:
    simulator = Simulator(Scenario.load("small_room"), threads=1)
    processor = DepthProcessor(DepthConfig(), simulator.tof.camera)
    rays = camera_rays(processor.output_camera)
    errors = []
    for k in (0, 150, 300):
        T = simulator.path.pose(k / simulator.scenario.rate)
        images = simulator.tof.capture(simulator.world, T, np.random.default_rng(k), None)
        image = processor.process(0, images.range, images.amplitude, images.intensity)
        truth = trace(make_view(simulator.world, T @ simulator.tof.T_rig_tof, rays.bounds), rays, None).depth
        error = (image.depth - truth) / image.sigma
        errors.append(error[np.isfinite(error)])
    normalised = np.concatenate(errors)
    assert len(normalised) > 0.85 * 3 * 204 * 204
    assert 0.95 < np.std(normalised) < 1.1
    assert np.mean(np.abs(normalised) > 5.0) < 0.001
