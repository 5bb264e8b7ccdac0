# SPDX-License-Identifier: Apache-2.0
"""Length of the chains from a stereo pair to its features, and from a submap to the map: calls, functions, files.

    PYTHONPATH=... python benchmarks/house/chains.py BAG

Maps the bag with the packages that the path names, so that two states can be compared. Medians over the frames and
submaps; Python functions of the packages below ``src`` count, compiled kernels do not. "turns back" are calls from
another file into the file where the chain began.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import threading
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

CHAINS = {
    "a stereo pair to its keypoints": ("stereo_frontend/frontend.py", "extract"),
    "keypoints to features": ("stereo_frontend/frontend.py", "measure"),
    "a frame through the filter": ("ekf_slam_node/slam.py", "process"),
    "a submap to the map": ("sjsam_node/global_map.py", "add"),
}
"""File and method with which a chain begins."""


@dataclass
class Chain:
    """Calls of one chain so far. ``began``: the frame in which it started."""

    name: str
    file: str
    began: FrameType
    calls: int = 1
    turns: int = 0
    functions: set[str] = field(default_factory=set)


class Tracer:
    """Profile function of all threads; counts by chain."""

    def __init__(self) -> None:
        self.found: dict[str, list[tuple[int, int, int, int]]] = defaultdict(list)
        self._local = threading.local()

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        """Take one event, as ``sys.setprofile`` passes it."""
        if event not in ("call", "return"):
            return
        file = frame.f_code.co_filename
        chain: Chain | None = getattr(self._local, "chain", None)
        if chain is None:
            if event == "call":
                self._local.chain = _begun(frame)
        elif event == "return":
            if frame is chain.began:
                files = {name.partition(":")[0] for name in chain.functions}
                self.found[chain.name].append((chain.calls, len(chain.functions), len(files), chain.turns))
                self._local.chain = None
        elif "/src/" in file:
            chain.calls += 1
            chain.functions.add(f"{file}:{frame.f_code.co_firstlineno}")
            caller = frame.f_back.f_code.co_filename if frame.f_back else ""
            chain.turns += file.endswith(chain.file) and caller != file


def _begun(frame: FrameType) -> Chain | None:
    code = frame.f_code
    for name, (file, method) in CHAINS.items():
        if code.co_name == method and code.co_filename.endswith(file):
            return Chain(name, file, frame, functions={f"{code.co_filename}:{code.co_firstlineno}"})
    return None


def main() -> None:
    """Print a row per chain."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    bag = parser.parse_args().bag
    from slam_bringup.cli import slam

    tracer = Tracer()
    with tempfile.TemporaryDirectory() as folder:
        threading.setprofile(tracer)
        sys.setprofile(tracer)
        slam(["run", str(bag), "-o", f"{folder}/out"], standalone_mode=False)
        sys.setprofile(None)
    print("| chain | calls | functions | files | turns back |\n|---|---|---|---|---|")
    for name in CHAINS:
        columns = [f"{statistics.median(column):g}" for column in zip(*tracer.found[name], strict=True)]
        print(f"| {name} | " + " | ".join(columns) + " |")


if __name__ == "__main__":
    main()
