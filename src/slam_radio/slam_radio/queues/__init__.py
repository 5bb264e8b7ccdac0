# SPDX-License-Identifier: Apache-2.0
"""Submaps that wait, are in flight, have arrived or are kept for requests."""
