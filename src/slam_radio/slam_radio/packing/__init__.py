# SPDX-License-Identifier: Apache-2.0
"""A submap for the air: chosen landmarks, compact Gaussian, coded descriptors, bytes."""
