# SPDX-License-Identifier: Apache-2.0
"""The extended Kalman filter: state, models, measurements, landmarks and their noise."""
