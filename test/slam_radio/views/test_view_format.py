# SPDX-License-Identifier: Apache-2.0
"""Views byte by byte: what comes back, what is refused, and depth whose standard deviation covers the rounding."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from slam_core.geometry import boxplus
from slam_radio.packing.light_submap import ENVELOPE, sealed
from slam_radio.views.depth_code import FARTHEST_M, depth_levels, depth_of_levels
from slam_radio.views.view_format import DENSE, MAGIC, PICTURE, VERSION, PlacedImage, pack_view, rgb_of, unpack_view
from slam_radio.views.view_taker import encoded
from slam_radio.wire.view_messages import (
    Lack,
    ViewKey,
    pack_look,
    pack_piece,
    pack_unseen,
    pieces_of,
    unpack_look,
    unpack_piece,
    unpack_unseen,
)

T = boxplus(np.eye(4), np.array([1.0, -2.0, 0.5, 0.3, -0.2, 1.0]))
JPEG_HEIGHT_AT = 5
"""Bytes from a frame header's marker to the height."""


def depth_image(rng, height=30, width=40):
    depth = rng.uniform(0.15, 15.0, (height, width)).astype(np.float32)
    sigma = rng.uniform(2e-4, 0.1, (height, width)).astype(np.float32)
    depth[0, :5] = [np.nan, 0.0, 0.05, FARTHEST_M * 1.01, np.inf]
    sigma[1, :3] = [np.nan, 0.0, -1.0]
    return depth, sigma


def made(rng, kind=DENSE):
    jpeg = encoded(rng.integers(0, 256, (30, 40, 3), dtype=np.uint8), 50)
    view = PlacedImage(3, 7, 5 * 10**9, 4 * 10**9, T, (40, 30), (33.0, 34.0, 19.5, 14.5), jpeg)
    if kind == PICTURE:
        return view
    depth, steps = depth_levels(*depth_image(rng))
    return replace(view, depth=depth, steps=steps)


@pytest.mark.parametrize("kind", [PICTURE, DENSE])
def test_a_view_comes_back(rng, kind):
    view = made(rng, kind)
    found = unpack_view(pack_view(view))
    assert found.kind == kind
    np.testing.assert_allclose(found.T_start_camera, view.T_start_camera, atol=1e-6)
    for name in ("session", "index", "stamp_ns", "start_stamp_ns", "size", "intrinsics", "jpeg"):
        assert getattr(found, name) == getattr(view, name)
    if kind == DENSE:
        np.testing.assert_array_equal(found.depth, view.depth)
        np.testing.assert_array_equal(found.steps, view.steps)
    assert rgb_of(found.jpeg).shape == (30, 40, 3)


def test_depth_is_within_a_quarter_per_cent_and_its_sigma_covers_the_rounding(rng):
    depth, sigma = depth_image(rng, 100, 120)
    found, claimed = depth_of_levels(*depth_levels(depth, sigma))
    bad = np.isnan(found)
    assert np.flatnonzero(bad).tolist() == [0, 1, 2, 3, 4, 120, 121, 122]
    error = np.abs(found - depth)[~bad]
    assert (error <= 0.00251 * depth[~bad]).all()
    least = np.hypot(sigma[~bad].astype(np.float64), error)
    assert (claimed[~bad] >= 0.99999 * least).all()
    assert np.median(claimed[~bad] / least) < 1.15


def test_damage_is_refused(rng):
    for kind in (PICTURE, DENSE):
        data = pack_view(made(rng, kind))
        for _ in range(100):
            spoilt = bytearray(data)
            spoilt[rng.integers(len(data))] ^= int(rng.integers(1, 256))
            with pytest.raises(ValueError, match=r"."):
                unpack_view(bytes(spoilt))
        with pytest.raises(ValueError, match="view"):
            unpack_view(data[: rng.integers(len(data))])


def forged(view: PlacedImage, at: int, form: str, *numbers) -> bytes:
    rest = bytearray(pack_view(view)[ENVELOPE.size :])
    struct.pack_into(form, rest, at, *numbers)
    return sealed(MAGIC, VERSION, bytes(rest))


