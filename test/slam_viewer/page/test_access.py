# SPDX-License-Identifier: Apache-2.0
"""Who may open the page and its websocket: on the page itself, on ``slam view`` and on the viewer node; and what a page
makes of hostile texts.
"""

from __future__ import annotations

import http.client
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from browser import Browser, find_chromium
from dense_mapping.reconstruction.surface import Surface
from sjsam_node.global_map import GlobalMap
from slam_core.trajectory import Trajectory
from slam_viewer.page.access import Access
from slam_viewer.page.finished import FinishedView
from slam_viewer.page.page import ViewerPage
from slam_viewer.page.panel import AgentRow
from slam_viewer.page.run_folder import RunFolder

CHROMIUM = find_chromium()
HOSTILE = "<img src=x onerror=\"window.broken_into='yes'\">**b** [l](javascript:1) '\"&amp;</div>"
"""Markup of HTML and of Markdown; it has to be read on the page as it stands here."""


def fetch(url: str, path: str | None = None, host: str | None = None) -> tuple[int, bytes]:
    """Status and body of a page."""
    place = urlsplit(url)
    connection = http.client.HTTPConnection("127.0.0.1", place.port, timeout=20)
    connection.request("GET", path or place.path or "/", headers={"Host": host or place.netloc})
    answer = connection.getresponse()
    return answer.status, answer.read()


def websocket_opens(url: str, origin: str | None, path: str | None = None) -> bool:
    """True if the page's server takes a websocket of a page of this origin."""
    place = urlsplit(url)
    try:
        with connect(
            f"ws://127.0.0.1:{place.port}{path or place.path or '/'}", origin=origin,
            subprotocols=[f"viser-v{viser.__version__}"], max_size=None, open_timeout=20,
        ) as socket:  # fmt: skip
            return bool(socket.recv(timeout=20))
    except InvalidStatus:
        return False


@pytest.fixture
def page() -> Iterator[ViewerPage]:
    page = ViewerPage(0)
    yield page
    page.stop()


def test_a_websocket_opens_for_the_pages_own_origin_alone(page):
    own = f"http://127.0.0.1:{page.port}"
    assert fetch(page.url)[0] == 200
    assert websocket_opens(page.url, own)
    for foreign in ("http://evil.example", "null", None, f"http://127.0.0.1:{page.port + 1}", f"{own}.evil.example"):
        assert not websocket_opens(page.url, foreign), foreign


def test_a_foreign_name_that_points_to_this_machine_is_refused(page):
    """DNS rebinding: page and websocket of ``evil.example`` agree in their host, which is not this machine's name."""
    assert fetch(page.url, host=f"evil.example:{page.port}")[0] == 403
    access = Access("127.0.0.1", "t")
    assert access.refusal("/", "evil.example:80", "http://evil.example:80", is_websocket=True)
    for host in (f"localhost:{page.port}", "[::1]:80", "127.0.0.1"):
        assert not access.refusal("/", host, f"http://{host}", is_websocket=True)


def test_parameters_that_would_lead_the_page_to_another_server_are_refused(page):
    assert fetch(page.url, "/?websocket=ws://evil.example")[0] == 403
    assert fetch(page.url, "/other.html")[0] == 403


def test_a_page_for_other_machines_is_shown_only_with_its_token():
    page = ViewerPage(0, "0.0.0.0")
    try:
        place = urlsplit(page.url)
        assert len(place.path) > 20
        assert fetch(page.url)[0] == 200
        for path in ("/", "/x/", place.path[:-2] + "/"):
            assert fetch(page.url, path)[0] == 403
            assert not websocket_opens(page.url, f"http://127.0.0.1:{page.port}", path)
        assert websocket_opens(page.url, f"http://127.0.0.1:{page.port}")
        assert not websocket_opens(page.url, "http://evil.example")
        assert Access("0.0.0.0", "t").token not in page.url, "each page has a token of its own"
    finally:
        page.stop()


def test_the_title_of_the_page_is_ours_and_escaped():
    from gzip import decompress

    page = ViewerPage(0, title="a <b>")
    try:
        assert b"<title>a &lt;b&gt;</title>" in decompress(fetch(page.url)[1])
    finally:
        page.stop()


