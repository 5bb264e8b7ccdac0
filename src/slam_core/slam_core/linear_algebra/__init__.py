"""Sparse and dense linear algebra: orderings, Cholesky factors, marginals, BLAS without the interpreter lock."""
