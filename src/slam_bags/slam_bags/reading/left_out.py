# SPDX-License-Identifier: Apache-2.0
"""Messages of a bag that are not used: how many, why, and the first of each kind in words."""

from __future__ import annotations

from collections import Counter


class LeftOut:
    """``counts`` of messages by reason, and ``warnings``: what a person should read of them, once each."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.warnings: list[str] = []

    def add(self, reason: str, number: int = 1, warning: str = "") -> None:
        """Count messages; the ``warning`` of a reason's first ones is kept."""
        if not self.counts[reason]:
            self.warn(warning)
        self.counts[reason] += number

    def unusable(self, topic: str, error: ValueError) -> None:
        """Count a message of a topic that is broken."""
        self.add(f"unusable messages on {topic}", warning=f"{topic}: {error}")

    def warn(self, text: str) -> None:
        """Keep a text, unless it is known."""
        if text and text not in self.warnings:
            self.warnings.append(text)
