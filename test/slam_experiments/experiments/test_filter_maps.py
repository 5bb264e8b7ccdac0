# SPDX-License-Identifier: Apache-2.0
"""The filter on features alone: what becomes of an unknown heading, and a map that is where the landmarks are."""

from __future__ import annotations

import numpy as np
import pytest

from slam_experiments.experiments.filter_maps import map_by, map_figure, variances_of_unknown_heading


def test_only_the_standard_error_state_invents_a_heading(tmp_path):
    standard, ours = (
        variances_of_unknown_heading(tmp_path, [], error, 15)[1]["variances"] for error in ("standard", "invariant")
    )
    assert standard[0, 2] == ours[0, 2] == pytest.approx(0.25)
    assert standard[-1, 2] < 1e-3
    assert ours[-1, 2] == pytest.approx(0.25, rel=1e-4)


@pytest.mark.parametrize("method", ["nearest", "mahalanobis"])
def test_the_map_of_either_association_is_near_the_truth(tmp_path, method):
    values, arrays = map_by(tmp_path, [], method, 12)
    assert values["rmse_m"] < 0.02
    assert arrays["poses"].shape == arrays["truth"].shape == (12, 4, 4)
    assert len(arrays["landmarks"]) == len(arrays["covariances"]) > 50
    axes = map_figure(arrays).axes[0]
    stars, _, dots, _ = axes.lines
    np.testing.assert_allclose(np.column_stack(stars.get_data()), arrays["landmarks"][:, :2])
    np.testing.assert_allclose(np.column_stack(dots.get_data()), arrays["poses"][::3, :2, 3])
