# SPDX-License-Identifier: Apache-2.0
"""Keeps docs/results.md and docs/others.md true: each block is what a command printed; this runs it again.

    python benchmarks/house/results.py             # lists the blocks: when, at which commit, what they cost
    python benchmarks/house/results.py --run grid  # runs the commands that hold "grid", puts their output in place

Commands see BAGS, a folder of bags by scenario (``slam simulate NAME -o $BAGS/NAME --profile ideal``),
INDOOR_SLAM_DATA, the folder of the recordings, and what else the pages name. A digest beside each block tells whether
somebody wrote into it by hand.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import resource
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "docs/results.md", ROOT / "docs/others.md")
_BLOCK = re.compile(
    r"<!-- measured: (?P<day>\S*), (?P<commit>\S*), (?P<cpu>\S*) s of processor time, (?P<digest>\S*) -->\n"
    r"```console\n\$ (?P<command>[^\n]*)\n(?P<output>.*?)```\n",
    flags=re.S,
)


@dataclass(frozen=True)
class Block:
    """What a command printed, and when."""

    command: str
    output: str
    day: str
    commit: str
    cpu: str
    digest: str

    @property
    def own_digest(self) -> str:
        """The digest that command and output have."""
        return hashlib.sha256(f"{self.command}\n{self.output}".encode()).hexdigest()[:8]

    def __str__(self) -> str:
        return (
            f"<!-- measured: {self.day}, {self.commit}, {self.cpu} s of processor time, {self.own_digest} -->\n"
            f"```console\n$ {self.command}\n{self.output}```\n"
        )


def blocks(page: str) -> Iterator[Block]:
    """The blocks of a page, in its order."""
    for found in _BLOCK.finditer(page):
        yield Block(**found.groupdict())


def measured(command: str) -> Block:
    """Run a command in the repository and keep what it prints.

    Raises
    ------
    subprocess.CalledProcessError
        If the command fails; nothing of it is kept.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    printed = _output_of(["bash", "-c", command])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    output = "".join(f"{line.rstrip()}\n" for line in printed.strip("\n").splitlines())
    commit = _output_of(["git", "rev-parse", "--short=7", "HEAD"]).strip()
    return Block(command, output, f"{datetime.now(UTC):%Y-%m-%d}", commit, f"{cpu:.0f}", "")


def with_block(page: str, anew: Block) -> str:
    """The page with the block of the same command in place of the old one."""
    return _BLOCK.sub(lambda found: str(anew) if found["command"] == anew.command else found[0], page)


def _output_of(command: list[str]) -> str:
    environment = os.environ | {"COLUMNS": "140", "NO_COLOR": "1"}
    return subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout


def main() -> None:
    """List the blocks, or run commands again and write their output into the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", nargs="+", metavar="TEXT", help="run the commands that hold one of these texts")
    arguments = parser.parse_args()
    for page in PAGES:
        _go_through(page, arguments.run)


def _go_through(page: Path, texts: list[str] | None) -> None:
    for block in list(blocks(page.read_text(encoding="utf-8"))):
        if not texts:
            changed = "" if block.digest == block.own_digest else "  WRITTEN INTO BY HAND: run it again"
            print(f"{block.day:10} {block.commit:7} {block.cpu:>6} s  {block.command}{changed}")
        elif any(text in block.command for text in texts):
            print(f"$ {block.command}", file=sys.stderr, flush=True)
            anew = measured(block.command)
            now = page.read_text(encoding="utf-8")  # read again: another run may have written meanwhile
            page.write_text(with_block(now, anew), encoding="utf-8")


if __name__ == "__main__":
    main()
