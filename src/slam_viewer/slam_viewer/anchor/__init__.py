# SPDX-License-Identifier: Apache-2.0
"""A map on the floor plan of its building: both as pictures, the page to click points on, one drawn on the other."""
