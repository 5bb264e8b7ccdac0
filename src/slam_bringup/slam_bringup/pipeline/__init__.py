# SPDX-License-Identifier: Apache-2.0
"""The offline chain: the same classes as the nodes, called frame by frame."""
