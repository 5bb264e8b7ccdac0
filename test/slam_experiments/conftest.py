# SPDX-License-Identifier: Apache-2.0
"""Makes the 2D simulator, text submaps and the small joining problems importable by the tests below."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent / "sjsam_node")]
