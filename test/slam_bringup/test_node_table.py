# SPDX-License-Identifier: Apache-2.0
"""The table of the nodes says what their packages and classes say, and the figure in docs/ is made from it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from slam_bringup.data_flow import figure
from slam_bringup.pipeline.node_table import NODES, NodeDeclaration
from slam_core.config import Config

EVERY_SENSOR = {
    "feature_extractor": [("mode:=fuse",)],
    "sjsam": [("autosave_period_s:=0.0",)],
    "radio_link": [(f"role:={role}", "agents:=['anna']", "connect:=['tcp/127.0.0.1:1']") for role in ("agent", "post")],
}
"""Parameters with which a node has all its topics, some here and some there."""

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("declared", NODES, ids=lambda d: d.executable)
def test_every_declared_node_is_an_executable_of_its_package(declared: NodeDeclaration) -> None:
    setup = (ROOT / "src" / declared.package / "setup.py").read_text(encoding="utf-8")
    assert f'"{declared.executable} = {declared.module}:main"' in setup


def test_every_executable_is_declared() -> None:
    found = {
        name
        for setup in (ROOT / "src").glob("*/setup.py")
        for name in re.findall(r'"(\w+) = [\w.]+:main"', setup.read_text(encoding="utf-8"))
    }
    assert found - {"slam", "slam_composed"} == {declared.executable for declared in NODES}


@pytest.mark.ros
@pytest.mark.parametrize("declared", NODES, ids=lambda d: d.executable)
def test_the_classes_of_every_node_can_be_loaded(declared: NodeDeclaration) -> None:
    pytest.importorskip("rclpy")
    assert issubclass(declared.load_config_class(), Config)
    assert hasattr(declared.load_node_class(), "create_subscription")


@pytest.mark.ros
@pytest.mark.parametrize("declared", [d for d in NODES if not d.is_tool], ids=lambda d: d.executable)
def test_every_node_has_the_topics_that_are_declared(declared: NodeDeclaration) -> None:
    rclpy = pytest.importorskip("rclpy")
    found: set[str] = set()
    for parameters in EVERY_SENSOR.get(declared.executable, [()]):
        given = [text for p in parameters for text in ("-p", p)]
        rclpy.init(args=["--ros-args", *given] if given else [])
        node = None
        try:
            node = declared.load_node_class()()
            topics = (s.topic_name.strip("/") for s in (*node.subscriptions, *node.publishers))
            found |= {topic.removeprefix("anna/") for topic in topics}
        finally:
            if node is not None:
                node.on_close()
                node.destroy_node()
            rclpy.try_shutdown()
    assert expanded((*declared.inputs, *declared.outputs)) - found == set()


def expanded(topics: tuple[str, ...]) -> set[str]:
    """Topics with each side written out."""
    return {t.replace("{left,right}", side) for t in topics for side in ("left", "right")}


def test_the_figure_in_the_docs_is_made_from_the_table() -> None:
    assert figure() in (ROOT / "docs" / "design.md").read_text(encoding="utf-8"), (
        "run: python -m slam_bringup.data_flow, and put its output into docs/design.md"
    )
