# SPDX-License-Identifier: Apache-2.0
"""Files of floor plans, read by the rules of Nav2's map_server."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from dense_mapping.plans.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan
from dense_mapping.plans.plan_io import read_plan, write_plan
from slam_core.geometry import make_transform, rotation_from_euler


@pytest.fixture
def plan(rng) -> FloorPlan:
    cells = rng.choice(np.array([FREE, OCCUPIED, UNKNOWN], dtype=np.int8), (7, 11))
    return FloorPlan(cells, 0.05, make_transform(rotation_from_euler(0.3), np.array([-1.5, 2.0, -0.1])))


def nav2_cells(path) -> tuple[np.ndarray, dict]:
    """What nav2_map_server's loader makes of the files in trinary mode, after its documentation."""
    settings = yaml.safe_load(path.read_text())
    data = (path.parent / settings["image"]).read_bytes()
    magic, size, depth, pixels = data.split(b"\n", 3)
    width, height = map(int, size.split())
    assert magic == b"P5"
    assert depth == b"255"
    image = np.frombuffer(pixels, dtype=np.uint8).reshape(height, width)
    occupancy = (255 - image) / 255.0
    cells = np.full(image.shape, -1, dtype=np.int8)
    cells[occupancy >= settings["occupied_thresh"]] = 100
    cells[occupancy <= settings["free_thresh"]] = 0
    return cells[::-1], settings  # the first row of the image is the last of the grid


def test_nav2_reads_the_same_cells_at_the_same_place(plan, tmp_path):
    write_plan(tmp_path / "floor_plan.yaml", plan)
    cells, settings = nav2_cells(tmp_path / "floor_plan.yaml")
    np.testing.assert_array_equal(cells, plan.cells)
    assert settings["resolution"] == plan.resolution
    np.testing.assert_allclose(settings["origin"], [-1.5, 2.0, 0.3])
    assert settings["mode"] == "trinary"
    assert settings["negate"] == 0


def test_a_plan_comes_back_as_it_was(plan, tmp_path):
    write_plan(tmp_path / "floor_plan.yaml", plan)
    back = read_plan(tmp_path / "floor_plan.yaml")
    np.testing.assert_array_equal(back.cells, plan.cells)
    np.testing.assert_allclose(back.T_map_plan, plan.T_map_plan)


def test_a_plan_of_another_program_is_read(plan, tmp_path):
    write_plan(tmp_path / "floor_plan.yaml", plan)
    settings = yaml.safe_load((tmp_path / "floor_plan.yaml").read_text())
    del settings["plan_pose"], settings["floor_height"]
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(settings))
    back = read_plan(tmp_path / "other.yaml")
    np.testing.assert_allclose(back.T_map_plan[:2], plan.T_map_plan[:2], atol=1e-12)


@pytest.mark.parametrize("text", ["", "image: missing.pgm\n", "- 1\n", ": :"])
def test_what_is_no_plan_is_refused_by_name(tmp_path, text):
    (tmp_path / "floor_plan.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"floor_plan\.yaml"):
        read_plan(tmp_path / "floor_plan.yaml")
