# SPDX-License-Identifier: Apache-2.0
"""Every parameter can be set."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields

import pytest

from slam_bringup.pipeline.configuration import SystemConfig, system_config
from slam_bringup.pipeline.overrides import overrides_of
from slam_core.config import iterate_parameters


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
