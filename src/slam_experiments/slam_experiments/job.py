# SPDX-License-Identifier: Apache-2.0
"""A piece of work of an experiment, whose result is kept and used again until something that it depends on changes.

    bag = Job("slam_experiments.simulated.rendering:render", {"scenario": "sweep"}, RENDERING)
    run = Job("slam_experiments.experiments.chain:map_bag", {"mode": "stereo"}, EVERYTHING, after=(bag,))
    result = execute(run, cache)  # after execute(bag, cache)

A job is named by a digest of its function, its arguments, the source of the packages it uses and the jobs it builds on.
Its function gets a folder to write to, the folders of the jobs it builds on, and the arguments; it returns
what is kept beside: values (JSON) and arrays. It must not depend on anything else, so that neither order nor number of
workers shows in a result.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

RENDERING = (
    "slam_core.geometry",
    "slam_core.camera",
    "slam_core.types",
    "slam_core.messages.images",
    "slam_core.messages.cameras",
    "slam_simulation",
)
EVERYTHING = (
    "slam_core", "slam_simulation", "slam_calibration", "stereo_frontend", "tof_driver", "ndt_registration",
    "ekf_slam_node", "sjsam_node", "slam_bringup.pipeline", "slam_bags",
)  # fmt: skip
Kept = tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]
"""Result of a job's function: values as JSON knows them, and arrays by name."""
VALUES = "result.json"
"""File of a result's values in its folder."""
_ARRAYS = "arrays.npz"


@dataclass(frozen=True)
class Job:
    """``function`` ("module:name") with its arguments, the packages it depends on and the jobs before it."""

    function: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    packages: tuple[str, ...] = EVERYTHING
    after: tuple[Job, ...] = ()

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def digest(self) -> str:
        """Name of the result, 16 hexadecimal digits."""
        module = self.function.partition(":")[0]
        parts = [self.function, json.dumps(dict(self.arguments), sort_keys=True), _source_of(module)]
        parts += [_source_of(package) for package in self.packages] + [job.digest for job in self.after]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]

    @property
    def title(self) -> str:
        """Title for the progress bar."""
        arguments = " ".join(str(v) for v in self.arguments.values() if v not in (None, ""))
        return f"{self.function.partition(':')[2].replace('_', ' ')} {arguments}".strip()

    def folder(self, cache: Path) -> Path:
        """Folder in which the result is kept."""
        return cache / f"{self.function.partition(':')[2]}-{self.digest}"


@dataclass(frozen=True, eq=False)
class JobResult:
    """Result of a job: ``values`` as JSON knows them, ``arrays`` by name, and the folder with any files it wrote."""

    folder: Path
    values: dict[str, Any]
    arrays: dict[str, npt.NDArray[Any]]


def execute(job: Job, cache: Path) -> Path:
    """Run a job unless its result is kept; the folder of the result."""
    folder = job.folder(cache)
    if (folder / VALUES).exists():
        return folder
    module, _, name = job.function.partition(":")
    unfinished = folder.with_name(f"{folder.name}.{os.getpid()}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    before = [earlier.folder(cache) for earlier in job.after]
    values, arrays = getattr(importlib.import_module(module), name)(unfinished, before, **job.arguments)
    np.savez_compressed(unfinished / _ARRAYS, **arrays)
    (unfinished / VALUES).write_text(json.dumps(values, indent=1), encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    unfinished.rename(folder)
    return folder


def load(folder: Path) -> JobResult:
    """The result of a job that has been executed."""
    with np.load(folder / _ARRAYS) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return JobResult(folder, json.loads((folder / VALUES).read_text(encoding="utf-8")), arrays)


def in_order(jobs: Sequence[Job]) -> list[Job]:
    """Every job and those before it, each once, none before what it builds on."""
    ordered: dict[str, Job] = {}

    def visit(job: Job) -> None:
        for earlier in job.after:
            visit(earlier)
        ordered.setdefault(job.digest, job)

    for job in jobs:
        visit(job)
    return list(ordered.values())


@cache
def _source_of(package: str) -> str:
    """Digest of a module's or package's source."""
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise ValueError(f"there is no package {package}")
    origin = Path(spec.origin)
    files = sorted(_files_of(origin.parent)) if origin.name == "__init__.py" else [origin]
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def _files_of(folder: Path) -> list[Path]:
    """Source and scenarios of a package; unlike :meth:`Path.rglob`, glob follows links to folders."""
    return [Path(name) for ending in ("py", "yaml") for name in glob(f"{folder}/**/*.{ending}", recursive=True)]
