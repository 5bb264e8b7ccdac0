# SPDX-License-Identifier: Apache-2.0
"""The open submap: frames in, a closed submap out."""
