# SPDX-License-Identifier: Apache-2.0
"""The least-squares problem of joining: local maps, unknowns, residuals and their kernels."""
