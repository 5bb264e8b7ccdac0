# SPDX-License-Identifier: Apache-2.0
"""Bags: reading, writing, playing and recording them; the sensors that are in them."""
