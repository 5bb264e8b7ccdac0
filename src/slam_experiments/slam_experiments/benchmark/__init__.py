# SPDX-License-Identifier: Apache-2.0
"""Recordings with ground truth, in variants and beside other programs: what ``slam benchmark`` judges a change by."""
