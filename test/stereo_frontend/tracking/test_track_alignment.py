# SPDX-License-Identifier: Apache-2.0
"""Patches of a key frame are found under an affine warp, with honest standard deviations."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_frontend.tracking.track_alignment import OUTPUTS, align_to_references

RADIUS = 7
NOISE = 2.0


def texture(rng: np.random.Generator, A: np.ndarray, shift: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """Picture (400, 400) of the same waves in every call, with noise, in which x has moved to ``A x + shift``."""
    waves = np.random.default_rng(0)
    v, u = np.mgrid[0:400, 0:400].astype(float)
    x, y = np.linalg.inv(A) @ (np.stack([u.ravel(), v.ravel()]) - shift[:, None])
    grey = np.full(x.shape, 128.0)
    for frequency in waves.normal(0.0, 0.25, (60, 2)):
        grey += 6.0 * np.cos(frequency[0] * x + frequency[1] * y + waves.uniform(0.0, 6.28))
    noisy = gain * grey + rng.normal(0.0, NOISE, x.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8).reshape(u.shape)


def references(picture: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corner = np.round(uv).astype(int)
    reach = np.arange(-RADIUS - 1, RADIUS + 2)
    return picture[corner[:, 1, None, None] + reach[:, None], corner[:, 0, None, None] + reach], uv - corner


@pytest.mark.parametrize(
    ("A", "gain"),
    [
        (np.eye(2), 1.0),
        (np.eye(2) * 1.15, 1.0),
        (np.array([[0.95, -0.15], [0.15, 0.95]]), 0.8),
        (np.array([[1.0, 0.1], [0.0, 0.85]]), 1.1),
    ],
)
def test_places_are_found_without_bias_and_as_exactly_as_claimed(A: np.ndarray, gain: float) -> None:
    rng = np.random.default_rng(1)
    uv = rng.uniform(60.0, 340.0, (300, 2))
    centre = np.array([200.0, 200.0])
    shift = centre - A @ centre + [3.3, -2.7]
    first = texture(rng, np.eye(2), np.zeros(2))
    true = uv @ A.T + shift
    windows, offset = references(first, uv)
    out = np.full((len(uv), OUTPUTS), np.nan)
    start = true + rng.uniform(-1.0, 1.0, true.shape)
    near = np.tile((A + rng.normal(0.0, 0.02, (2, 2))).ravel(), (len(uv), 1))
    align_to_references(texture(rng, A, shift, gain), windows, offset, start, near, 4.0, 400.0, out)
    found = np.isfinite(out[:, 0])
    assert found.mean() > 0.95
    error = (out[:, :2] - true)[found]
    assert np.abs(np.median(error, axis=0)).max() < 0.01
    assert np.abs(np.median(out[found, 2:6], axis=0) - A.ravel()).max() < 0.02
    nees = np.mean(error**2 / out[found, 6:8], axis=0)
    assert (nees > 0.5).all()
    assert (nees < 2.0).all()
    assert np.median(out[found, 8]) > 0.97


def test_a_flat_patch_and_one_at_the_border_are_not_found() -> None:
    rng = np.random.default_rng(2)
    picture = texture(rng, np.eye(2), np.zeros(2))[:100, :100].copy()
    uv = np.array([[50.0, 50.0], [12.0, 50.0], [70.0, 50.0]])
    windows, offset = references(picture, uv)
    windows[2] = 90
    start = np.array([[50.5, 50.0], [5.0, 50.0], [70.0, 50.0]])
    out = np.full((3, OUTPUTS), np.nan)
    align_to_references(picture, windows, offset, start, np.tile(np.eye(2).ravel(), (3, 1)), 4.0, 400.0, out)
    assert np.abs(out[0, :2] - uv[0]).max() < 0.01
    assert np.isnan(out[1:]).all()
