# SPDX-License-Identifier: Apache-2.0
"""Sparse and dense linear algebra: orderings, Cholesky factors, marginals, BLAS without the interpreter lock."""
