# SPDX-License-Identifier: Apache-2.0
"""Twenty agents and a post on one shaped channel, in made-up time: how long submaps take, and the bytes they need.

    python benchmarks/radio/shared_channel.py RUN [--agents 20] [--rate 500] [--loss 0.2] [--silence 60] [--late]
        [--restart]

RUN: the folder of a run with its ``map``. Every agent replays the submaps of its first agent, or, where the run has as
many agents as there are here, those of its own, agent k beginning k seconds later, by the uplink, downlink, outbox and
inbox of the node; there is no Zenoh in it. All share ``--rate`` kbit/s, first come first
served, both directions together; a message has the 150 bytes of headers that the budget counts. ``--loss``: share of
messages lost. ``--silence``: nothing comes through between the post and one agent for so long, then it is the next
one's turn; agents repeat the run until all have had theirs. ``--late``: the last agent begins at minute 10.
``--restart``: the post is started anew in the middle.
Prints submaps received of those packed, seconds from a submap's end to its arrival,
kB a metre on the channel, the share of the channel that is used, seconds until the last had arrived, and seconds from
the end of an agent's silence until the post had all that had ended by then.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np

from sjsam_node.map_file import storage
from slam_core.geometry import FloatArray
from slam_core.types import PoseEstimate, Submap
from slam_radio.downlink import Downlink
from slam_radio.packing.light_submap import pack
from slam_radio.queues.byte_budget import OVERHEAD
from slam_radio.queues.inbox import Inbox
from slam_radio.queues.outbox import Outbox
from slam_radio.uplink import Uplink
from slam_radio.wire.radio_messages import pack_pose, unpack_acknowledgement

_STEP_S = 0.1
_AFTER_S = 180.0
_LATE_S = 600.0


class Channel:
    """Messages wait in one line and arrive after their bytes have gone through."""

    def __init__(self, bytes_per_second: float, loss: float) -> None:
        self.sent = 0
        self._rate, self._loss, self._free_at_s = bytes_per_second, loss, 0.0
        self._line: deque[tuple[float, str, str, object, bytes]] = deque()
        self._rng = np.random.default_rng(1)

    def send(self, now_s: float, agent: str, kind: str, key: object, data: bytes, *, silent: bool = False) -> None:
        """Put a message at the end of the line; while its agent is silent it needs its bytes and is lost."""
        size = len(data) + OVERHEAD
        self.sent += size
        self._free_at_s = max(self._free_at_s, now_s) + size / self._rate
        if self._rng.random() >= self._loss and not silent:
            self._line.append((self._free_at_s, agent, kind, key, data))

    def arrived(self, now_s: float) -> list[tuple[float, str, str, object, bytes]]:
        """Messages that have gone through by now."""
        out = []
        while self._line and self._line[0][0] <= now_s:
            out.append(self._line.popleft())
        return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("--agents", type=int, default=20)
    parser.add_argument("--rate", type=float, default=500.0, help="of the channel, kbit/s")
    parser.add_argument("--loss", type=float, default=0.0, help="share of messages lost")
    parser.add_argument("--silence", type=float, default=0.0, help="of each agent in turn, s")
    parser.add_argument("--late", action="store_true")
    parser.add_argument("--restart", action="store_true")
    arguments = parser.parse_args()
    submaps = [r.submap for r in storage.read(arguments.run / "map").state.graph.records]
    with tempfile.TemporaryDirectory() as folder:
        replay(of_agents(submaps, arguments.agents), arguments, Path(folder))


def of_agents(submaps: list[Submap], count: int) -> list[list[Submap]]:
    """Submaps of each of ``count`` agents: those of the run's own agents if it has so many, else of its first."""
    found: dict[tuple[str, int], list[Submap]] = {}
    for submap in submaps:
        found.setdefault((submap.agent, submap.session), []).append(submap)
    walks = list(found.values())
    return walks[:count] if len(walks) >= count else [walks[0]] * count


