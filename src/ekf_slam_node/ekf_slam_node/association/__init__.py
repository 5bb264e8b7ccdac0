# SPDX-License-Identifier: Apache-2.0
"""Which features of a frame are which landmarks, and the motion that follows from it."""
