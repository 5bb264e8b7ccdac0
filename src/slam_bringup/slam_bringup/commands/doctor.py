# SPDX-License-Identifier: Apache-2.0
"""``slam doctor``: what is wrong with a recording or a running rig, each thing in one line with what to do."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import click

from slam_bags.reading.rig_calibration import read_rig_calibration
from slam_bags.reading.sensor_topics import ROLES, BagNames, parse_topics
from slam_bringup.doctor.examination import GROUPS, examined
from slam_bringup.doctor.finding import Finding
from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.processes import NodeCommand, NodeProcess
from slam_bringup.terminal.paths import UserPath, calibration_option, rig_cameras, rig_option

FAULTS = 1
"""Exit code where something is wrong."""

_START_S = 60.0
"""Longest that the recorder may take to start, and to complete its bag."""


@click.command(epilog=f"Groups of checks: {', '.join(GROUPS)}.")
@click.argument("bag", required=False, type=UserPath(exists=True))
@click.option("--live", is_flag=True, help="look at the topics of the running ROS graph instead of a bag")
@click.option(
    "--seconds", type=click.FloatRange(min=1.0), default=10.0, show_default=True, help="how long, with --live"
)
@click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="ROLE=TOPIC",
    help=f"a topic that is not named like the nodes' (may be repeated); roles: {', '.join(ROLES)}",
)
@calibration_option()
@rig_option()
@click.option("--base-frame", default="", metavar="FRAME", help="the rig's frame [base_link]")
@click.option("--json", "as_json", is_flag=True, help="print the findings as JSON")
def command(
    bag: Path | None,
    live: bool,
    seconds: float,
    topics: tuple[str, ...],
    calibrations: tuple[Path, ...],
    base_frame: str,
    as_json: bool,
) -> None:
    """Check BAG, or what is published now (--live).

    Ends with exit code 1 if anything is wrong.
    """
    if (bag is None) != live:
        raise ValueError("name a bag, or say --live")
    names = BagNames(parse_topics(topics), base_frame, read_rig_calibration(calibrations), rig_cameras())
    findings, cameras = examined(bag, names) if bag is not None else examine_live(seconds, names)
    text = "\n".join(filter(None, [cameras, _text(findings)]))
    click.echo(json.dumps([asdict(f) for f in findings], indent=2) if as_json else text)
    sys.exit(FAULTS if findings else 0)


def examine_live(seconds: float, names: BagNames) -> tuple[list[Finding], str]:
    """Record what is published for some seconds, then examine it as a bag.

    Raises
    ------
    ValueError
        If nothing with images was published, or the recorder does not start.
    """
    with tempfile.TemporaryDirectory(prefix="slam-doctor-") as folder:
        bag, log = Path(folder) / "live", Path(folder) / "recorder.log"
        recorder = NodeCommand("slam_bags", "recorder", tuple(ros_arguments({"bag": str(bag)})))
        process = NodeProcess.start(recorder, log, os.environ)
        try:
            _wait_until_ready(process)
            time.sleep(seconds)
        finally:
            code = process.stop(_START_S)
        if code != 0 or not bag.exists():
            raise ValueError(f"the recorder ended with code {code}:\n{process.diagnostic()}")
        try:
            return examined(bag, names)
        except ValueError as error:
            raise ValueError(str(error).replace(str(bag), "the running graph")) from None


def _wait_until_ready(recorder: NodeProcess) -> None:
    """Starting takes long on a busy machine; the seconds count from then on."""
    end = time.monotonic() + _START_S
    while recorder.is_running and not recorder.last_line("ready") and time.monotonic() < end:
        time.sleep(0.1)


def _text(findings: list[Finding]) -> str:
    if not findings:
        return f"nothing wrong found in: {', '.join(GROUPS)}"
    return "\n".join(f"{number}. {finding}" for number, finding in enumerate(findings, start=1))
