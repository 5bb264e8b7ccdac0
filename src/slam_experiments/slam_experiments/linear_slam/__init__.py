# SPDX-License-Identifier: Apache-2.0
"""Text submaps of Linear SLAM, joined by ``slam join``."""
