# SPDX-License-Identifier: Apache-2.0
"""Which frames of a run are kept as pictures."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_frontend import frame_log
from stereo_frontend.frame_log import FrameLog, LoggedFrame


class Seen:
    """Features of a stamp, and nothing in them."""

    def __init__(self, stamp_ns: int) -> None:
        self.stamp_ns = stamp_ns


def test_up_to_four_frames_a_second_are_kept_of_a_long_run_fewer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_log, "_logged", lambda _, features: LoggedFrame(b"", features))
    monkeypatch.setattr(frame_log, "_MOST", 8)
    log = FrameLog()
    stamps = 10**18 + 10**8 * np.arange(200)  # 10 Hz
    for stamp in stamps[:16].tolist():
        log.add(None, Seen(stamp))  # type: ignore[arg-type]
    assert [frame.stamp_ns for frame in log.frames] == stamps[:16:3].tolist()
    for stamp in stamps[16:].tolist():
        log.add(None, Seen(stamp))  # type: ignore[arg-type]
    assert 4 <= len(log.frames) <= 8
    assert log.frames[0].stamp_ns == stamps[0]
    assert len({round((b.stamp_ns - a.stamp_ns) / 1e8) for a, b in zip(log.frames, log.frames[1:], strict=False)}) <= 2
