# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from slam_bringup.cli import slam

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"


@pytest.fixture(scope="session")
def out(tmp_path_factory) -> Path:
    """What ``slam run`` leaves of the demo bag."""
    folder = tmp_path_factory.mktemp("result") / "out"
    assert CliRunner().invoke(slam, ["run", str(DEMO), "-o", str(folder), "--mode", "fuse"]).exit_code == 0
    return folder
