# SPDX-License-Identifier: Apache-2.0
"""Makes a bag of three agents from that of one: each has a part of its time, and parts overlap.

    python benchmarks/radio/split_agents.py BAG -o SPLIT.mcap

The parts are 0 to 45, 28 to 72 and 55 to 100 % of the recording; ``slam run SPLIT.mcap -o OUT`` maps them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from slam_bags.storage.bag import BagReader, BagWriter

PARTS = {"anna": (0.0, 0.45), "bert": (0.28, 0.72), "cleo": (0.55, 1.0)}
"""Share of the recording at which each agent begins and ends."""
_SHARED = ("/tf", "/tf_static")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path, metavar="BAG")
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    with BagReader(arguments.bag) as bag, BagWriter(arguments.output) as split:
        seconds = {agent: [share * bag.duration_s for share in part] for agent, part in PARTS.items()}
        for message in bag.raw():
            info = bag.topics[message.topic]
            if message.topic in _SHARED:
                split.write_raw(message.topic, info.type_name, message.data, message.stamp_ns)
                continue
            since = (message.stamp_ns - bag.start_ns) * 1e-9
            for agent, (start, end) in seconds.items():
                if start <= since <= end or info.count == 1:
                    split.write_raw(f"/{agent}{message.topic}", info.type_name, message.data, message.stamp_ns)


if __name__ == "__main__":
    main()
