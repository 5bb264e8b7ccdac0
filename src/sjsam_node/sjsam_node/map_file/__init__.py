# SPDX-License-Identifier: Apache-2.0
"""A map on disk: its files, their checks, and further landmarks of submaps in it."""
