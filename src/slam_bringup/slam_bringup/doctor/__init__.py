# SPDX-License-Identifier: Apache-2.0
"""Checks of a recording before the SLAM is blamed: each thing that is wrong in one line, with what to do."""
