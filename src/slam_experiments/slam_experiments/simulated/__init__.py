# SPDX-License-Identifier: Apache-2.0
"""Simulated bags, frames and scans with their truth, and bounds of what is made of them."""
