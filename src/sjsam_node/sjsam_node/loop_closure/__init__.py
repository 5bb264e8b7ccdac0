# SPDX-License-Identifier: Apache-2.0
"""Which submaps see the same place: candidates, their verification, and whether they are consistent."""
