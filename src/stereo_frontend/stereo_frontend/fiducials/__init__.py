# SPDX-License-Identifier: Apache-2.0
"""Fiducial tags: found in an image, with a full pose, and handed on as features."""
