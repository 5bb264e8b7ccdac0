# SPDX-License-Identifier: Apache-2.0
"""SURF: integral images, detector, descriptor."""
