# SPDX-License-Identifier: Apache-2.0
"""Positions of the rig in a fixed frame (UWB, GNSS) in the joined map: gated, aligned, and joined with it."""
