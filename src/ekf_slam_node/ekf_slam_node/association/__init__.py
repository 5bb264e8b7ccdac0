# SPDX-License-Identifier: Apache-2.0
"""Pairs of features and landmarks, and the motion that follows from them."""
