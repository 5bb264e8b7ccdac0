# SPDX-License-Identifier: Apache-2.0
"""The page in a real browser: it loads, draws, complains of nothing and asks no other machine."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from browser import Browser, find_chromium
from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.reconstruction.decimation import at_most
from dense_mapping.reconstruction.surface import Surface
from slam_core.geometry import boxplus
from slam_core.types import ByteArray
from slam_viewer.page.page import ViewerPage
from slam_viewer.page.panel import AgentRow

CHROMIUM = find_chromium()


@pytest.fixture
def page():
    page = ViewerPage(0)
    yield page
    page.stop()


def hill() -> Surface:
    """A square of 4 m with a hill, in red."""
    u, v = np.meshgrid(np.linspace(-2, 2, 30), np.linspace(-2, 2, 30), indexing="ij")
    points = np.stack([u, v, np.exp(-(u**2) - v**2)], axis=-1).reshape(-1, 3).astype(np.float32)
    k = np.arange(900).reshape(30, 30)
    corners = [part.ravel() for part in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:])]
    faces = np.concatenate([np.stack([corners[i] for i in t], axis=1) for t in ((0, 1, 2), (0, 2, 3))])
    colours = np.tile(np.uint8([250, 20, 20]), (900, 1))
    return Surface(points, np.tile(np.float32([0, 0, 1]), (900, 1)), colours, np.full(900, 0.01, np.float32),
                   faces.astype(np.int32))  # fmt: skip


def fill(page: ViewerPage) -> None:
    poses = boxplus(np.tile(np.eye(4), (20, 1, 1)), np.linspace([0] * 6, [2, 1, 0, 0, 0, 1], 20))
    page.show_headline("a test")
    page.show_agent_table([AgentRow("one", "OK"), AgentRow("two", "LOST", "the wall is white")])
    page.show_mesh(hill())
    page.show_points(hill().points)
    page.show_plan(FloorPlan(np.zeros((40, 40), dtype=np.int8), 0.1, np.eye(4)))
    page.show_trajectory(0, poses)
    page.show_agent("one", 0, poses[-1])
    page.show_landmarks(poses[:, :3, 3], np.tile(0.01 * np.eye(3), (20, 1, 1)))
    page.show_submaps(poses[:-1, :3, 3], poses[1:, :3, 3])
    page.show_closures(poses[[0, -1], :3, 3][None])
    page.show_frontiers(poses[:2, :3, 3], [1.0, 2.0])
    page.show_way(0, poses[:, :3, 3], "2.2 m to the exit")
    page.show_marks(["door", "gas"], poses[:2, :3, 3])
    page.show_picture(np.zeros((48, 64, 3), dtype=np.uint8), "dark")
    page.show_camera(poses[-1], np.zeros((48, 64, 3), dtype=np.uint8))
    page.look_at(hill().points.astype(np.float64))


def pixels(png: bytes) -> ByteArray:
    image = cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image[..., ::-1], dtype=np.uint8)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine (apt install chromium)")
def test_the_page_loads_draws_and_asks_no_other_machine(page):
    fill(page)
    assert CHROMIUM is not None
    with Browser(CHROMIUM) as browser:
        browser.open(page.url)
        browser.wait("!!document.querySelector('canvas') && document.body.textContent.includes('a test')")
        for _ in range(30):
            browser.listen(2.0)
            red = pixels(browser.screenshot()).astype(int)
            is_red = (red[..., 0] > red[..., 1] + 40) & (red[..., 0] > red[..., 2] + 40)
            if is_red.sum() > 5000:
                break
        assert is_red.sum() > 5000, "the red hill is not on the canvas"
        assert red[-20, 20].max() < 210, "pale walls are not seen on white"
        text = browser.evaluate("document.body.textContent")
        assert "LOST" in text
        assert "the wall is white" in text
        browser.click_text("Layers")
        browser.listen(2.0)
        assert "floor plan" in browser.evaluate("document.body.textContent")
        assert not browser.errors
        foreign = [r for r in browser.requests if re.match(r"(https?|wss?)://(?!localhost|127\.0\.0\.1)", r)]
        assert not foreign


def test_a_layer_that_comes_again_is_replaced(page):
    fill(page)
    fill(page)
    page.show_frontiers(np.empty((0, 3)), [])
    page.show_marks([], np.empty((0, 3)))


def test_the_page_has_no_link_to_another_host():
    """What a page without a network would lack: nothing in what viser serves loads scripts or styles from elsewhere."""
    import viser

    index = (Path(viser.__file__).parent / "client/build/index.html").read_text(encoding="utf-8", errors="replace")
    assert not re.findall(r"<(?:script|link|img)[^>]+(?:src|href)=[\"']?https?://", index)


def test_a_large_mesh_is_made_coarser_not_torn():
    fine = hill()
    coarse = at_most(fine, len(fine.faces) // 2)
    assert len(fine.faces) / 8 < len(coarse.faces) <= len(fine.faces) / 2
    assert len(coarse.colours) == len(coarse.normals) == len(coarse.points)
    assert at_most(fine, 10**6) is fine
    area = trimesh.Trimesh(coarse.points, coarse.faces, process=False).area
    assert abs(area / trimesh.Trimesh(fine.points, fine.faces, process=False).area - 1.0) < 0.2


def test_a_port_that_is_taken_is_named(page):
    with pytest.raises(ValueError, match=f"port {page.port} is taken"):
        ViewerPage(page.port)


def test_plans_above_a_storey_are_hidden(page):
    for number in range(3):
        page.show_plan(FloorPlan(np.zeros((4, 4), dtype=np.int8), 0.1, np.eye(4)), number)
    page.show_storeys_up_to(1)
    assert [page._plans[number].visible for number in range(3)] == [True, True, False]
    page.show_storeys_up_to(2)
    assert page._plans[2].visible
