# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import slam_core.linear_algebra.sparse_cholesky as sparse_cholesky
from slam_core.linear_algebra.block_pattern import BlockPattern
from slam_core.linear_algebra.sparse_cholesky import SparseCholesky, available_backend, elimination_order, takahashi


@pytest.fixture(params=["multifrontal", "cholmod", "superlu"])
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def problem(blocks: int, seed: int, widest: int = 4) -> tuple[np.ndarray, BlockPattern, np.ndarray]:
    """A sparse positive definite matrix of blocks up to ``widest`` wide (some empty), its pattern and values."""
    rng = np.random.default_rng(seed)
    width = rng.integers(0, widest + 1, blocks)
    width[0] = widest
    a, b = rng.integers(0, blocks, (2, 2 * blocks))
    low = np.concatenate([np.minimum(a, b), np.arange(blocks)])
    high = np.concatenate([np.maximum(a, b), np.arange(blocks)])
    used = (width[low] > 0) & (width[high] > 0)
    key = np.unique(low[used] * blocks + high[used])
    pattern = BlockPattern(width, np.searchsorted(key // blocks, np.arange(blocks + 1)), key % blocks)
    rows, columns = pattern.scalar_entries()
    values = rng.normal(size=len(rows))
    A = np.zeros((pattern.n, pattern.n))
    A[rows, columns] = values
    A = np.tril(A, -1) + np.tril(A, -1).T
    weight = np.abs(A).sum(axis=0) + 1.0
    values[pattern.diagonal] = weight
    return A + np.diag(weight), pattern, values


@pytest.mark.parametrize("blocks", [1, 2, 30, 150])
def test_solution_and_inverse_are_those_of_the_dense_matrix(blocks: int, backend: str) -> None:
    A, pattern, values = problem(blocks, blocks)
    factor = SparseCholesky(pattern, backend)
    assert factor.factorize(values)
    rng = np.random.default_rng(1)
    b, inverse = rng.normal(size=(pattern.n, 3)), np.linalg.inv(A)
    assert np.allclose(A @ factor.solve(b), b, atol=1e-10)
    assert np.allclose(A @ factor.solve(b[:, 0]), b[:, 0], atol=1e-10)
    some = rng.permutation(pattern.n)[:5]
    assert np.allclose(factor.inverse_block(some), inverse[np.ix_(some, some)], rtol=1e-9, atol=1e-13)
    entries = factor.inverse_entries()
    rows, columns = pattern.scalar_entries()
    for row, column in zip(rows[::7], columns[::7], strict=True):
        pair = np.array([column, row]) if row != column else np.array([column])
        assert np.allclose(entries.block(pair), inverse[np.ix_(pair, pair)], rtol=1e-9, atol=1e-13)
    assert np.allclose(A @ factor.solve(b), b, atol=1e-10)  # asking for the inverse has not spoiled the factor
    assert factor.factorize(2.0 * values)
    assert np.allclose(2.0 * A @ factor.solve(b), b, atol=1e-10)


def with_last_clique(blocks: int, last: int, seed: int) -> tuple[np.ndarray, BlockPattern, np.ndarray]:
    """As :func:`problem`, with the last blocks coupled to each other, and what else hangs on them in any order."""
    _, pattern, _ = problem(blocks, seed)
    column = np.repeat(np.arange(blocks), np.diff(pattern.column_ptr))
    a, b = np.tril_indices(last)
    extra = (blocks - last + b) * blocks + blocks - last + a
    extra = extra[(pattern.width[extra // blocks] > 0) & (pattern.width[extra % blocks] > 0)]
    key = np.unique(np.concatenate([column * blocks + pattern.rows, extra]))
    pattern = BlockPattern(pattern.width, np.searchsorted(key // blocks, np.arange(blocks + 1)), key % blocks)
    rows, columns = pattern.scalar_entries()
    values = np.random.default_rng(seed).normal(size=len(rows))
    A = np.zeros((pattern.n, pattern.n))
    A[rows, columns] = values
    A = np.tril(A, -1) + np.tril(A, -1).T
    values[pattern.diagonal] = np.abs(A).sum(axis=0) + 1.0
    return A + np.diag(values[pattern.diagonal]), pattern, values


@pytest.mark.parametrize("blocks", [6, 40, 150])
def test_what_is_eliminated_last_keeps_its_marginal_information(blocks: int, backend: str) -> None:
    A, pattern, values = with_last_clique(blocks, 5, blocks)
    factor = SparseCholesky(pattern, backend)
    assert factor.factorize(values)
    last = np.random.default_rng(2).permutation(np.arange(pattern.start[-6], pattern.n))
    expected = np.linalg.inv(np.linalg.inv(A)[np.ix_(last, last)])
    assert np.allclose(factor.marginal_information(last), expected, rtol=1e-9, atol=1e-10)


def test_marginal_information_of_what_is_not_last_is_refused() -> None:
    _, pattern, values = with_last_clique(40, 5, 3)
    factor = SparseCholesky(pattern, "multifrontal")
    assert factor.factorize(values)
    with pytest.raises(ValueError, match="eliminated after"):
        factor.marginal_information(np.arange(pattern.start[-6], pattern.n)[:2])


def test_work_counts_the_multiplications_of_a_factor(backend: str) -> None:
    """A dense matrix takes n^3 / 6; two that nothing couples take the sum of both."""
    alone = BlockPattern(np.array([30]), np.array([0, 1]), np.array([0]))
    assert SparseCholesky(alone, backend).work == pytest.approx(30.0**3 / 6.0)
    apart = BlockPattern(np.array([30, 20]), np.array([0, 1, 2]), np.array([0, 1]))
    assert SparseCholesky(apart, backend).work == pytest.approx((30.0**3 + 20.0**3) / 6.0)


def test_wide_fronts_are_factored_strip_by_strip() -> None:
    """One block of 200 unknowns over another: several strips of the blocked elimination, and a product below them."""
    width = np.array([200, 150])
    pattern = BlockPattern(width, np.array([0, 2, 3]), np.array([0, 1, 1]))
    root = np.random.default_rng(0).normal(size=(350, 350))
    A = root @ root.T + 350.0 * np.eye(350)
    rows, columns = pattern.scalar_entries()
    factor = SparseCholesky(pattern, "multifrontal")
    assert factor.factorize(A[rows, columns])
    assert np.allclose(factor.inverse_block(np.arange(350)), np.linalg.inv(A), rtol=1e-8)
    assert np.allclose(factor.inverse_entries().block(np.arange(350)), np.linalg.inv(A), rtol=1e-8)


def test_entries_above_the_diagonal_of_a_block_are_ignored(backend: str) -> None:
    A = np.array([[4.0, 1.0], [1.0, 3.0]])
    factor = SparseCholesky(BlockPattern(np.array([2]), np.array([0, 1]), np.array([0])), backend)
    assert factor.factorize(np.array([4.0, 1.0, 99.0, 3.0]))
    assert np.allclose(A @ factor.solve(np.array([1.0, 2.0])), [1.0, 2.0])


def test_what_is_not_positive_definite_is_said_so(backend: str) -> None:
    _, pattern, values = problem(30, 2)
    factor = SparseCholesky(pattern, backend)
    assert not factor.factorize(-values)
    assert not factor.factorize(np.full_like(values, np.nan))
    assert factor.factorize(values)


def test_entries_outside_the_pattern_raise(backend: str) -> None:
    alone = BlockPattern(np.ones(3, dtype=np.int64), np.array([0, 1, 2, 3]), np.array([0, 1, 2]))
    factor = SparseCholesky(alone, backend)
    factor.factorize(np.array([1.0, 2.0, 4.0]))
    with pytest.raises(KeyError):
        factor.inverse_entries().block(np.array([0, 2]))


def test_takahashi_over_a_dense_factor_is_the_inverse() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(90, 90))
    A = root @ root.T + 90 * np.eye(90)
    L = scipy.sparse.csc_matrix(np.linalg.cholesky(A))
    L.sort_indices()
    values = takahashi(L.indptr.astype(np.int64), L.indices.astype(np.int64), L.data)
    inverse = scipy.sparse.csc_matrix((values, L.indices, L.indptr), (90, 90)).toarray()
    assert np.allclose(inverse, np.tril(np.linalg.inv(A)), atol=1e-14)


def test_the_order_lowers_the_fill_of_an_arrow() -> None:
    n = 40
    hub, spokes = np.zeros(n - 1, dtype=np.int64), np.arange(1, n)
    order = elimination_order(n, hub, spokes)
    assert sorted(order.tolist()) == list(range(n))
    assert int(np.nonzero(order == 0)[0][0]) >= n - 2


def test_without_cvxopt_all_but_cholmod_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sparse_cholesky, "cvxopt", None)
    assert available_backend("auto") == "multifrontal"
    hub, spokes = np.zeros(9, dtype=np.int64), np.arange(1, 10)
    assert elimination_order(10, hub, spokes).tolist().index(0) >= 8
    with pytest.raises(ValueError, match="cvxopt"):
        available_backend("cholmod")


def test_unknown_backend_is_refused() -> None:
    with pytest.raises(ValueError, match="qr"):
        available_backend("qr")
