# SPDX-License-Identifier: Apache-2.0
"""A compact Gaussian is close to its covariance and never surer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_radio.packing import compact_gaussian as module
from slam_radio.packing.compact_gaussian import compact_gaussian, extended


def rays(S):
    """Rays of the landmarks of a covariance, in all directions."""
    return np.random.default_rng(len(S)).normal(size=((len(S) - 6) // 3, 3))


def compacted(S, rank, rounding=0.0):
    return compact_gaussian(S, rays(S), rank, rounding)


def largest_share(inner, outer) -> float:
    """Largest variance of ``inner`` over that of ``outer`` in any direction."""
    L = np.linalg.inv(np.linalg.cholesky(outer))
    return float(np.linalg.eigvalsh(L @ inner @ L.T)[-1])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("rank", [1, 4, 8, 40])
def test_it_is_never_surer_in_any_direction(make_submap, rank, seed):
    S = make_submap(30, seed, common=6).covariance
    assert largest_share(S, compacted(S, rank).covariance()) <= 1.0


def test_a_poor_first_guess_of_the_inflation_is_mended(make_submap, monkeypatch):
    S = make_submap(30, common=6).covariance
    good = compacted(S, 4)
    monkeypatch.setattr(module, "_KRYLOV", 1)
    mended = compacted(S, 4)
    assert largest_share(S, mended.covariance()) <= 1.0
    assert good.inflation <= mended.inflation < 2.0 * good.inflation


def test_the_inflation_is_nearly_the_least(make_submap):
    S = make_submap(30, common=6).covariance
    found = compacted(S, 4)
    assert found.inflation > 1.1
    less = replace(found, inflation=0.99 * found.inflation)
    assert largest_share(S, less.covariance()) > 1.0


@pytest.mark.parametrize(
    "changed",
    [
        {"pose": np.zeros(21, dtype=np.float16)},
        {"pose": np.full(21, np.nan, dtype=np.float16)},
        {"factors": np.full((5, 6), 24 * 45)},
        {"factors": np.full((5, 6), -25 * 45)},
        {"factors": np.tile([0, 0, 0, 2**20, 0, 2**20], (5, 1))},
    ],
)
def test_blocks_that_are_nearly_singular_or_cannot_be_are_refused(make_submap, changed):
    found = compacted(make_submap(5).covariance, 4)
    found.require_positive()
    with pytest.raises(ValueError, match=r"covariance that|not finite"):
        replace(found, **changed).require_positive()


@pytest.mark.parametrize("m", [3, 6])
def test_singular_values_are_left_out_only_where_the_determinant_tells(rng, m, monkeypatch):
    decomposed = []
    svd = np.linalg.svd
    monkeypatch.setattr(np.linalg, "svd", lambda L, **options: decomposed.append(len(L)) or svd(L, **options))
    count = {True: 0, False: 0}
    for exponent in rng.uniform(-6.0, 2.0, 600):
        L = np.tril(rng.normal(size=(1, m, m)), -1) + 10.0**exponent * np.eye(m)
        L /= np.linalg.norm(L, axis=-1, keepdims=True)
        nearly = module._is_nearly_singular(L)
        assert nearly == (svd(L, compute_uv=False).min() < module._LEAST_SHARE)
        count[nearly] += 1
    assert min(count.values()) > 100
    assert len(decomposed) < 600
    assert not module._is_nearly_singular(np.empty((0, m, m)))


@pytest.mark.parametrize("rank", [1, 8])
def test_with_more_landmarks_it_is_not_surer_either(make_submap, rank):
    submap = make_submap(40, common=5)
    S, known = submap.covariance, 6 + 3 * 25
    first = compact_gaussian(S[:known, :known], submap.landmarks[:25], rank, 1e-3)
    whole = extended(first, S, submap.landmarks[25:], 2e-3)
    assert largest_share(S, whole.covariance()) <= 1.0
    np.testing.assert_array_equal(whole.common[:known], first.common)
    np.testing.assert_array_equal(whole.factors[:25], first.factors)


def test_more_landmarks_share_the_directions_that_are_known(make_submap):
    submap = make_submap(40, common=5)
    S, known = submap.covariance, 6 + 3 * 25
    first = compact_gaussian(S[:known, :known], submap.landmarks[:25], 8)
    whole = extended(first, S, submap.landmarks[25:]).covariance()
    shares = np.diag(whole)[known:] / np.diag(S)[known:]
    apart = S.copy()
    apart[known:, :known] = apart[:known, known:] = 0.0
    correlation = np.abs(whole[known:, :known] / np.sqrt(np.outer(np.diag(whole)[known:], np.diag(whole)[:known])))
    assert np.median(np.sqrt(shares)) < 1.4
    assert np.median(correlation) > 0.1


def test_few_common_directions_are_found_and_little_is_lost(make_submap):
    S = make_submap(40, common=5).covariance
    all_five, one = (np.median(np.sqrt(np.diag(compacted(S, r).covariance()) / np.diag(S))) for r in (8, 1))
    assert all_five - 1.0 < 0.4 * (one - 1.0)
    assert all_five < 1.2


def test_rounding_of_positions_is_in_the_variances(make_submap):
    S = make_submap(5).covariance
    fine, coarse = (compacted(S, 4, rounding).covariance() for rounding in (0.0, 0.1))
    assert (np.diag(coarse)[6:] > np.diag(S)[6:] + 0.009).all()
    assert (np.diag(fine)[6:] < np.diag(S)[6:] + 0.009).all()


def test_a_covariance_that_is_none_or_too_large_is_refused(make_submap):
    S = make_submap(5).covariance
    with pytest.raises(ValueError, match="positive definite"):
        compacted(-S, 4)
    with pytest.raises(ValueError, match="finite"):
        compacted(np.where(np.eye(len(S), k=8) > 0, np.nan, S), 4)
    with pytest.raises(ValueError, match="too large"):
        compacted(1e8 * S, 4)


@pytest.mark.parametrize("share", [1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8])
def test_what_is_sent_of_a_landmark_known_in_two_directions_is_taken(make_submap, share):
    """Never surer, with a factor that the other side takes; or refused."""
    S = make_submap(5).covariance
    L = 0.02 * np.array([[1.0, 0.0, 0.0], [0.7, share, 0.0], [0.3, 0.3, 0.1]])
    S[6:] = S[:, 6:] = 0.0
    S[6:, 6:] = np.kron(np.eye(5), L @ L.T)
    if share < 1e-3:
        with pytest.raises(ValueError, match="positive definite"):
            compacted(S, 4)
    else:
        found = compacted(S, 4)
        assert 1.0 <= found.inflation < module.MOST_INFLATION
        assert largest_share(S, found.covariance()) <= 1.0


def test_a_factor_that_the_other_side_would_refuse_is_refused(make_submap, monkeypatch):
    S = make_submap(30, common=6).covariance
    needed = compacted(S, 4).inflation
    monkeypatch.setattr(module, "MOST_INFLATION", needed * (1.0 - 1e-3))
    with pytest.raises(ValueError, match="times too large"):
        compacted(S, 4)
    monkeypatch.setattr(module, "_is_positive", lambda S: False)
    monkeypatch.setattr(module, "MOST_INFLATION", 1e6)
    with pytest.raises(ValueError, match="times too large"):
        compacted(S, 4)


def test_a_submap_without_landmarks_has_its_pose(make_submap):
    S = make_submap(4).covariance[:6, :6]
    found = compacted(S, 8).covariance()
    assert found.shape == (6, 6)
    assert largest_share(S, found) <= 1.0
    np.testing.assert_allclose(found, S, rtol=0.2, atol=0.05 * np.abs(S).max())
