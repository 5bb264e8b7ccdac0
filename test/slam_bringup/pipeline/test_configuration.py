# SPDX-License-Identifier: Apache-2.0
"""Every parameter can be set, and one that became a constant says so."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields

import pytest

from slam_bringup.pipeline.configuration import SystemConfig, system_config
from slam_bringup.pipeline.overrides import overrides_of
from slam_core.config import iterate_parameters

CONSTANTS = ["right_surplus", "fusion.lookup.max_slope", "fusion.motion_speed", "noise.max_factor"]


@pytest.mark.parametrize("name", CONSTANTS)
def test_a_parameter_that_became_a_constant_says_so(name):
    with pytest.raises(ValueError, match=r"old.yaml: feature_extractor: parameter '[\w.]+' is fixed now"):
        system_config(overrides_of({"feature_extractor": {name: 1.5}}, "old.yaml"))


@pytest.mark.parametrize("node", [f.name for f in fields(SystemConfig)])
def test_every_parameter_can_be_set(node):
    for name, value, _ in iterate_parameters(getattr(SystemConfig(), node)):
        assert system_config(overrides_of({node: {name: value}}, "new.yaml")) == SystemConfig(), name


def test_a_run_without_parameters_of_its_own_does_not_load_ros():
    program = """if True:
        import sys
        import slam_bringup.commands.run
        from slam_bringup.pipeline.configuration import load_system_config

        load_system_config(None)
        sys.exit("rclpy" in sys.modules)
    """
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
