# SPDX-License-Identifier: Apache-2.0
"""The sensors that are in a bag: their topics, calibration, and readings in order."""
