# SPDX-License-Identifier: Apache-2.0
"""The leader's page: link, backlog, warning, and the disc that an agent is in; in words, drawn, and on real nodes."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from browser import Browser, find_chromium
from slam_core.types import PoseEstimate
from slam_radio.wire.link_report import Backlog, LinkReport
from slam_viewer.page.agent_link import link_text, link_warning, reach, reach_text
from slam_viewer.page.page import ViewerPage
from slam_viewer.page.panel import AgentRow, agent_table

CHROMIUM = find_chromium()
FULL = Backlog(12, 84_000, 42.0, 1500.0, 700.0, is_too_much=True)


def test_a_link_is_told_with_what_waits():
    assert link_text(LinkReport(False)) == "link: not heard yet"
    assert link_text(LinkReport(True, 1.0)) == "link: up"
    assert link_text(LinkReport(True, 1.0, FULL)) == "link: up, 12 submaps wait: 84.0 kB, 42 s"
    one = Backlog(1, 7_000, 0.4, 0.0, 0.0, is_too_much=False)
    assert link_text(LinkReport(False, 61.2, one)) == (
        "link: silent for 61 s, before that 1 submap waits: 7.0 kB, 0 s"
    )  # fmt: skip


def test_too_much_for_a_link_is_a_warning_while_it_is_up():
    assert "1500 bytes/s" in link_warning(LinkReport(True, 1.0, FULL))
    assert link_warning(LinkReport(False, 61.0, FULL)) == ""
    assert link_warning(LinkReport(True, 1.0)) == ""
    table = agent_table([AgentRow("anna", "OK", "", "link: up", "too <much>")], [(1, 2, 3)])
    assert "link: up" in table
    assert "too &lt;much&gt;" in table


def test_the_disc_grows_as_one_walks():
    assert reach(0.5, 0.0, 1.5) == 0.5
    assert reach(0.5, 20.0, 1.5) == 30.5
    assert reach_text(0.5, 0.0, 1.5) == "position ±0.50 m (99.5 %)"
    assert "now within 30 m" in reach_text(0.5, 20.0, 1.5)
    assert "within" not in reach_text(100.0, 20.0, 1.5), "what is not tied to the map has no place"


def pixels(png: bytes) -> Any:
    image = cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1].astype(int)


def reddish(browser: Browser) -> int:
    """Pixels of the scene, left of the panel, in the first agent's colour."""
    scene = pixels(browser.screenshot())[:, :900]
    return int(((scene[..., 0] > scene[..., 1] + 30) & (scene[..., 0] > scene[..., 2] + 30)).sum())


def wait_for_red(browser: Browser, least: int, most: int) -> int:
    for _ in range(30):
        browser.listen(1.0)
        if least <= (found := reddish(browser)) <= most:
            return found
    pytest.fail(f"{found} pixels are red, not {least} to {most}")


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine (apt install chromium)")
def test_the_disc_is_drawn_grows_and_goes():
    page = ViewerPage(0)
    try:
        page.show_headline("a test")
        page.look_at(np.array([[-4.0, -4.0, 0.0], [4.0, 4.0, 0.0]]))
        assert CHROMIUM is not None
        with Browser(CHROMIUM) as browser:
            browser.open(page.url)
            browser.wait("!!document.querySelector('canvas') && document.body.textContent.includes('a test')")
            browser.listen(3.0)
            none = reddish(browser)
            page.show_reach(0, np.zeros(3), 1.0)
            small = wait_for_red(browser, none + 1000, 10**6) - none
            page.show_reach(0, np.zeros(3), 2.0)
            wait_for_red(browser, none + round(2.5 * small), none + 6 * small)
            page.show_reach(0, np.zeros(3), np.inf)
            wait_for_red(browser, 0, none + small // 10)
            assert not browser.errors
    finally:
        page.stop()


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine (apt install chromium)")
def test_the_leader_sees_the_link_and_where_a_silent_agent_may_be(tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("rclpy")
    pytest.importorskip("zenoh")
    from node_process import free_port, node, private_probe
    from slam_core.messages import odometry_message, pose_with_covariance_message

    address, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    with ExitStack() as stack:
        environment, probe = stack.enter_context(private_probe(tmp_path))
        log = tmp_path / "nodes.log"
        post = {"role": "post", "agents": ("anna",), "listen": (address,), "silent_after_s": 3.0}
        stack.enter_context(node(environment, "slam_radio", "radio_link", log, **post))
        stack.enter_context(node(environment, "slam_viewer", "viewer", log, agents=("anna",), port=port))
        probe.listen("/anna/odom", probe.types.Odometry)
        pose = PoseEstimate(10**9, np.eye(4), 1e-2 * np.eye(6))
        assert CHROMIUM is not None
        browser = stack.enter_context(Browser(CHROMIUM))
        agent = {"agents": ("anna",), "connect": (address,), "namespace": "helmet"}
        with node(environment, "slam_radio", "radio_link", log, **agent):

            def is_heard() -> bool:
                probe.send("/helmet/odom", odometry_message(probe.types, "odom", "base_link", pose))
                probe.send("/anna/pose", pose_with_covariance_message(probe.types, "map", pose))
                return bool(probe.received["/anna/odom"])

            probe.wait(is_heard, f"no pose at the post: {log.read_text()}")
            probe.wait(lambda: "the page is at" in log.read_text(), "no page")
            browser.open(f"http://localhost:{port}")
            for _ in range(60):
                is_heard()
                browser.listen(0.5)
                if "link: up" in (text := browser.evaluate("document.body.textContent")):
                    break
            assert "link: up" in text, log.read_text()
            assert "position ±" in text
            before = reddish(browser)
            named = "b => b.textContent.includes('Ask agents for details')"
            browser.evaluate(f"[...document.querySelectorAll('button')].find({named}).click()")
            probe.wait(lambda: "details of 0 submaps asked for" in log.read_text(), "the click asked for no details")
        browser.wait("document.body.textContent.includes('link: silent for')")
        browser.wait("document.body.textContent.includes('of it if walking')")
        wait_for_red(browser, before + 1000, 10**7)
        assert "Traceback" not in log.read_text()
