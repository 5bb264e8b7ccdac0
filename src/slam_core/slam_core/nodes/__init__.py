# SPDX-License-Identifier: Apache-2.0
"""Base classes of the nodes: inputs and their stamps, queues, diagnostics."""
