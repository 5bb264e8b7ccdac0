# SPDX-License-Identifier: Apache-2.0
"""SURF's compiled kernels against plain NumPy that follows the paper word by word."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from stereo_frontend.surf.surf import SurfConfig, SurfDetector
from stereo_frontend.surf.surf_descriptor import describe_oriented, describe_upright, orientation, region_weights
from stereo_frontend.surf.surf_detector import find_keypoints, find_maxima, fitting_octaves, halved, integral_image
from stereo_frontend.surf.surf_hessian import FILTER_SIZES, determinant_at, row_filter
from stereo_frontend.surf.surf_integral import KEPT_ROWS, integral_room, next_integral_row
from stereo_frontend.surf.surf_pair import LANES, SAMPLES, STEP, WEIGHT_SIGMA, describe_for_pair


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    noise = np.random.default_rng(3).uniform(0, 255, (130, 170)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.fixture(scope="module")
def squares() -> np.ndarray:
    """Black and white squares of 5 to 9 px and blobs: sums over lobes come as near to 2^16 as they can."""
    picture = np.zeros((130, 170), np.uint8)
    for top, side in ((0, 5), (30, 7), (65, 9)):
        white = np.random.default_rng(side).random((30 // side, 170 // side + 1)) < 0.5
        tiles = np.kron(255 * white, np.ones((side, side)))[:, :170]
        picture[top : top + len(tiles)] = tiles
    picture[95:130], picture[104:122, 40:58] = 255, 0
    picture[96:128, 100:140], picture[105:119, 113:127] = 0, 255
    return picture


def integral_rows(image: np.ndarray, reach: int, doubled: bool = False) -> Iterator[tuple[int, np.ndarray]]:
    """Every row at least ``reach`` from the edges, with the kept rows of the integral image as far as that below it."""
    height, width = np.array(image.shape) * (2 if doubled else 1)
    room = integral_room(width)
    for newest in range(height):
        next_integral_row(image, doubled, newest, room)
        if newest >= 2 * reach:
            yield newest - reach, room[0]


def hessian(image: np.ndarray, size: int) -> np.ndarray:
    """Determinants of a whole layer by single pixels, zero where the filter does not fit."""
    out = np.zeros(image.shape, np.float32)
    for y, integral in integral_rows(image, size // 2):
        for x in range(size // 2, image.shape[1] - size // 2):
            out[y, x] = determinant_at(integral, x, y, size)
    return out


def hessian_by_rows(image: np.ndarray, size: int) -> np.ndarray:
    """The same by whole rows."""
    out, fill = np.zeros(image.shape, np.float32), row_filter(size)
    for y, integral in integral_rows(image, size // 2):
        row = np.zeros(integral.shape[1], np.float32)
        fill(integral, y, np.empty((4, len(row)), np.uint16), row)
        out[y, size // 2 : -(size // 2)] = row[size // 2 : image.shape[1] - size // 2]
    return out


def keep_all(uv, size, response):
    return np.arange(len(uv))


def twin_hessian(image: np.ndarray, size: int) -> np.ndarray:
    """Box filters written out as kernels and applied by correlation."""
    lobe, half = size // 3, size // 2
    dxx, dxy = np.zeros((size, size)), np.zeros((size, size))
    dxx[half - lobe + 1 : half + lobe] = 1.0
    dxx[half - lobe + 1 : half + lobe, half - lobe // 2 : half + lobe // 2 + 1] = -2.0
    dxy[half - lobe : half, half - lobe : half] = dxy[half + 1 : half + 1 + lobe, half + 1 : half + 1 + lobe] = 1.0
    dxy[half - lobe : half, half + 1 : half + 1 + lobe] = dxy[half + 1 : half + 1 + lobe, half - lobe : half] = -1.0
    xx, yy, xy = (cv2.filter2D(image.astype(np.float64), -1, k / size**2) for k in (dxx, dxx.T, dxy))
    return xx * yy - (0.9 * xy) ** 2


def twin_descriptor(image: np.ndarray, u: float, v: float, scale: float, angle: float | None = None) -> np.ndarray:
    """Haar wavelets by summing pixel areas, sample by sample; turned ones are interpolated between whole steps of s."""
    weights = region_weights()
    out = np.zeros((4, 4, 8))
    for j in range(20):
        for i in range(20):
            if angle is None:
                dx, dy = twin_wavelet(image, u + 0.5 + (i - 9.5) * scale, v + 0.5 + (j - 9.5) * scale, scale)
            else:
                dx, dy = twin_turned(image, u + 0.5, v + 0.5, scale, angle, i - 9.5, j - 9.5)
            terms = np.zeros(8)
            terms[[0, 1] if dy >= 0 else [2, 3]] = dx, abs(dx)
            terms[[4, 5] if dx >= 0 else [6, 7]] = dy, abs(dy)
            out += weights[:, j, None, None] * weights[None, :, i, None] * terms
    return out.ravel() / np.linalg.norm(out)


def twin_turned(image, x, y, scale, angle, along, across) -> np.ndarray:
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    place = R @ [along, across]
    corner = np.floor(place)
    f = place - corner
    total = np.zeros(2)
    for dj, wy in ((0, 1 - f[1]), (1, f[1])):
        for di, wx in ((0, 1 - f[0]), (1, f[0])):
            node = corner + np.array([di, dj])
            total += wx * wy * np.array(twin_wavelet(image, x + node[0] * scale, y + node[1] * scale, scale))
    return R.T @ total


def twin_wavelet(image: np.ndarray, x: float, y: float, half: float) -> tuple[float, float]:
    height, width = image.shape
    if x < half or y < half or x > width - half or y > height - half:
        return 0.0, 0.0

    def cover(low: float, high: float, n: int) -> np.ndarray:
        return np.clip(np.minimum(high, np.arange(n) + 1.0) - np.maximum(low, np.arange(n)), 0.0, 1.0)

    left, right = cover(x - half, x, width), cover(x, x + half, width)
    upper, lower = cover(y - half, y, height), cover(y, y + half, height)
    return float((upper + lower) @ image @ (right - left)), float((lower - upper) @ image @ (left + right))


def test_the_integral_image_is_opencvs(image):
    np.testing.assert_array_equal(integral_image(image), cv2.integral(image))


@pytest.mark.parametrize("shape", [(130, 170), (37, 64), (3, 1), (1, 5)])
@pytest.mark.parametrize("doubled", [False, True])
def test_rows_of_the_integral_image_are_opencvs_of_the_image_or_of_it_enlarged(rng, shape, doubled):
    image = rng.integers(0, 256, shape, dtype=np.uint8)
    large = cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_LINEAR) if doubled else image
    expected = cv2.integral(large) % 2**16
    rows = [rows[(y + 1) % KEPT_ROWS].copy() for y, rows in integral_rows(image, 0, doubled)]
    np.testing.assert_array_equal(np.stack(rows)[:, : expected.shape[1]], expected[1:])


@pytest.mark.parametrize("size", FILTER_SIZES)
@pytest.mark.parametrize("picture", ["image", "squares"])
def test_hessian_equals_its_twin(request, picture, size):
    image = request.getfixturevalue(picture)
    out, half = hessian(image, size), size // 2
    inside = np.zeros_like(out, bool)
    inside[half:-half, half:-half] = True
    np.testing.assert_allclose(out[inside], twin_hessian(image, size)[inside], rtol=1e-4, atol=1e-2)
    assert not out[~inside].any()


@pytest.mark.parametrize("size", FILTER_SIZES[1:3])
@pytest.mark.parametrize("picture", ["image", "squares"])
def test_hessian_by_rows_is_that_of_the_pixels_to_the_last_bit(request, picture, size):
    image = request.getfixturevalue(picture)
    np.testing.assert_array_equal(hessian_by_rows(image, size), hessian(image, size))


def test_rows_are_not_filtered_where_sums_would_wrap_around():
    with pytest.raises(ValueError, match="27 px"):
        row_filter(FILTER_SIZES[3])


def test_octaves_are_those_that_fit_the_image():
    assert [fitting_octaves(480, side, 3) for side in (35, 36, 72, 144, 640)] == [0, 1, 2, 3, 3]


def test_the_next_octave_is_the_mean_of_four_pixels(image):
    odd = image[:-1, :-1]
    even = odd[: odd.shape[0] // 2 * 2, : odd.shape[1] // 2 * 2].astype(float)
    means = even.reshape(even.shape[0] // 2, 2, -1, 2).mean(axis=(1, 3))
    np.testing.assert_array_equal(halved(np.ascontiguousarray(odd)), np.floor(means + 0.5))


def test_octaves_meet_at_the_place_they_have_in_the_first(image):
    found, alone = np.empty((5000, 4), np.float32), np.empty((5000, 4), np.float32)
    first, both = (find_keypoints(image, False, n, np.float32(5.0), found) for n in (1, 2))
    n = find_maxima(halved(image), False, np.float32(5.0), alone)
    assert both == first + n
    np.testing.assert_allclose(found[first:both, :2], 2.0 * alone[:n, :2] + 0.5)  # centres of pixels twice as large
    np.testing.assert_allclose(found[first:both, 2:], alone[:n, 2:] * [2.0, 1.0])


def test_an_image_is_searched_enlarged_and_then_as_it_is(image):
    found, alone = np.empty((5000, 4), np.float32), np.empty((5000, 4), np.float32)
    large = cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_LINEAR)
    both = find_keypoints(image, True, 2, np.float32(5.0), found)
    first = find_maxima(large, False, np.float32(5.0), alone)
    second = find_maxima(image, False, np.float32(5.0), alone[first:])
    assert min(first, second) > 5
    assert both == first + second
    np.testing.assert_allclose(found[:first], alone[:first], rtol=1e-6)
    np.testing.assert_array_equal(found[first:both, 3], alone[first:both, 3])


def test_maxima_are_those_of_an_exhaustive_search(image):
    threshold = np.float32(5.0)
    found = np.empty((5000, 4), np.float32)
    n = find_maxima(image, False, threshold, found)
    height, width = image.shape
    layers = np.stack([hessian(image, size) for size in FILTER_SIZES])
    expected, border = set(), FILTER_SIZES[3] // 2 + 4
    for k in (1, 2):
        for y in range(border, height - border):
            for x in range(border, width - border):
                cube = layers[k - 1 : k + 2, y - 1 : y + 2, x - 1 : x + 2]
                if layers[k, y, x] > threshold and (cube >= layers[k, y, x]).sum() == 1:
                    expected.add((x, y, layers[k, y, x]))
    low, high = border + 0.6, np.array([width, height]) - border - 1.6
    inner = [f for f in found[:n] if np.all(f[:2] >= low) and np.all(f[:2] <= high)]
    assert len(inner) > 10
    for u, v, _, response in inner:
        assert any(abs(u - x) <= 0.6 and abs(v - y) <= 0.6 and response == r for x, y, r in expected)
    # Those whose parabola has its vertex elsewhere are left out.
    assert 0.8 * len(expected) < n


def test_a_gaussian_blob_is_found_at_its_place_and_scale():
    u, v = np.meshgrid(np.arange(200.0), np.arange(160.0))
    for sigma in (3.0, 4.0, 8.0):
        blob = (200 * np.exp(-((u - 93.3) ** 2 + (v - 80.6) ** 2) / (2 * sigma**2))).astype(np.uint8)
        keypoints = SurfDetector()(blob, 1.0, keep_all)
        best = keypoints.select(np.argmax(keypoints.response)[None])
        np.testing.assert_allclose(best.uv[0], [93.3, 80.6], atol=0.25)
        assert best.size[0] * 1.2 / 9.0 == pytest.approx(0.72 * sigma, rel=0.06)


@pytest.mark.parametrize("keypoint", [(81.37, 61.71, 1.63), (70.0, 60.0, 2.9), (20.4, 100.2, 2.2), (165.0, 3.0, 1.3)])
def test_upright_descriptor_equals_its_twin(image, keypoint):
    out = np.empty((1, 128), np.float32)
    describe_upright(integral_image(image), np.array([keypoint]), region_weights(), out)
    np.testing.assert_allclose(out[0], twin_descriptor(image, *keypoint), atol=2e-6)


@pytest.mark.parametrize("place", [(80.3, 61.7, 2.1), (14.2, 98.9, 2.3), (150.0, 9.0, 1.4)])
def test_oriented_descriptor_equals_its_twin(image, place):
    keypoint = np.array(place)
    out = np.empty((1, 128), np.float32)
    describe_oriented(integral_image(image), keypoint[None], region_weights(), out)
    angle = orientation(integral_image(image), keypoint)
    np.testing.assert_allclose(out[0], twin_descriptor(image, *keypoint, angle), atol=2e-6)


def twin_pair_descriptor(image: np.ndarray, u: float, v: float, scale: float) -> np.ndarray:
    """Sample by sample; wavelets that reach beyond the image are zero."""
    weights, out, middle = region_weights(SAMPLES, WEIGHT_SIGMA), np.zeros((4, 4, 8)), 0.5 * (SAMPLES - 1)
    for j in range(SAMPLES):
        for i in range(SAMPLES):
            x, y = u + 0.5 + (i - middle) * STEP * scale, v + 0.5 + (j - middle) * STEP * scale
            dx, dy = twin_wavelet(image, x, y, STEP * scale)
            terms = np.zeros(8)
            terms[[0, 1] if dy >= 0 else [2, 3]] = dx, abs(dx)
            terms[[4, 5] if dx >= 0 else [6, 7]] = dy, abs(dy)
            out += weights[:, j, None, None] * weights[None, :, i, None] * terms
    return out.ravel() / np.linalg.norm(out)


@pytest.mark.parametrize("number", [1, LANES, LANES + 5])
def test_pair_descriptors_equal_their_twins_within_the_image_and_at_its_edges(image, number):
    places = np.random.default_rng(number).uniform([3, 3, 1.2], [167, 127, 3.0], (number, 3))
    out = np.empty((number, 128), np.float32)
    describe_for_pair(integral_image(image), places, region_weights(SAMPLES, WEIGHT_SIGMA), out)
    np.testing.assert_allclose(out, [twin_pair_descriptor(image, *place) for place in places], atol=2e-6)


def test_a_detector_for_pairs_finds_the_same_and_describes_it_for_other_moments_when_asked(image):
    plain, for_pairs = (SurfDetector(for_pairs=only) for only in (False, True))
    described, brief = (detector(image, 0.3, keep_all) for detector in (plain, for_pairs))
    assert len(described) > 5
    np.testing.assert_array_equal(brief.uv, described.uv)
    assert not np.allclose(brief.descriptors, described.descriptors, atol=0.1)
    later = for_pairs.describe(image, brief)
    np.testing.assert_allclose(later.descriptors, described.descriptors, atol=1e-4)


def test_orientation_follows_a_turned_image(image):
    turned = np.ascontiguousarray(np.rot90(image, -1))
    keypoint = np.array([80.0, 61.0, 2.1])
    in_turned = np.array([image.shape[0] - 1 - keypoint[1], keypoint[0], keypoint[2]])
    difference = orientation(integral_image(turned), in_turned) - orientation(integral_image(image), keypoint)
    assert (difference - np.pi / 2 + np.pi) % (2 * np.pi) - np.pi == pytest.approx(0.0, abs=1e-6)
    out = np.empty((2, 128), np.float32)
    describe_oriented(integral_image(image), keypoint[None], region_weights(), out[:1])
    describe_oriented(integral_image(turned), in_turned[None], region_weights(), out[1:])
    np.testing.assert_allclose(out[0], out[1], atol=1e-5)


def test_brightness_and_contrast_do_not_matter(image):
    darker = (0.5 * image + 20).astype(np.uint8)
    points = np.array([[80.0, 61.0, 2.0], [60.0, 70.0, 3.0]])
    out = np.empty((2, 2, 128), np.float32)
    for k, picture in enumerate((image, darker)):
        describe_upright(integral_image(picture), points, region_weights(), out[k])
    assert np.all(np.sum(out[0] * out[1], axis=1) > 0.995)


@pytest.mark.parametrize(
    "picture", [np.zeros((100, 120), np.uint8), np.full((100, 120), 255, np.uint8), np.zeros((5, 7), np.uint8)]
)
@pytest.mark.parametrize("upright", [True, False])
def test_flat_and_tiny_images_have_no_keypoints(picture, upright):
    assert len(SurfDetector(SurfConfig(upright=upright))(picture, 0.02, keep_all)) == 0


def test_images_beyond_the_integral_image_are_refused():
    with pytest.raises(ValueError, match="at most"):
        SurfDetector()(np.broadcast_to(np.uint8(0), (4000, 4000)), 1.0, keep_all)


@pytest.mark.parametrize("upright", [True, False])
def test_surf_64_adds_up_what_surf_128_splits_by_sign(image, upright):
    long, short = (
        SurfDetector(SurfConfig(upright=upright, extended=extended))(image, 0.3, keep_all).descriptors
        for extended in (True, False)
    )
    assert short.shape == (len(long), 64)
    assert len(long) > 5
    terms = long.reshape(len(long), 16, 8).astype(float)
    expected = (terms[..., [0, 1, 4, 5]] + terms[..., [2, 3, 6, 7]]).reshape(-1, 64)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(short, expected, atol=1e-6)
