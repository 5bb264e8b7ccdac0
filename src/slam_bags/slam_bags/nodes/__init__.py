# SPDX-License-Identifier: Apache-2.0
"""The nodes ``bag_player`` and ``recorder``."""
