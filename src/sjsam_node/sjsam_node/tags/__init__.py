# SPDX-License-Identifier: Apache-2.0
"""Fiducial tags in the joined map: closures by them, known ones, and what the map says of each."""
