# SPDX-License-Identifier: Apache-2.0
"""Loop closures between submaps: candidates, their verification, and whether they are consistent."""
