# SPDX-License-Identifier: Apache-2.0
"""The one distribution of all packages: what its wheel and its archive of sources hold, and what they require.

That it installs and maps in an empty environment takes minutes: ``benchmarks/house/wheel.sh`` shows it.
"""

from __future__ import annotations

import configparser
import email
import importlib.util
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from slam_core.version import VERSION

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = sorted(path.name for path in (ROOT / "src").iterdir() if (path / "setup.py").exists())
DATA = {
    "slam_bringup/demo/demo.mcap", "slam_simulation/scenarios/demo.yaml", "slam_simulation/expected.yaml",
    "slam_core/fastdds.xml", "slam_radio/packing/surf128_basis.npy", "slam_viewer/report/report.html.j2",
    "slam_experiments/experiments.html.j2", "stereo_frontend/surf/surf_detector.cl", "slam_core/py.typed",
}  # fmt: skip
BUILD_TOOLS = {"colcon-common-extensions", "colcon-ros", "setuptools"}


@pytest.fixture(scope="module")
def dist(tmp_path_factory) -> Path:
    for tool in ("build", "hatchling"):
        if importlib.util.find_spec(tool) is None:
            pytest.skip(f"{tool} is not installed (requirements-dev.txt)")
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    done = subprocess.run(build, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return folder


@pytest.fixture(scope="module")
def wheel(dist):
    """The wheel, which ``build`` makes from the archive of sources."""
    with zipfile.ZipFile(next(dist.glob("*.whl"))) as opened:
        yield opened


@pytest.fixture(scope="module")
def metadata(wheel):
    return email.message_from_bytes(wheel.read(f"indoor_slam-{VERSION}.dist-info/METADATA"))


def files_of(package: str) -> dict[str, Path]:
    """Every file of a package by its name in the wheel; links to ``bags`` are followed."""
    found = {}
    folders = [ROOT / "src" / package / package]
    while folders:
        for path in folders.pop().iterdir():
            if path.is_dir():
                folders += [path] * (path.name != "__pycache__")
            elif path.suffix not in (".pyc", ".nbi", ".nbc"):
                found[path.relative_to(ROOT / "src" / package).as_posix()] = path
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_the_wheel_holds_every_file_of_a_package(wheel, package):
    here = files_of(package)
    names = {name for name in wheel.namelist() if name.startswith(f"{package}/") and not name.endswith("/")}
    assert names == here.keys()
    for name, path in here.items():
        assert wheel.read(name) == path.read_bytes(), name


def test_the_wheel_holds_its_data_and_nothing_else(wheel):
    names = set(wheel.namelist())
    assert names >= DATA
    assert {name.split("/")[0] for name in names} == {*PACKAGES, f"indoor_slam-{VERSION}.dist-info"}
    assert not [name for name in names if re.search(r"(^|/)(tests?|conftest\.py|setup\.py|test_\w+\.py)(/|$)", name)]


def test_links_are_files_in_the_archive_of_sources(dist):
    with tarfile.open(next(dist.glob("*.tar.gz"))) as opened:
        members = {member.name.partition("/")[2]: member for member in opened}
    links = [name for name, member in members.items() if member.issym()]
    assert links == ["src/slam_simulation/slam_simulation/expected.yaml"]
    assert "bags/expected.yaml" in members, "to which that link leads"
    assert members["src/slam_simulation/slam_simulation/scenarios/demo.yaml"].isfile()


def test_its_commands_are_those_of_the_packages(wheel):
    entries = configparser.ConfigParser()
    entries.read_string(wheel.read(f"indoor_slam-{VERSION}.dist-info/entry_points.txt").decode())
    assert dict(entries["console_scripts"]) == {"slam": "slam_bringup.cli:main"}
    registered = re.findall(
        r'"slam\.commands": \["(\w+) = ([\w.:]+)"\]',
        "".join((ROOT / "src" / package / "setup.py").read_text(encoding="utf-8") for package in PACKAGES),
    )
    assert registered
    assert dict(entries["slam.commands"]) == dict(registered)


def required(metadata, extra: str = "") -> dict[str, Requirement]:
    found = map(Requirement, metadata.get_all("Requires-Dist"))
    return {
        canonicalize_name(r.name): r
        for r in found
        if (r.marker is None if not extra else r.marker is not None and r.marker.evaluate({"extra": extra}))
    }


def pinned(name: str) -> dict[str, str]:
    lines = (ROOT / f"requirements{name}.txt").read_text(encoding="utf-8").splitlines()
    pairs = (line.partition(";")[0].partition("==") for line in lines if "==" in line)
    return {canonicalize_name(project): version.strip() for project, _, version in pairs}


@pytest.mark.parametrize(
    ("extra", "pins"), [("", ""), ("experiments", "-experiments"), ("ros", "-ros"), ("gpu", "-dev")]
)
def test_it_requires_what_is_pinned_and_admits_the_versions_that_are_tested(metadata, extra, pins):
    found, tested = required(metadata, extra), pinned(pins)
    if extra == "gpu":
        tested = {"pyopencl": tested["pyopencl"]}
    not_needed = BUILD_TOOLS | ({"dask"} if extra == "experiments" else set())  # distributed brings dask
    assert found.keys() == tested.keys() - not_needed
    for name, requirement in found.items():
        assert requirement.specifier.contains(tested[name]), requirement


def test_it_requires_what_its_packages_do(metadata):
    setups = {package: (ROOT / "src" / package / "setup.py").read_text(encoding="utf-8") for package in PACKAGES}
    needed = {
        canonicalize_name(name)
        for text in setups.values()
        for name in re.findall(r'"([^"]+)"', re.search(r"install_requires=\[(.*?)\]", text, re.DOTALL)[1])
    }
    own = {canonicalize_name(name) for name in PACKAGES} | {"setuptools"}
    assert needed - own == required(metadata).keys() | required(metadata, "experiments").keys()


def test_one_version_stands_everywhere(metadata):
    assert metadata["Version"] == VERSION
    assert f"\nversion: {VERSION}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    for package in PACKAGES:
        assert f'version="{VERSION}"' in (ROOT / "src" / package / "setup.py").read_text(encoding="utf-8"), package


def test_pypi_would_take_it(dist):
    if importlib.util.find_spec("twine") is None:
        pytest.skip("twine is not installed (requirements-dev.txt)")
    check = [sys.executable, "-m", "twine", "check", "--strict", *map(str, dist.iterdir())]
    done = subprocess.run(check, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
