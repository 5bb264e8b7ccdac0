# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def out(tutorial: Path) -> Path:
    """What ``slam run --mode fuse`` leaves of the demo bag."""
    return tutorial / "out" / "tutorial"
