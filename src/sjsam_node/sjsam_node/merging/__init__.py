# SPDX-License-Identifier: Apache-2.0
"""Finished maps of any agents and days become one map."""
