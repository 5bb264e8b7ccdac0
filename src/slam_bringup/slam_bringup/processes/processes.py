# SPDX-License-Identifier: Apache-2.0
"""Starting and stopping nodes as processes, without ``ros2launch``: found in the ament index, ended by SIGINT."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

from slam_bringup.extras import require_ros
from slam_bringup.pipeline.node_table import NODES
from slam_core.runtime.process_life import PARENT

_MODULES = {(declared.package, declared.executable): declared.module for declared in NODES} | {
    ("slam_bringup", "slam_composed"): "slam_bringup.processes.composed_node"
}
"""Module of each executable's ``main``, for a workspace that has not been built."""

_DOMAINS = range(1, 101)
_STOP_AFTER_S = 10.0
"""Longest that a node may take to end; the recorder needs some of it to complete its bag."""
_GIVEN_UP_STOP_S = 1.0
"""Longest that a node may take to end for a user who does not want to wait."""


def find_executable(package: str, executable: str, prefixes: Sequence[str] | None = None) -> list[str]:
    """Command that starts a node: the installed executable as ``ros2 run`` finds it, else its module under this Python.

    Parameters
    ----------
    package, executable
        As for ``ros2 run``.
    prefixes
        Install prefixes to search; default: those of AMENT_PREFIX_PATH.

    Raises
    ------
    ValueError
        If there is no such node.
    """
    for prefix in map(Path, ament_prefixes() if prefixes is None else prefixes):
        indexed = (prefix / "share/ament_index/resource_index/packages" / package).exists()
        path = prefix / "lib" / package / executable
        if indexed and os.access(path, os.X_OK):
            return [str(path)]
    if (package, executable) not in _MODULES:
        raise ValueError(f"no executable '{executable}' in package '{package}'")
    module = _MODULES[package, executable]
    return [sys.executable, "-c", f"from {module} import main; main()"]


def become_node(package: str, executable: str, arguments: Sequence[str]) -> NoReturn:
    """Replace this process by a node, as ``ros2 run`` does: signals and exit code are its own; refused without ROS."""
    require_ros(executable)
    command = [*find_executable(package, executable), *arguments]
    sys.stdout.flush()
    os.execv(command[0], command)


def ament_prefixes() -> list[str]:
    """Install prefixes of the sourced workspaces."""
    return [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]


def node_environment(domain_id: int) -> dict[str, str]:
    """Environment of the nodes: a private domain on this machine only."""
    environment = dict(os.environ)
    environment |= {
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "PYTHONUNBUFFERED": "1",
        "RCUTILS_LOGGING_USE_STDOUT": "1",
        "RCUTILS_COLORIZED_OUTPUT": "0",
    }
    return environment


class PrivateDomain:
    """A ROS domain that no other run on this machine uses, whoever started it, until the ``with`` block ends.

    Each run binds a name of Linux's abstract sockets: it belongs to nobody, has no file, is gone with the process, and
    two containers see each other's names just where they see each other's domains.
    """

    def __enter__(self) -> int:
        first = os.getpid() % len(_DOMAINS)
        domains: list[int] = [*_DOMAINS[first:], *_DOMAINS[:first]]
        for domain in domains:
            self._socket = socket.socket(socket.AF_UNIX)
            try:
                self._socket.bind(f"\0slam-domain-{domain}")
            except OSError:
                self._socket.close()
                continue
            return domain
        raise ValueError("all ROS domains 1-100 are in use on this machine")

    def __exit__(self, *_: object) -> None:
        self._socket.close()


@dataclass(frozen=True)
class NodeCommand:
    """A node to start: ``ros2 run package executable arguments``, in a namespace."""

    package: str
    executable: str
    arguments: tuple[str, ...] = ()
    namespace: str = ""

    @property
    def full_name(self) -> str:
        """Fully qualified node name; nodes are named after their executables."""
        return f"/{self.namespace}/{self.executable}" if self.namespace else f"/{self.executable}"


@dataclass(eq=False)
class NodeProcess:
    """A running node; its output goes to ``log``."""

    command: NodeCommand
    log: Path
    process: subprocess.Popen[bytes] = field(repr=False)
    _interrupted: bool = False

    @classmethod
    def start(cls, command: NodeCommand, log: Path, environment: Mapping[str, str]) -> NodeProcess:
        """Start a node in a session of its own, so that Ctrl-C reaches it through us, in order."""
        log.parent.mkdir(parents=True, exist_ok=True)
        arguments = [*find_executable(command.package, command.executable), *command.arguments]
        with log.open("wb") as output:
            process = subprocess.Popen(
                arguments,
                env={**environment, PARENT: str(os.getpid())},
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        return cls(command, log, process)

    @property
    def is_running(self) -> bool:
        """True if the process still runs."""
        return self.process.poll() is None

    def interrupt(self) -> None:
        """Ask the node to end (SIGINT), once."""
        if self.is_running and not self._interrupted:
            self.process.send_signal(signal.SIGINT)
            self._interrupted = True

    def stop(self, within_s: float = _STOP_AFTER_S) -> int:
        """Ask the node to end (SIGINT), insist after ``within_s``; returns the exit code."""
        self.interrupt()
        try:
            return self.process.wait(max(within_s, 0.0))
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()

    def diagnostic(self) -> str:
        """The end of its log, for a message about why it ended."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return "\n".join(lines[-15:])

    def last_line(self, word: str) -> str:
        """The last line of its log that holds ``word``, without time and name; "" if there is none."""
        lines = [line for line in self.log.read_text(errors="replace").splitlines() if word in line]
        return lines[-1].rpartition("]: ")[2] if lines else ""


class NodeGroup:
    """Nodes that are started together and stopped in reverse order when the ``with`` block ends."""

    def __init__(self, environment: Mapping[str, str], logs: Path) -> None:
        self._environment = environment
        self.logs = logs
        self.nodes: list[NodeProcess] = []
        self.exit_codes: dict[str, int] = {}
        """Exit code by full node name, once stopped."""

    def __enter__(self) -> NodeGroup:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.stop(_GIVEN_UP_STOP_S if kind is KeyboardInterrupt else _STOP_AFTER_S)

    def start(self, command: NodeCommand) -> NodeProcess:
        """Start one more node."""
        name = command.full_name.strip("/").replace("/", "_")
        node = NodeProcess.start(command, self.logs / f"{name}.log", self._environment)
        self.nodes.append(node)
        return node

    def check(self) -> None:
        """Raise ValueError with the end of its log if a node has ended by itself with an error."""
        for node in self.nodes:
            if not node.is_running and node.process.returncode != 0:
                raise ValueError(
                    f"node {node.command.full_name} ended with code {node.process.returncode}:\n{node.diagnostic()}"
                )

    def stop(self, within_s: float = _STOP_AFTER_S) -> None:
        """Stop all nodes: everybody is asked at once, then waited for, so long for all together."""
        for node in self.nodes:
            node.interrupt()
        deadline = time.monotonic() + within_s
        for node in reversed(self.nodes):
            self.exit_codes[node.command.full_name] = node.stop(deadline - time.monotonic())
        self.nodes = []
