# SPDX-License-Identifier: Apache-2.0
"""The nodes as processes: which ones, with which parameters, started, watched and ended."""
