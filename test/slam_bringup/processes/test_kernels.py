# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

from slam_bringup.processes import kernels


def test_kernels_are_compiled_only_where_none_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    monkeypatch.setattr(subprocess, "run", lambda command, **_: calls.append(command))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    package, demo = tmp_path / "package", tmp_path / "demo"
    (package / "__pycache__").mkdir(parents=True)
    kernels.compile_kernels_once(package, demo)
    assert calls == [], "an installation without the demo's bag"
    demo.mkdir()
    kernels.compile_kernels_once(package, demo)
    assert calls.pop()[-2:] == ["warmup", str(demo)]
    (package / "__pycache__" / "ekf.update-1.py311.nbi").touch()
    kernels.compile_kernels_once(package, demo)
    assert calls == []
    assert kernels.DEMO.is_dir()


def test_an_installation_that_is_read_only_leaves_them_to_numba(tmp_path, monkeypatch):
    calls: list[Any] = []
    monkeypatch.setattr(subprocess, "run", lambda command, **_: calls.append(command))
    monkeypatch.setattr(os, "access", lambda path, mode: (path, mode) != (tmp_path, os.W_OK))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    kernels.compile_kernels_once(tmp_path, tmp_path)
    assert calls == []
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernels.compile_kernels_once(tmp_path, tmp_path)
    assert len(calls) == 1
