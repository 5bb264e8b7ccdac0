# SPDX-License-Identifier: Apache-2.0
"""The Fast DDS profiles: which one a process takes, and what they say."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from slam_bringup.processes.supervisor_node import transport_of_the_nodes
from slam_core import ros

pytestmark = pytest.mark.ros

FOLDER = Path(ros.__file__).parent
VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"


def content(name: str) -> list[tuple[str, str]]:
    """Tags (without namespace) and texts of a profile, in order."""
    elements = ElementTree.parse(FOLDER / name).iter()
    return [(e.tag.rpartition("}")[2], (e.text or "").strip()) for e in elements]


def test_the_profiles_differ_in_nothing_but_the_size_of_packets() -> None:
    usual, small = content("fastdds.xml"), content("fastdds_small_packets.xml")
    extra = [entry for entry in small if entry not in usual]
    assert [text for _, text in extra if text] == ["fastdds.max_message_size", "1400"]
    assert [entry for entry in small if entry not in extra] == usual


@pytest.mark.parametrize("name", ["fastdds.xml", "fastdds_small_packets.xml"])
def test_fast_dds_takes_every_element_of_a_profile(name: str) -> None:
    script = "import rclpy; rclpy.init(); rclpy.create_node('reader_of_the_profile')"
    environment = os.environ | {VARIABLE: str(FOLDER / name)}
    told = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert "XMLPARSER" not in told.stdout + told.stderr


@pytest.mark.parametrize(("own", "expected"), [({}, str(FOLDER / "fastdds.xml")), ({VARIABLE: "own.xml"}, "own.xml")])
def test_the_supervisor_takes_the_profile_of_the_nodes_and_leaves_the_environment(
    monkeypatch: pytest.MonkeyPatch, own: dict[str, str], expected: str
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    before = dict(os.environ)
    with transport_of_the_nodes(own):
        assert os.environ[VARIABLE] == expected
    assert dict(os.environ) == before
