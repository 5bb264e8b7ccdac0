# SPDX-License-Identifier: Apache-2.0
"""The parameter reference in docs/ says what the code says."""

from __future__ import annotations

from pathlib import Path

import pytest

from slam_bringup.parameter_reference import reference

PAGE = Path(__file__).resolve().parents[2] / "docs" / "parameters.md"


@pytest.mark.ros
def test_the_page_is_up_to_date_and_has_every_node():
    pytest.importorskip("rclpy")
    for node in ("stereo_driver", "tof_driver", "sjsam", "dense_mapper", "viewer", "recorder", "Every node"):
        assert f"## {node}" in reference()
    for name in ("source", "pictures", "map_path", "output_path", "input.policy", "port"):
        assert f"| `{name}` |" in reference()
    assert PAGE.read_text(encoding="utf-8") == reference(), (
        "run: python -m slam_bringup.parameter_reference > docs/parameters.md"
    )
