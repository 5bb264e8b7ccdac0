# SPDX-License-Identifier: Apache-2.0
"""CenSurE against a twin that adds up pixels one by one, and on pictures whose keypoints are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from stereo_frontend.detection.censure import INNER, OUTER, CensureDetector, responses
from stereo_frontend.surf.surf import SurfConfig


def keep_all(uv, size, response):
    return np.arange(len(uv))


def octagon_mask(octagon: tuple[int, int], reach: int) -> np.ndarray:
    """Pixels (2 reach + 1)^2 of an octagon with upright sides of a length and slanted ones of a height."""
    side, slant = octagon
    j, i = np.abs(np.mgrid[-reach : reach + 1, -reach : reach + 1])
    half = side // 2
    return (i <= half + slant) & (j <= half + slant) & (i + j <= side - 1 + slant)


def blob(radius: float, at: tuple[float, float], contrast: float = 100.0) -> np.ndarray:
    y, x = np.mgrid[:120, :160]
    squared = (x - at[0]) ** 2 + (y - at[1]) ** 2
    return np.round(100.0 + contrast * np.exp(-squared / radius**2)).astype(np.uint8)


@pytest.mark.parametrize("size", range(len(INNER)))
def test_responses_equal_the_mean_inside_less_the_mean_around(size, rng):
    image = rng.integers(0, 256, (60, 70), dtype=np.uint8)
    reach = OUTER[size][0] // 2 + OUTER[size][1]
    inner, outer = (octagon_mask(octagon[size], reach) for octagon in (INNER, OUTER))
    found = responses(image)[size]
    for x, y in ((reach, reach), (33, 28), (69 - reach, 59 - reach)):
        patch = image[y - reach : y + reach + 1, x - reach : x + reach + 1].astype(float)
        expected = patch[inner].mean() - patch[outer & ~inner].mean()
        assert found[y, x] == pytest.approx(expected, abs=1e-4)
    assert found[reach - 1].max() == 0.0


@pytest.mark.parametrize("contrast", [100.0, -80.0])
@pytest.mark.parametrize("radius", [4.0, 6.0])
def test_a_blob_is_found_at_its_place(radius, contrast):
    at = (80.3, 59.6)
    found = CensureDetector()(blob(radius, at, contrast), 1.0, keep_all)
    best = found.response.argmax()
    np.testing.assert_allclose(found.uv[best], at, atol=0.15)
    assert found.descriptors.shape[1] == 128


def test_keypoints_are_extrema_among_all_their_neighbours(rng):
    smooth = gaussian_filter(rng.standard_normal((120, 160)), 2.5)
    image = np.round(128.0 + 300.0 * smooth).clip(0, 255).astype(np.uint8)
    response = responses(image)
    highest, lowest = maximum_filter(response, 3), minimum_filter(response, 3)
    is_extremum = ((response == highest) & (response > 8.0)) | ((response == lowest) & (response < -8.0))
    is_extremum[[0, -1]] = False
    found = CensureDetector()(image, 1.0, keep_all)
    assert 20 < len(found) <= is_extremum.sum()
    near = maximum_filter(is_extremum.any(axis=0), 3)
    u, v = np.round(found.uv).astype(int).T
    assert near[v, u].all()


def test_larger_blobs_have_larger_keypoints():
    sizes = []
    for radius in (3.6, 5.6):
        found = CensureDetector()(blob(radius, (80.0, 60.0)), 1.0, keep_all)
        sizes.append(found.size[found.response.argmax()])
    assert sizes[1] > 1.4 * sizes[0]


def test_places_along_a_line_are_left_out():
    image = np.full((120, 160), 80, np.uint8)
    slanted = np.abs(np.mgrid[:120, :160][0] * 0.31 + np.mgrid[:120, :160][1] - 95.0) < 3.0
    image[slanted] = 160
    assert np.abs(responses(image)).max() > 30.0
    inside = [uv for uv in CensureDetector()(image, 1.0, keep_all).uv if 25 < uv[1] < 95]
    assert inside == []


def test_descriptors_are_as_long_as_surf_is_told():
    found = CensureDetector(SurfConfig(extended=False))(blob(4.0, (80.0, 60.0)), 1.0, keep_all)
    assert found.descriptors.shape[1] == 64


def test_images_beyond_32_bit_sums_are_refused():
    with pytest.raises(ValueError, match="at most"):
        CensureDetector()(np.zeros((3000, 3000), np.uint8), 1.0, keep_all)
