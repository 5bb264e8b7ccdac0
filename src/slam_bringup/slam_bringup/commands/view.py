# SPDX-License-Identifier: Apache-2.0
"""``slam view``: the page that shows a finished run, or the nodes at work."""

from __future__ import annotations

import signal
import threading
import webbrowser
from pathlib import Path

import click

from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.processes import become_node
from slam_bringup.terminal.paths import UserPath


@click.command()
@click.argument("out", type=UserPath(exists=True, file_okay=False), required=False)
@click.option("--live", is_flag=True, help="what the running nodes publish, instead of a finished run")
@click.option(
    "--bag",
    type=UserPath(exists=True),
    help="the bag of the run: pictures with the map's landmarks instead of features",
)
@click.option("--agent", "agents", multiple=True, help="with --live: namespace of an agent (may be repeated)")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8080, show_default=True, help="port of the page; 0: any free one"
)
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="0.0.0.0 lets other machines see the page, by an address with a token",
)
@click.option("--no-browser", is_flag=True, help="only serve the page")
def command(
    out: Path | None, live: bool, bag: Path | None, agents: tuple[str, ...], port: int, host: str, no_browser: bool
) -> None:
    """Show the run in folder OUT, or with --live the nodes at work, on a page in the browser.

    The page needs no network. Ctrl-C ends it.
    """
    if live == (out is not None):
        raise ValueError("give the folder of a finished run, or --live to see the nodes at work")
    if live:
        _run_node(agents, port, host)
        return
    assert out is not None
    _show_finished(out, bag, port, host, not no_browser)


def _show_finished(out: Path, bag: Path | None, port: int, host: str, browser: bool) -> None:
    # Here and not above: loading viser takes a second, and --help should not.
    from slam_viewer.page.finished import FinishedView
    from slam_viewer.page.page import ViewerPage
    from slam_viewer.page.pictures import BagPictures, RecordedPictures
    from slam_viewer.page.run_folder import RunFolder

    run = RunFolder.read(out)
    recording = out / "result.mcap"
    pictures: BagPictures | RecordedPictures | None = None
    if bag is not None:
        pictures = BagPictures(run, bag)
    elif recording.is_file():
        pictures = RecordedPictures(recording)
    page = ViewerPage(port, host, f"Indoor SLAM: {out.name}")
    FinishedView(page, run, None if pictures is None else pictures.at)
    click.echo(f"{out} at {page.url} (Ctrl-C ends)", err=True)
    if browser:
        webbrowser.open(page.url)
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    stopped.wait()
    page.stop()


def _run_node(agents: tuple[str, ...], port: int, host: str) -> None:
    parameters = {"port": port, "host": host, **({"agents": list(agents)} if agents else {})}
    become_node("slam_viewer", "viewer", ros_arguments(parameters))
