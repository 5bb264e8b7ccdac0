# SPDX-License-Identifier: Apache-2.0
"""Maps built from the feature-level world, and how far they are from the truth."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
