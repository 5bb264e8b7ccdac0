# SPDX-License-Identifier: Apache-2.0
"""The thesis's experiments, 2D SLAM on logs, text submaps and simulated bags: nothing that a robot needs."""
