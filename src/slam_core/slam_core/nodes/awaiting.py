# SPDX-License-Identifier: Apache-2.0
"""Waiting inside an ``async`` callback of rclpy, whose executor goes on with all else meanwhile."""

from __future__ import annotations

import types
from collections.abc import Callable, Generator


@types.coroutine
def until(condition: Callable[[], bool]) -> Generator[None, None, None]:
    """Await what another thread does."""
    while not condition():
        yield
