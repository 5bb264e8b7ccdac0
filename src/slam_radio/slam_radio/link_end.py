# SPDX-License-Identifier: Apache-2.0
"""Base of the ends of a link, and the node of one as far as an end needs it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from slam_core.health import Health
from slam_core.messages import MessageTypes
from slam_core.types import Submap
from slam_radio.link_state import LinkState
from slam_radio.queues.detail_store import DetailStore
from slam_radio.radio_config import RadioConfig
from slam_radio.wire.index_ranges import Key
from slam_radio.zenoh_link import ZenohLink


class LinkNode(Protocol):
    """The node of an end, as far as the end needs it: its topics, its health, and the link of bytes."""

    config: RadioConfig
    state_folder: Path
    link: ZenohLink
    health: Health
    types: MessageTypes

    def listen(self, *args: Any, **more: Any) -> Any: ...  # noqa: D102
    def listen_together(self, *args: Any, **more: Any) -> Any: ...  # noqa: D102
    def advertise(self, *args: Any, **more: Any) -> Any: ...  # noqa: D102
    def publish(self, *args: Any, **more: Any) -> Any: ...  # noqa: D102
    def broadcast(self, *args: Any, **more: Any) -> Any: ...  # noqa: D102
    def do_later(self, *args: Any, **more: Any) -> Any: ...  # noqa: D102
    def lookup(self, *args: Any, **more: Any) -> Any: ...  # noqa: D102
    def serve(self, name: str, action: Callable[[], str]) -> None: ...  # noqa: D102
    def get_logger(self, *args: Any, **more: Any) -> Any: ...  # noqa: D102


class End:
    """One end of the link, around its node: ``pump`` sends what is due, ``state`` is its health."""

    def __init__(self, node: LinkNode) -> None:
        self.node = node

    def pump(self, now_s: float) -> None:
        """Send what is due."""
        raise NotImplementedError

    def state(self, now_s: float) -> LinkState:
        """Health of the link."""
        raise NotImplementedError

    def reset(self) -> None:
        """Forget what has come (``~/reset``); what waits still has to go out."""

    def close(self) -> None:
        """Keep what waits and what has come for the next start."""

    def tell_strangers(self, strangers: Mapping[Path, int], use: str) -> None:
        """Say how many files, of an earlier version or damaged, cannot be read; they stay where they are."""
        for folder, count in strangers.items():
            self.node.health.count("files of another version", count)
            self.node.get_logger().warning(
                f"{count} files in {folder} are of another version of this program, or damaged: "
                f"they are kept, and not {use}"
            )

    def keep_details(self, store: DetailStore, key: Key, submap: Submap, message: bytes) -> None:
        """Keep what the message of a submap leaves out; a submap goes out without that too."""
        try:
            store.keep(key, submap, message)
        except OSError as error:
            self.node.health.count("submaps whose details cannot be kept")
            self.node.get_logger().warning(f"details of submap {key[1]} cannot be kept: {error}")

    def hear(self, key: str, handle: Callable[[str, bytes], None]) -> None:
        """Have messages under a key handled in the node's own thread; damaged ones are counted."""

        def run(name: str, data: bytes) -> None:
            self.node.health.count("bytes_received", len(data))
            try:
                handle(name, data)
            except (ValueError, OSError) as error:
                self.node.health.count("damaged" if isinstance(error, ValueError) else "not_written")
                self.node.get_logger().warning(f"{name}: message refused: {error}", throttle_duration_sec=1.0)

        self.node.link.listen(key, lambda name, data: self.node.do_later("radio", partial(run, name, data)))

    def send(self, key: str, data: bytes, *, urgent: bool = False) -> None:
        """Send and count."""
        self.node.health.count("bytes_sent", len(data))
        self.node.link.send(key, data, urgent=urgent)
