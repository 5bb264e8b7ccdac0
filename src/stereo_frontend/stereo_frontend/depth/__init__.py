# SPDX-License-Identifier: Apache-2.0
"""Features with depth of a ToF or depth camera, alone or beside stereo."""
