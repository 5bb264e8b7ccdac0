# SPDX-License-Identifier: Apache-2.0
"""Rays, shading and shutters: pictures of the world."""
