# SPDX-License-Identifier: Apache-2.0
"""Figures to scale are no higher than what they show."""

import pytest

from slam_viewer.report.canvas import WIDTH, blank, draw_to_scale


@pytest.mark.parametrize(("high", "is_lower"), [(1.0, True), (5.0, True), (40.0, False)])
def test_a_figure_to_scale_has_no_empty_rim(high, is_lower):
    figure, ((axes,),) = blank(8.0)
    axes.set_xlim(0.0, 10.0)
    axes.set_ylim(0.0, high)
    draw_to_scale(figure, axes)
    height = figure.get_size_inches()[1]
    assert (height < 8.0) == is_lower
    inches = axes.get_position(original=True).height * height
    if high == 5.0:
        assert inches == pytest.approx(0.5 * axes.get_position(original=True).width * WIDTH, rel=1e-6)
    assert inches >= 1.5 - 1e-9
