# SPDX-License-Identifier: Apache-2.0
"""What filterpy would cost scan odometry at run time: its import, and its process noise beside the whole prediction."""

from __future__ import annotations

import time
import timeit

import ndt_registration.stage  # noqa: F401  # what the node imports anyway
from ndt_registration.motion_filter import MotionFilter, MotionFilterConfig

CALLS = 500


def main() -> None:
    """Print processor time of the import and microseconds of each."""
    began = time.process_time()
    from filterpy.common import Q_discrete_white_noise

    imported = time.process_time() - began
    motion = MotionFilter(MotionFilterConfig())
    noise, prediction = (
        1e6 * min(timeit.repeat(call, number=CALLS, repeat=5)) / CALLS
        for call in (lambda: Q_discrete_white_noise(2, 0.1, 4.0, block_size=3), lambda: motion.predict(0.1))
    )
    print(f"import of filterpy.common: {1e3 * imported:.0f} ms of processor time")
    print(f"Q_discrete_white_noise of three axes: {noise:.0f} us; the whole prediction without it: {prediction:.0f} us")


if __name__ == "__main__":
    main()
