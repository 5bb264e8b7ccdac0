# SPDX-License-Identifier: Apache-2.0
"""Point clouds: files, voxels, surfaces, what was seen."""
