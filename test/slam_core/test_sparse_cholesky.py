from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import slam_core.sparse_cholesky as sparse_cholesky
from slam_core.sparse_cholesky import Pattern, SparseCholesky, available_backend, elimination_order, takahashi


@pytest.fixture(params=["cholmod", "superlu", "lapack"])
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def problem(n: int, seed: int) -> tuple[np.ndarray, Pattern, np.ndarray]:
    """A sparse positive definite matrix, its lower pattern and values."""
    rng = np.random.default_rng(seed)
    root = scipy.sparse.random(n, n, min(1.0, 3.0 / n), random_state=rng)
    A = (root @ root.T + scipy.sparse.eye(n)).tocsc()
    lower = scipy.sparse.tril(A).tocsc()
    lower.sort_indices()
    return A.toarray(), Pattern(n, lower.indptr.astype(np.int64), lower.indices.astype(np.int64)), lower.data


@pytest.mark.parametrize("n", [1, 2, 60, 200])
def test_solution_and_inverse_entries_are_those_of_the_dense_matrix(n: int, backend: str) -> None:
    A, pattern, values = problem(n, n)
    factor = SparseCholesky(pattern, backend)
    assert factor.factorize(values)
    b = np.random.default_rng(1).normal(size=(n, 3))
    assert np.allclose(A @ factor.solve(b), b, atol=1e-10)
    assert np.allclose(A @ factor.solve(b[:, 0]), b[:, 0], atol=1e-10)
    entries, inverse = factor.inverse_entries(), np.linalg.inv(A)
    for column in range(0, n, 7):
        rows = pattern.indices[pattern.indptr[column] : pattern.indptr[column + 1]]
        for row in rows:
            block = entries.block(np.array([column, row]) if row != column else np.array([column]))
            assert block[0, -1] == pytest.approx(inverse[column, row], abs=1e-11)
    assert np.allclose(A @ factor.solve(b), b, atol=1e-10)  # the export of L has not spoiled the factor


def test_lower_is_the_factor_of_the_permuted_matrix(backend: str) -> None:
    A, pattern, values = problem(80, 5)
    factor = SparseCholesky(pattern, backend)
    factor.factorize(values)
    for _ in range(2):
        L, order = factor.lower()
        assert np.allclose((L @ L.T).toarray(), A[np.ix_(order, order)], atol=1e-12)


def test_entries_above_the_diagonal_are_ignored(backend: str) -> None:
    A = np.array([[4.0, 1.0], [1.0, 3.0]])
    whole = Pattern(2, np.array([0, 2, 4]), np.array([0, 1, 0, 1]))
    factor = SparseCholesky(whole, backend)
    assert factor.factorize(np.array([4.0, 1.0, 99.0, 3.0]))
    assert np.allclose(A @ factor.solve(np.array([1.0, 2.0])), [1.0, 2.0])


def test_what_is_not_positive_definite_is_said_so(backend: str) -> None:
    _, pattern, values = problem(30, 2)
    factor = SparseCholesky(pattern, backend)
    assert not factor.factorize(-values)
    assert not factor.factorize(np.full_like(values, np.nan))
    assert factor.factorize(values)


@pytest.mark.parametrize("backend", ["cholmod", "superlu"])
def test_entries_outside_the_pattern_raise(backend: str) -> None:
    factor = SparseCholesky(Pattern(3, np.array([0, 1, 2, 3]), np.array([0, 1, 2])), backend)
    factor.factorize(np.array([1.0, 2.0, 4.0]))
    with pytest.raises(KeyError):
        factor.inverse_entries().block(np.array([0, 2]))


def test_a_nearly_full_matrix_is_factored_densely() -> None:
    full = Pattern(3, np.array([0, 3, 5, 6]), np.array([0, 1, 2, 1, 2, 2]))
    assert SparseCholesky(full).backend == "lapack"
    sparse = Pattern(20, np.arange(21), np.arange(20))
    assert SparseCholesky(sparse).backend != "lapack"


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


def test_without_cvxopt_superlu_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sparse_cholesky, "cvxopt", None)
    assert available_backend("auto") == "superlu"
    assert sorted(elimination_order(4, np.array([0, 1]), np.array([1, 2])).tolist()) == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="cvxopt"):
        available_backend("cholmod")


def test_unknown_backend_is_refused() -> None:
    with pytest.raises(ValueError, match="qr"):
        available_backend("qr")
