# SPDX-License-Identifier: Apache-2.0
"""Compilation of the kernels before other programs than ``./slam``, which does it itself, begin to map."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import ekf_slam_node
import slam_bringup

_PACKAGE = Path(ekf_slam_node.__file__).resolve().parent
DEMO = Path(slam_bringup.__file__).parent / "demo"
"""``bags/demo`` of the sources, installed with the package."""


def compile_kernels_once(package: Path = _PACKAGE, demo: Path = DEMO) -> None:
    """Compile all kernels, with a bar, if Numba's cache holds none of ``package``.

    The bag ``demo`` needs them all. Where nothing can be written beside ``package``, Numba keeps kernels in a folder of
    the user's, and each is compiled at its first call.
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if not demo.exists() or not (chosen or os.access(package, os.W_OK)):
        return
    if not any(Path(chosen or package).rglob("*.nbi")):
        print("compiling kernels, once; some minutes", file=sys.stderr, flush=True)
        subprocess.run([sys.executable, "-m", "slam_bringup.cli", "warmup", str(demo)], check=False)