def test_what_cannot_be_is_refused_although_the_checksum_fits(rng):
    view = made(rng)
    head = struct.calcsize("<BIIqq6f")
    cases = [
        (0, "<B", (3,), "kind 3"),
        (9, "<q", (-1,), "cannot be"),
        (25, "<f", (np.nan,), "not finite"),
        (25, "<f", (1e6,), "pose"),
        (head, "<HH", (41, 30), "not a JPEG of 41 x 30"),
        (head, "<HH", (0, 30), "0 x 30 px"),
        (head + 4, "<f", (0.0,), "focal lengths"),
        (head + 20, "<I", (2**31,), "ends too early"),
    ]
    for at, form, numbers, text in cases:
        with pytest.raises(ValueError, match=text):
            unpack_view(forged(view, at, form, *numbers))
    frame = view.jpeg.index(b"\xff\xc0")
    huge = bytearray(view.jpeg)
    struct.pack_into(">HH", huge, frame + JPEG_HEIGHT_AT, 60000, 60000)
    with pytest.raises(ValueError, match="not a JPEG"):
        unpack_view(pack_view(replace(view, jpeg=bytes(huge))))
    with pytest.raises(ValueError, match="2049 x 30 px"):
        pack_view(replace(view, size=(2049, 30)))
    with pytest.raises(ValueError, match="not a grey PNG"):
        unpack_view(pack_view(replace(view, jpeg=b"", size=(41, 30))))
    steps = view.steps.copy()
    steps[10, 10] = 0
    with pytest.raises(ValueError, match="levels"):
        unpack_view(pack_view(replace(view, steps=steps)))


@pytest.mark.parametrize("marker", [0x01, 0xD0, 0xD7, 0xFF])
def test_a_jpeg_that_hides_its_size_behind_a_marker_without_length_is_not_decoded(rng, monkeypatch, marker):
    view = made(rng, PICTURE)
    at = view.jpeg.index(b"\xff\xc0")
    frame = view.jpeg[at : at + 20]
    huge = bytearray(frame)
    struct.pack_into(">HH", huge, JPEG_HEIGHT_AT, 16000, 16000)
    hidden = bytes([0xFF, 0xD8, 0xFF, marker]) + bytes(huge)[marker == 0xFF :]  # 0xFF before a marker is a filling
    skipped = 4 + int.from_bytes(hidden[4:6], "big")
    hidden = hidden.ljust(skipped, b"\0") + frame

    def decode(_):
        raise AssertionError("decoded")

    monkeypatch.setattr("slam_radio.views.view_format.rgb_of", decode)
    with pytest.raises(ValueError, match="not a JPEG of 40 x 30"):
        unpack_view(pack_view(replace(view, jpeg=hidden)))


def test_a_dense_key_frame_may_have_no_picture_and_a_picture_no_camera(rng):
    assert unpack_view(pack_view(replace(made(rng), jpeg=b""))).jpeg == b""
    unknown = replace(made(rng, PICTURE), intrinsics=(0.0, 0.0, 0.0, 0.0))
    assert unpack_view(pack_view(unknown)).intrinsics == (0.0, 0.0, 0.0, 0.0)


def test_forged_views_are_refused_or_have_finite_numbers(rng):
    view = made(rng)
    data = pack_view(view)[ENVELOPE.size :]
    refused = 0
    for _ in range(200):
        rest = bytearray(data)
        for at in rng.integers(len(rest), size=3):
            rest[at] = int(rng.integers(256))
        try:
            found = unpack_view(sealed(MAGIC, VERSION, bytes(rest)))
        except ValueError:
            refused += 1
        else:
            assert np.isfinite(found.T_start_camera).all()
            assert found.depth.shape == found.steps.shape == found.size[::-1]
    assert refused > 50


def test_small_messages_come_back_and_damaged_ones_are_refused(rng):
    key = ViewKey(PICTURE, 4, 10**18)
    lacks = [Lack(key, 3, 2**63 + 1), Lack(key._replace(kind=DENSE))]
    piece = pieces_of(key, 7, bytes(rng.integers(0, 256, 2500, dtype=np.uint8)))[2]
    assert len(pack_piece(piece)) == 36 + 500
    cases = [
        (pack_look(lacks), unpack_look, lacks),
        (pack_look([]), unpack_look, []),
        (pack_unseen([key]), unpack_unseen, [key]),
        (pack_piece(piece), unpack_piece, piece),
    ]
    for data, unpack, value in cases:
        assert unpack(data) == value
        for _ in range(100):
            spoilt = bytearray(data)
            spoilt[rng.integers(len(data))] ^= int(rng.integers(1, 256))
            with pytest.raises(ValueError, match=r"."):
                unpack(bytes(spoilt))
        with pytest.raises(ValueError, match=r"."):
            unpack(data[:-1])
    for wrong in (replace(piece, number=3), replace(piece, number=0), replace(piece, count=5000, number=4999)):
        with pytest.raises(ValueError, match="cannot be"):
            unpack_piece(pack_piece(wrong))
    with pytest.raises(ValueError, match="kind 3"):
        unpack_unseen(pack_unseen([key._replace(kind=3)]))
