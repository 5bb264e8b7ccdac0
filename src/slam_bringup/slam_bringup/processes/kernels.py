# SPDX-License-Identifier: Apache-2.0
"""Compilation of the kernels before nodes are started by other programs than ``./slam``, which does it itself."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import ekf_slam_node

_PACKAGE = Path(ekf_slam_node.__file__).resolve().parent
_DEMO = _PACKAGE.parents[2] / "bags" / "demo"


def compile_kernels_once(package: Path = _PACKAGE, demo: Path = _DEMO) -> None:
    """Compile all kernels, with a bar, if Numba's cache holds none of ``package``.

    The bag ``demo`` of the checkout needs them all. An installation without it compiles each at its first call.
    """
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or package)
    if demo.exists() and not any(folder.rglob("*.nbi")):
        print("compiling kernels, once; some minutes", file=sys.stderr, flush=True)
        subprocess.run([sys.executable, "-m", "slam_bringup.cli", "warmup", str(demo)], check=False)
