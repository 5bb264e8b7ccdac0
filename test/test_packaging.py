# SPDX-License-Identifier: Apache-2.0
"""Each package names what it imports, for pip (setup.py) and for ROS (package.xml)."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

SRC = Path(__file__).resolve().parent.parent / "src"
PACKAGES = sorted(path.name for path in SRC.iterdir() if (path / "setup.py").exists())
PIP_NAME = {"cv2": "opencv-python-headless", "yaml": "PyYAML", "jinja2": "Jinja2", "zenoh": "eclipse-zenoh"}
ROSDEP_KEY = {
    **{name: f"python3-{name}" for name in ("numpy", "scipy", "numba", "click", "rich", "jinja2", "yaml")},
    "matplotlib": "python3-matplotlib",
    "cv2": "python3-opencv",
    "cvxopt": "python3-cvxopt",
    "rosbags": "python3-rosbags-pip",
    "plyfile": "python3-plyfile-pip",
    "trimesh": "python3-trimesh-pip",
    "filterpy": "python3-filterpy-pip",
}
"""Keys of rosdep/python.yaml in ros/rosdistro (August 2026)."""
NO_ROSDEP_KEY = {"threadpoolctl", "viser", "eclipse-zenoh", "constriction", "distributed"}
"""Projects that rosdep does not know; README says how to get them, and each manifest that it lacks them."""

WITH_DATA = ("slam_simulation", "slam_bags", "slam_viewer", "slam_bringup", "slam_experiments")

FROM_ROS = re.compile(r"rclpy|launch(_ros)?|ament_index_python|std_srvs|rcl_interfaces|\w+_msgs|builtin_interfaces")
PEERS = {"gtsam", "orbslam3"}
"""What results are compared with, where it is installed."""

OPTIONAL = {"pyopencl", "distributed"}
"""What is used where it is installed; one of the extras of setup.py brings it."""

BROUGHT_BY_ANOTHER = {"llvmlite": "numba", "mpl_toolkits": "matplotlib", "dask": "distributed", "websockets": "viser"}


def imported(package: str) -> set[str]:
    names: set[str] = set()
    for path in (SRC / package / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names.add((node.module or "").split(".")[0])
    return names - set(sys.stdlib_module_names) - {package}


@pytest.mark.parametrize("package", PACKAGES)
def test_setup_and_package_xml_name_every_import(package: str) -> None:
    setup, manifest = ((SRC / package / name).read_text(encoding="utf-8") for name in ("setup.py", "package.xml"))
    required, optional = (
        {name for text in re.findall(pattern, setup, re.DOTALL) for name in re.findall(r'"([^"]+)"', text)}
        for pattern in (r"install_requires=\[(.*?)\]", r"extras_require={(.*?)}")
    )
    named = set(re.findall(r"<(?:exec_)?depend>([^<]+)<", manifest))
    for name in imported(package):
        if FROM_ROS.fullmatch(name):
            assert name in named, f"package.xml of {package} lacks {name}"
        elif name in OPTIONAL - required:
            assert name in optional, f"no extra of setup.py of {package} brings {name}"
        elif name not in BROUGHT_BY_ANOTHER and name not in PEERS:
            assert PIP_NAME.get(name, name) in required, f"setup.py of {package} lacks {name}"
            if (project := PIP_NAME.get(name, name)) in NO_ROSDEP_KEY:
                assert f"{project} has no rosdep key" in manifest, package
            else:
                key = name if name in PACKAGES else ROSDEP_KEY.get(name)
                assert key is not None, f"give the rosdep key of {name}, or say that there is none"
                assert key in named, f"package.xml of {package} lacks {key}"


@pytest.mark.parametrize("package", PACKAGES)
def test_package_xml_names_nothing_that_is_not_needed_and_is_whole(package: str) -> None:
    """As bloom reads it (REP 149); a key that no import needs would be installed on every robot."""
    manifest = ElementTree.parse(SRC / package / "package.xml").getroot()
    assert manifest.get("format") == "3"
    assert manifest.findtext("name") == package
    assert manifest.findtext("export/build_type") == "ament_python"
    assert manifest.findtext("license") == "Apache-2.0"
    assert manifest.find("maintainer").get("email")
    assert len(manifest.findtext("description")) > 20
    needed = {ROSDEP_KEY.get(name, name) for name in imported(package)}
    named = {element.text for kind in ("depend", "exec_depend") for element in manifest.findall(kind)}
    assert len(named) == sum(len(manifest.findall(kind)) for kind in ("depend", "exec_depend"))
    assert not {key for key in named if key.startswith("python3-")} - needed


def test_what_the_readme_installs_is_what_rosdep_lacks_or_takes_from_pip() -> None:
    readme = (SRC.parent / "README.md").read_text(encoding="utf-8")
    skipped = set(re.search(r'--skip-keys "([^"]+)"', readme)[1].split())
    assert skipped == {key for key in ROSDEP_KEY.values() if key.endswith("-pip")}
    by_pip = set(re.search(r"^pip install (.*?) +#", readme, re.MULTILINE)[1].split())
    without_key = NO_ROSDEP_KEY | {name for name, key in ROSDEP_KEY.items() if key.endswith("-pip")}
    assert by_pip - {"'numpy<2'"} == without_key - {"distributed", "filterpy"}, "these two are of the experiments"


@pytest.mark.parametrize("package", sorted(set(PACKAGES) - {"slam_simulation", "slam_experiments"}))
def test_a_package_for_robots_holds_all_that_it_installs(package: str) -> None:
    """Bloom releases each package as a tree of its own: a link out of it would lead nowhere."""
    root = (SRC / package).resolve()
    assert not [path for path in root.rglob("*") if path.is_symlink() and not path.resolve().is_relative_to(root)]


@pytest.mark.parametrize("package", PACKAGES)
def test_setup_installs_files_by_their_ending(package: str) -> None:
    """A pattern that takes all takes a folder of compiled modules too, with which the next build fails."""
    patterns = re.findall(r'glob\("([^"]*)"\)', (SRC / package / "setup.py").read_text())
    assert not [pattern for pattern in patterns if pattern.endswith("*")]


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """What a wheel and a colcon install hold of the packages that bring data."""
    folder = tmp_path_factory.mktemp("installed")
    for package in WITH_DATA:
        build = [sys.executable, "setup.py", "-q", "egg_info", "-e", str(folder), "build_py", "-d", str(folder)]
        subprocess.run(build, cwd=SRC / package, check=True, capture_output=True, timeout=120)
    return folder


def test_kernels_in_opencl_are_installed(tmp_path):
    build = [sys.executable, "setup.py", "-q", "build_py", "-d", str(tmp_path)]
    subprocess.run(build, cwd=SRC / "stereo_frontend", check=True, capture_output=True, timeout=120)
    kernels = {path.name for path in (SRC / "stereo_frontend").rglob("*.cl")}
    assert {path.name for path in tmp_path.rglob("*.cl")} == kernels == {"surf_detector.cl", "surf_descriptor.cl"}


@pytest.mark.parametrize("package", WITH_DATA)
def test_every_module_is_installed(installed, package):
    """What is there need not be compiled and run to show that nothing is missing."""
    there, here = (
        {path.relative_to(root).as_posix() for path in root.rglob("*.py")}
        for root in (installed / package, SRC / package / package)
    )
    assert there == here


def test_scenarios_bounds_and_demo_bag_are_installed(installed):
    for link, source in (
        ("slam_simulation/scenarios", "scenarios"),
        ("slam_simulation/expected.yaml", "expected.yaml"),
        ("slam_bringup/demo", "demo"),
    ):
        there, here = installed / link, SRC.parent / "bags" / source
        assert not there.is_symlink()
        for path in [here] if here.is_file() else sorted(here.iterdir()):
            copy = there if here.is_file() else there / path.name
            assert copy.read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("simulate", "nonsense", "-o", "bag"), 2, "known: back_to_back, conference, corridor_with_positions"),
        (("simulate", "demo", "-o", "/proc/bag", "--frames", "1"), 2, "No such file or directory"),
        (("experiment", "planar", "--quick", "-o", "page"), 0, "written to"),
        (("demo", "--help"), 0, "--view"),
        (("--help",), 0, "experiment the experiments of the thesis"),
    ],
)
def test_installed_commands_run_in_an_empty_folder(installed, tmp_path, arguments, code, said):
    others = (str(SRC / package) for package in PACKAGES if not (installed / package).is_dir())
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(installed), *others))}
    command = [sys.executable, "-m", "slam_bringup.cli", *arguments]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == code, done.stderr
    assert said in " ".join((done.stdout + done.stderr).split())
