# SPDX-License-Identifier: Apache-2.0
"""Floor plans: free and occupied space at the height of a robot, as images and Nav2 maps."""
