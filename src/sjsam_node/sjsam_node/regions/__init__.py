# SPDX-License-Identifier: Apache-2.0
"""Joining as a tree of eliminations over regions of the map, as tasks that may run on other machines."""
