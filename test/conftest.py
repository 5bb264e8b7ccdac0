# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures: the public data sets (skipped with a reason where absent) and seeded random numbers."""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is loaded, as slam_core.blas_threads

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the public data sets: $INDOOR_SLAM_DATA or ../shared/data beside the checkout."""
    path = Path(os.environ.get("INDOOR_SLAM_DATA", ROOT.parent / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"no public data sets at {path} (set INDOOR_SLAM_DATA)")
    return path


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(12345)


@pytest.fixture(scope="session", autouse=True)
def state_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Nodes keep their copies here, not in the user's state, and go on from nobody else's."""
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))
