# SPDX-License-Identifier: Apache-2.0
"""Patches of key frames followed from picture to picture."""
