# SPDX-License-Identifier: Apache-2.0
"""Two hosts on this machine, as network namespaces, and a cable between them that loses packets at random.

The ends of the cable are TAP devices; a thread carries each frame from one to the other, or does not. It needs no
kernel module but ``tun``, root's rights, and ``ip``.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import random
import select
import struct
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

_TUNSETIFF, _IFF_TAP, _IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
_CLONE_NEWNET = 0x40000000
_LARGEST_FRAME = 1 << 16
_WAITING_FRAMES = 5000
"""As a real adapter's: what comes faster than it is carried is lost."""


def sh(command: str) -> None:
    """Run a command line; an error ends the benchmark."""
    subprocess.run(command, shell=True, check=True)


class LossyLink:
    """The cable; ``loss`` is the share of frames that are lost, each way, and may be changed at any time."""

    def __init__(self, hosts: Sequence[str], loss: float) -> None:
        self.loss = loss
        self.carried_bytes = 0
        self._ended = threading.Event()
        self._ends = [_within(host, _open_tap) for host in hosts]
        for i, host in enumerate(hosts):
            for command in (
                f"addr add 10.77.0.{i + 1}/24 dev slam",
                f"link set slam txqueuelen {_WAITING_FRAMES} up",
                "route add 224.0.0.0/4 dev slam",
            ):
                sh(f"ip netns exec {host} ip {command}")
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def _carry(self) -> None:
        chance = random.Random(1)
        while not self._ended.is_set():
            for end in select.select(self._ends, [], [], 0.1)[0]:
                frame = os.read(end, _LARGEST_FRAME)
                if chance.random() < self.loss:
                    continue
                self.carried_bytes += len(frame)
                os.write(self._ends[1 - self._ends.index(end)], frame)

    def close(self) -> None:
        """Take the cable away."""
        self._ended.set()
        self._thread.join()
        for end in self._ends:
            os.close(end)


@contextmanager
def two_hosts(names: Sequence[str], loss: float) -> Iterator[LossyLink]:
    """Two namespaces with a cable between them."""
    link = None
    try:
        for name in names:
            sh(f"ip netns add {name}")
            sh(f"ip netns exec {name} ip link set lo up")
        link = LossyLink(names, loss)
        yield link
    finally:
        if link is not None:
            link.close()
        for name in names:
            subprocess.run(f"ip netns del {name}", shell=True, check=False)


def _open_tap() -> int:
    device = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH", b"slam", _IFF_TAP | _IFF_NO_PI))
    return device


def _within(host: str, action: Callable[[], T]) -> T:
    """Do something on a thread that has entered a namespace, and ends with it."""
    results: list[T] = []

    def enter() -> None:
        with Path(f"/run/netns/{host}").open() as namespace:
            if ctypes.CDLL(None, use_errno=True).setns(namespace.fileno(), _CLONE_NEWNET):
                raise OSError(ctypes.get_errno(), f"cannot enter {host}")
        results.append(action())

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    return results[0]
