# SPDX-License-Identifier: Apache-2.0
"""Evidence that adds up in groups, and what it says."""

from __future__ import annotations

import numpy as np

from stereo_frontend.stereo.normal_equations import EvidenceWindow, NormalEquations, sandwich_estimate


def test_pieces_are_summed_in_groups_and_the_oldest_group_goes_as_a_whole():
    window = EvidenceWindow(3, 6)
    lengths = []
    for k in range(8):
        window.add(NormalEquations(np.array([[10.0**k]]), np.array([float(k)])))
        lengths.append(len(window))
    assert lengths == [1, 2, 3, 4, 5, 6, 4, 5]
    assert [float(s.information[0, 0]) for s in window.sums] == [111000.0, 11000000.0]
    assert [float(s.vector[0]) for s in window.sums] == [12.0, 13.0]
    window.clear()
    assert len(window) == 0


def test_the_estimate_is_the_weighted_mean_and_doubts_groups_that_scatter(rng):
    truth, prior = np.array([0.3, -0.2]), 1e-6 * np.eye(2)
    rows = rng.standard_normal((20, 30, 2))
    calm, wild = (
        [
            NormalEquations(J.T @ J, J.T @ (J @ (truth + shift) + rng.standard_normal(30)))
            for J, shift in zip(rows, scatter * rng.standard_normal((20, 2)), strict=True)
        ]
        for scatter in (0.0, 1.0)
    )
    (theta, covariance), (_, doubted) = (sandwich_estimate(groups, prior) for groups in (calm, wild))
    information = sum(e.information for e in calm)
    np.testing.assert_allclose(theta, np.linalg.solve(information + prior, sum(e.vector for e in calm)))
    assert 0.99 < np.trace(covariance) / np.trace(np.linalg.inv(information)) < 3.0
    assert np.trace(doubted) > 5.0 * np.trace(covariance)
