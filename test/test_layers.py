# SPDX-License-Identifier: Apache-2.0
"""The rules of the architecture: imports point down, none in a circle, and ROS stays in the nodes."""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parent.parent / "src"
LAYER = {
    "slam_core": 0,
    "slam_calibration": 1,
    "slam_radio": 1,
    "stereo_frontend": 1,
    "tof_driver": 1,
    "ndt_registration": 1,
    "slam_simulation": 2,
    "slam_bags": 2,
    "ekf_slam_node": 2,
    "sjsam_node": 2,
    "dense_mapping": 2,
    "slam_viewer": 3,
    "slam_bringup": 4,
    "indoor_slam": 5,
    "slam_experiments": 5,
}
NOT_SHIPPED = {"slam_simulation", "slam_experiments"}
"""What a robot does not install: nothing else may import or require it."""
ROS = re.compile(r"^(rclpy|tf2_ros|launch(_ros)?|ament_index_python|builtin_interfaces|std_srvs|[a-z0-9]+_msgs)$")
MAY_IMPORT_ROS = re.compile(r"(^|/)(node|[a-z_]+_node|ros|[a-z_]+\.launch)\.py$")
STRUCTURE = SRC.parent / "benchmarks" / "house" / "structure.py"
FILES = sorted(path for path in SRC.rglob("*.py") if path.name != "setup.py")


def imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""


def test_every_package_is_known():
    assert {path.name for path in SRC.iterdir() if path.is_dir()} == set(LAYER)


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SRC)))
def test_imports_point_down_and_ros_stays_in_nodes(path):
    package = path.relative_to(SRC).parts[0]
    for name in imported(path):
        root = name.split(".")[0]
        if root in LAYER:
            assert root == package or LAYER[root] < LAYER[package], f"{path} imports {name}, not below it"
            assert root not in NOT_SHIPPED or package in NOT_SHIPPED, f"{path} imports {name}, which is not shipped"
            # A node imports the algorithm, never the reverse.
            if not MAY_IMPORT_ROS.search(str(path)):
                module = name.split(".")[-1]
                assert module in LAYER or not re.fullmatch(r"node|\w+_node|ros", module), f"{path} imports a node"
        assert not ROS.match(root) or MAY_IMPORT_ROS.search(str(path)), f"{path}: ROS belongs in nodes"


@pytest.mark.parametrize("package", sorted(LAYER.keys() - NOT_SHIPPED))
@pytest.mark.parametrize("name", ["setup.py", "package.xml"])
def test_what_is_shipped_requires_nothing_that_is_not(package, name):
    text = re.sub(r"extras_require={.*?}", "", (SRC / package / name).read_text(encoding="utf-8"))
    assert not [other for other in (*NOT_SHIPPED, "dask", "distributed") if re.search(rf"\b{other}\b", text)]


@pytest.fixture(scope="module")
def structure():
    spec = importlib.util.spec_from_file_location("structure", STRUCTURE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_no_imports_run_in_a_circle(structure):
    trees = structure.read_trees(SRC.parent)
    for imports in (structure.module_imports(trees), structure.folder_imports(trees)):
        assert structure.circles(imports) == []


def test_a_circle_is_found(structure):
    assert structure.circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]
