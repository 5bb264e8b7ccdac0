# SPDX-License-Identifier: Apache-2.0
"""NDT and ICP: matching, descent, search for a pose, and how sure it is."""
