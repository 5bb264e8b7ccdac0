# SPDX-License-Identifier: Apache-2.0
"""The errors of a bag's calibration, as parameters beside its messages: ``calibration.yaml``.

``slam calibrate`` writes that file, ``slam simulate`` puts one into its bags, and a user copies it into a recording's
folder (beside a single file ``NAME.mcap``: ``NAME.calibration.yaml``). Whatever maps the bag reads it first, so that
poses are as uncertain as their calibration.
"""

from __future__ import annotations

from pathlib import Path

FILE_NAME = "calibration.yaml"


def calibration_file(bag: Path) -> Path:
    """Path at which a bag's file is looked for, a folder's or a single file's."""
    return bag / FILE_NAME if bag.is_dir() else bag.with_suffix(f".{FILE_NAME}")
