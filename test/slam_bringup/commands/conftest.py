# SPDX-License-Identifier: Apache-2.0
"""The world of submaps that the tests of joining have."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "sjsam_node"))