def replay(walks: list[list[Submap]], arguments: argparse.Namespace, folder: Path) -> None:
    """Run the agents until all has arrived, or for three minutes after the last submap."""
    names = [f"agent_{k}" for k in range(arguments.agents)]
    rate = 125.0 * arguments.rate
    channel = Channel(rate, arguments.loss)
    begins = {name: float(k) for k, name in enumerate(names)}
    if arguments.late:
        begins[names[-1]] = _LATE_S
    uplinks = {n: Uplink(Outbox(folder / "out" / n), rate / len(names)) for n in names}
    inboxes = [Inbox(n, folder / "in" / n) for n in names]
    downlink = Downlink(inboxes, rate / 5.0)
    silences = {n: arguments.silence * np.array([k + 1, k + 2]) for k, n in enumerate(names)}
    plans = {n: repeated(w, arguments.silence * (len(names) + 2)) for n, w in zip(names, walks, strict=True)}
    keys = {(n, (s.session, s.index)) for n, (submaps, _) in plans.items() for s in submaps}
    due = sorted((begins[n] + end, n, k) for n in names for k, end in enumerate(plans[n][1]))
    count, last_s, middle_s = len(due), due[-1][0], 0.5 * due[-1][0]
    ended = {(n, (plans[n][0][k].session, plans[n][0][k].index)): at for at, n, k in due}
    took: dict[tuple[str, object], float] = {}
    now, joined_s = 0.0, 0.0
    while now < last_s + _AFTER_S and (due or len(took) < count):
        now += _STEP_S
        silent = {n for n, (begin, end) in silences.items() if begin <= now < end}
        if arguments.restart and now - _STEP_S < middle_s <= now:
            for inbox in inboxes:
                inbox.close()
            inboxes = [Inbox(n, folder / "in" / n) for n in names]
            downlink = Downlink(inboxes, rate / 5.0)
            for inbox in inboxes:
                inbox.release()
        while due and due[0][0] <= now:
            at, name, k = due.pop(0)
            submap = plans[name][0][k]
            uplinks[name].add_submap((submap.session, submap.index), pack(replace(submap, agent=name)), now)
        for name, uplink in uplinks.items():
            if now < begins[name]:
                continue
            if uplink.pose_is_due(now):
                uplink.set_pose(pack_pose(PoseEstimate(round(now * 1e9), np.eye(4), 1e-4 * np.eye(6))))
            for message in uplink.due(now):
                channel.send(now, name, message.kind, message.key, message.data, silent=name in silent)
        for told in downlink.due(now):
            channel.send(now, told.agent, "ack", None, told.data, silent=told.agent in silent)
        for at, name, kind, key, data in channel.arrived(now):
            if kind == "ack":
                uplinks[name].on_acknowledgement(unpack_acknowledgement(data), now)
            elif kind == "pose":
                downlink.on_pose(name, data, now)
            elif kind == "backlog":
                downlink.on_backlog(name, data, now)
            else:
                downlink.on_submap(name, key, data, now)  # type: ignore[arg-type]
                if (name, key) not in took:
                    took[name, key] = at - ended[name, key]  # type: ignore[index]
                    joined_s = at
    way = sum(float(np.linalg.norm(s.end_pose[:3, 3])) for submaps, _ in plans.values() for s in submaps)
    waits = np.array(list(took.values()))
    held = sum(key in keys for key in took)
    print(f"{held} of {count} submaps, 50 % {np.median(waits):.1f} s, 95 % {np.percentile(waits, 95):.1f} s, "
          f"most {waits.max():.1f} s, {channel.sent / way / 1e3:.1f} kB/m, channel used "
          f"{100 * channel.sent / rate / now:.0f} %, the last {joined_s - last_s:.1f} s after its end")  # fmt: skip
    if arguments.silence:
        gone = backlogs_gone(ended, took, silences)
        print(f"backlog gone after a silence: 50 % {np.median(gone):.1f} s, 95 % {np.percentile(gone, 95):.1f} s, "
              f"most {gone.max():.1f} s")  # fmt: skip


def repeated(submaps: list[Submap], seconds: float) -> tuple[list[Submap], list[float]]:
    """Submaps of the run, repeated in further sessions for at least so long, and seconds at which they end."""
    first, last = submaps[0], submaps[-1]
    length_s = (last.end_stamp_ns - first.start_stamp_ns) * 1e-9
    times = max(1, int(np.ceil(seconds / length_s)))
    again = [replace(s, session=s.session + k) for k in range(times) for s in submaps]
    ends = [k * length_s + (s.end_stamp_ns - first.start_stamp_ns) * 1e-9 for k in range(times) for s in submaps]
    return again, ends


def backlogs_gone(
    ended: dict[tuple[str, tuple[int, int]], float],
    took: dict[tuple[str, object], float],
    silences: dict[str, FloatArray],
) -> FloatArray:
    """Seconds from the end of each agent's silence until its submaps of before had arrived; inf if one never has."""
    gone = dict.fromkeys(silences, 0.0)
    for (name, key), at in ended.items():
        end = silences[name][1]
        if at < end:
            gone[name] = max(gone[name], at + took.get((name, key), np.inf) - end)
    return np.array(list(gone.values()))


if __name__ == "__main__":
    main()
