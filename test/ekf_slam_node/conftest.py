# SPDX-License-Identifier: Apache-2.0
"""Makes the feature-level simulator importable by this folder's tests."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