def test_a_viser_that_starts_its_server_otherwise_is_not_served_unguarded():
    with pytest.raises(RuntimeError, match="guarded"), Access("127.0.0.1", "t").guarding():
        pass


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine (apt install chromium)")
def test_hostile_names_states_and_marks_are_read_as_plain_text(page):
    """A finished run whose summary, agent, marks and map say what an attacker likes; then what the nodes would show."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 1.0, 2.0]
    world = GlobalMap().snapshot()
    run = RunFolder(
        Path(HOSTILE), {"bag": HOSTILE}, {HOSTILE: Trajectory(np.arange(3) * 10**9, poses)}, world, Surface.empty(), (),
        HOSTILE,
    )  # fmt: skip
    FinishedView(page, run)
    page.show_agent_table([AgentRow(f"name {HOSTILE}", f"state {HOSTILE}", f"reason {HOSTILE}")])
    page.show_ways_text([(f"way {HOSTILE}", HOSTILE)], HOSTILE)
    page.show_marks([f"mark {HOSTILE}", "../../agents", "a/b"], poses[:, :3, 3])
    page.show_agent(f"agent {HOSTILE}", 0, poses[0])
    page.show_picture(np.zeros((48, 64, 3), dtype=np.uint8), f"caption {HOSTILE}")
    assert CHROMIUM is not None
    with Browser(CHROMIUM) as browser:
        browser.open(page.url)
        browser.wait("document.body.textContent.includes('reason <img')")
        text = browser.evaluate("document.body.textContent")
        for place in ("name ", "state ", "reason ", "way "):
            assert place + HOSTILE in text
        assert text.count(HOSTILE) >= 7
        browser.click_text("Image")
        browser.wait("document.body.textContent.includes('caption <img')")
        browser.listen(2.0)
        assert browser.evaluate("typeof window.broken_into") == "undefined"
        assert browser.evaluate("document.querySelectorAll('img[src=x], a[href^=javascript]').length") == 0
        assert browser.evaluate("document.title") == "Indoor SLAM"
        assert not [r for r in browser.requests if r.endswith("/x")]


def started(command: list[str], pattern: str, log: Path, environment: dict[str, str]) -> tuple[str, subprocess.Popen]:
    """Address that a process prints, once it does, and the process."""
    with log.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, env=environment)
    end = time.monotonic() + 120.0
    while not (found := re.search(pattern, log.read_text())):
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.2)
    return found[1], process


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_slam_view_refuses_a_foreign_origin_and_prints_its_token(tmp_path, host):
    run = tmp_path / "run"
    run.mkdir()
    (run / "summary.json").write_text("{}")
    (run / "trajectory.tum").write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    command = [sys.executable, "-m", "slam_bringup.cli", "view", str(run), "--port", "0", "--host", host]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    url, process = started([*command, "--no-browser"], r" at (http://\S+)", tmp_path / "log", environment)
    try:
        assert bool(urlsplit(url).path.strip("/")) == (host != "127.0.0.1")
        own = f"http://127.0.0.1:{urlsplit(url).port}"
        assert fetch(url, host=urlsplit(own).netloc)[0] == 200
        assert websocket_opens(url, own)
        assert not websocket_opens(url, "http://evil.example")
        if host != "127.0.0.1":
            assert not websocket_opens(url, own, path="/")
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30)


@pytest.mark.ros
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine (apt install chromium)")
def test_the_viewer_node_shows_hostile_diagnostics_as_text_and_refuses_a_foreign_origin(tmp_path):
    rclpy = pytest.importorskip("rclpy", reason="needs ROS")
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    from ros_probe import Probe
    from slam_bringup.processes.node_arguments import ros_arguments
    from slam_bringup.processes.processes import PrivateDomain, find_executable, node_environment

    with PrivateDomain() as domain:
        command = [*find_executable("slam_viewer", "viewer"), *ros_arguments({"port": 0})]
        url, process = started(command, r"page is at (http://\S+)", tmp_path / "log", node_environment(domain))
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain)
        try:
            probe = Probe(context)
            status = DiagnosticStatus(name="/ekf_slam", message=f"frame {HOSTILE}", level=bytes([1]))
            assert websocket_opens(url, f"http://127.0.0.1:{urlsplit(url).port}")
            assert not websocket_opens(url, "http://evil.example")
            with Browser(CHROMIUM) as browser:
                browser.open(url)
                for _ in range(60):
                    probe.send("/diagnostics", DiagnosticArray(status=[status]))
                    browser.listen(1.0)
                    if f"frame {HOSTILE}" in (browser.evaluate("document.body.textContent") or ""):
                        break
                assert f"frame {HOSTILE}" in browser.evaluate("document.body.textContent")
                browser.listen(1.0)
                assert browser.evaluate("typeof window.broken_into") == "undefined"
        finally:
            rclpy.shutdown(context=context)
            process.send_signal(signal.SIGINT)
            process.wait(30)
