# SPDX-License-Identifier: Apache-2.0
"""Tests that decide which closures a map holds."""
