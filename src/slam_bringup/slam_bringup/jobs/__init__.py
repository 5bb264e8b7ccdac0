# SPDX-License-Identifier: Apache-2.0
"""Work of a command that takes more than a call: refining a calibration, merging maps."""
