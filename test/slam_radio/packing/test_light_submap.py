# SPDX-License-Identifier: Apache-2.0
"""A submap for the air comes out as it went in but for what is left out; a damaged one is refused."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from slam_core.geometry import boxminus
from slam_radio.packing.descriptor_code import DIRECTIONS, basis, decode, encode
from slam_radio.packing.landmark_choice import choose_landmarks, rank_values
from slam_radio.packing.light_submap import LightConfig, lightened, pack, unpack, write
from slam_radio.packing.packing_kernels import crowded


def test_what_is_sent_comes_out(make_submap):
    submap = make_submap(60)
    light = unpack(pack(submap, LightConfig(landmarks=60)))
    order = np.argsort(submap.landmark_ids)
    for name in ("agent", "index", "session", "start_stamp_ns", "end_stamp_ns", "follows_previous"):
        assert getattr(light, name) == getattr(submap, name)
    np.testing.assert_array_equal(light.landmark_ids, submap.landmark_ids[order])
    own = submap.covariance[6:, 6:].reshape(60, 3, 60, 3)[np.arange(60), :, np.arange(60), :]
    quarter = 0.25 * np.median(np.sqrt(np.linalg.eigvalsh(own)[:, 0]))
    np.testing.assert_allclose(light.landmarks, submap.landmarks[order], atol=quarter)
    np.testing.assert_array_equal(light.sightings, np.minimum(submap.sightings[order], 255))
    np.testing.assert_allclose(boxminus(light.end_pose, submap.end_pose), 0.0, atol=1e-6)
    assert np.einsum("nd,nd->n", light.descriptors, submap.descriptors[order]).min() > 0.99  # random: sent whole


def test_it_is_not_surer_than_the_submap(make_submap):
    submap = make_submap(80, common=9)
    light = unpack(pack(submap, LightConfig(landmarks=40, rank=4)))
    rows = np.array([int(np.nonzero(submap.landmark_ids == i)[0][0]) for i in light.landmark_ids])
    unknowns = np.concatenate([np.arange(6), (6 + 3 * rows[:, None] + np.arange(3)).ravel()])
    L = np.linalg.inv(np.linalg.cholesky(light.covariance))
    assert np.linalg.eigvalsh(L @ submap.covariance[np.ix_(unknowns, unknowns)] @ L.T)[-1] <= 1.0
    for own, sent in zip(submap.path, light.path, strict=True):
        assert own.stamp_ns == sent.stamp_ns
        assert np.linalg.eigvalsh(sent.covariance - own.covariance)[0] > -1e-12


def test_same_submap_same_bytes_of_the_promised_size(make_submap, rng):
    looks = rng.normal(size=(200, DIRECTIONS)) @ basis().T
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    submap = replace(make_submap(200), descriptors=looks.astype(np.float32))
    data = pack(submap, LightConfig(landmarks=96))
    assert data == pack(submap, LightConfig(landmarks=96))
    assert len(data) < 5000


def test_descriptors_of_the_basis_take_its_bytes_and_keep_their_likeness(rng):
    inside = rng.normal(size=(50, DIRECTIONS)) @ basis().T
    inside = (inside / np.linalg.norm(inside, axis=1, keepdims=True)).astype(np.float32)
    codes = encode(inside)
    assert codes.shape == (50, DIRECTIONS)
    np.testing.assert_allclose(decode(codes, 128) @ decode(codes, 128).T, inside @ inside.T, atol=0.1)
    along = decode(codes, 128) @ basis()
    assert np.einsum("nd,nd->n", along / np.linalg.norm(along, axis=1, keepdims=True), inside @ basis()).min() > 0.97
    other = rng.normal(size=(50, 128)).astype(np.float32)
    assert encode(other / np.linalg.norm(other, axis=1, keepdims=True)).shape == (50, 128)
    assert encode(np.eye(64, dtype=np.float32)).shape == (64, 64)


def test_what_is_left_out_makes_no_two_landmarks_more_alike(rng):
    """8 % of the squares of descriptors are left out: stretched to unit length, others would be 0.05 more alike."""
    centre = 3.0 * np.eye(DIRECTIONS)[0]
    whole = rng.normal(size=(100, DIRECTIONS)) @ basis().T + centre @ basis().T
    whole /= np.linalg.norm(whole, axis=1, keepdims=True)
    beyond = rng.normal(size=whole.shape)
    beyond -= beyond @ basis() @ basis().T
    whole = np.sqrt(0.92) * whole + np.sqrt(0.08) * beyond / np.linalg.norm(beyond, axis=1, keepdims=True)
    again = whole + 0.01 * rng.normal(size=whole.shape)
    again /= np.linalg.norm(again, axis=1, keepdims=True)
    found, found_again = (decode(encode(d.astype(np.float32)), 128) for d in (whole, again))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-5)
    apart = ~np.eye(100, dtype=bool)
    assert abs(np.mean((found @ found_again.T - whole @ again.T)[apart])) < 0.01
    assert np.median(np.diag(found @ found_again.T)) > 0.96


def test_descriptors_that_are_not_as_wide_as_they_say_are_refused(make_submap):
    light = lightened(make_submap(12), LightConfig(landmarks=12))
    assert light.landmarks.codes.shape == (12, 128)
    for dimension in (DIRECTIONS, 64, 127):
        with pytest.raises(ValueError, match=f"descriptors of {dimension} numbers, of which it sends 128"):
            unpack(write(replace(light, dimension=dimension)))


def test_ids_of_a_long_run_cost_no_more(make_submap):
    submap = make_submap(60)
    late = replace(submap, landmark_ids=submap.landmark_ids + 2**29)
    assert len(pack(late)) <= len(pack(submap)) + 4
    np.testing.assert_array_equal(unpack(pack(late)).landmark_ids, np.sort(late.landmark_ids))


def test_a_path_that_begins_and_ends_elsewhere_is_sent_whole(make_submap):
    submap = make_submap(12)
    sent = unpack(pack(replace(submap, path=submap.path[1:2]))).path
    assert [p.stamp_ns for p in sent] == [submap.path[1].stamp_ns]
    np.testing.assert_allclose(boxminus(sent[0].T, submap.path[1].T), 0.0, atol=1e-6)


def test_a_pose_between_has_its_own_covariance_not_one_shaped_as_the_ends(make_submap):
    """How it errs in rotation and in position says how a closure moves it."""
    submap = make_submap(12)
    own = np.diag(np.square([0.003, 0.002, 0.001, 0.02, 0.01, 0.03]))
    path = (submap.path[0], replace(submap.path[1], covariance=own), submap.path[2])
    sent = unpack(pack(replace(submap, path=path))).path[1].covariance
    np.testing.assert_allclose(np.diag(sent), np.diag(own), rtol=0.003)
    assert (np.diag(sent) >= np.diag(own)).all()


def test_the_basis_is_orthonormal():
    np.testing.assert_allclose(basis().T @ basis(), np.eye(DIRECTIONS), atol=1e-5)


def test_two_submaps_of_one_place_send_the_same_landmarks(make_submap, rng):
    """Half of each one's landmarks would leave a quarter of the common ones if the choices did not agree."""
    first, second = make_submap(200, seed=1), make_submap(200, seed=2)
    noise = 0.02 * rng.normal(size=first.descriptors.shape)
    seen_again = (first.descriptors + noise).astype(np.float32)
    second = replace(second, descriptors=seen_again / np.linalg.norm(seen_again, axis=1, keepdims=True))
    common = np.intersect1d(*(first_ids(s, choose_landmarks(s, 100)) for s in (first, second)))
    assert len(common) > 70


def first_ids(submap, rows):
    assert len(rows) == len(np.unique(rows)) == 100
    assert (np.diff(submap.landmark_ids[rows]) > 0).all()
    return np.sort(rows)


def test_a_landmark_beside_another_one_comes_last(make_submap):
    submap = make_submap(60)
    points = submap.landmarks.copy()
    best = int(np.argmax(rank_values(submap.descriptors)))
    beside = int(np.argsort(rank_values(submap.descriptors))[-2])
    points[beside] = points[best] + 0.001
    rows = choose_landmarks(replace(submap, landmarks=points), 40)
    assert best in rows
    assert beside not in rows
    assert beside in choose_landmarks(submap, 40)
    assert len(choose_landmarks(replace(submap, landmarks=np.tile(points[:1], (60, 1))), 40)) == 40


def test_points_beside_others_are_those_that_a_tree_finds(rng):
    points = rng.uniform(-1.0, 1.0, size=(200, 3))
    reach = rng.uniform(0.1, 0.5, size=200)
    expected = np.zeros(200, dtype=bool)
    for k, near in enumerate(cKDTree(points).query_ball_point(points, reach)):
        expected[k] = any(other < k and not expected[other] for other in near)
    assert 50 < expected.sum() < 190
    np.testing.assert_array_equal(crowded(points, reach), expected)


def test_damaged_messages_are_refused(make_submap, rng):
    data = pack(make_submap(30), LightConfig(landmarks=30))
    for _ in range(500):
        damaged = bytearray(data)
        damaged[rng.integers(len(data))] ^= int(rng.integers(1, 256))
        with pytest.raises(ValueError, match=r"."):
            unpack(bytes(damaged))
    for length in rng.integers(0, len(data), 50).tolist():
        with pytest.raises(ValueError, match=r"."):
            unpack(data[:length])


def test_forged_messages_with_a_good_checksum_are_refused_or_a_submap(make_submap, rng):
    rest = pack(make_submap(12), LightConfig(landmarks=12))[7:]
    refused = 0
    for _ in range(500):
        forged = bytearray(rest)
        forged[rng.integers(len(forged))] = int(rng.integers(256))
        forged[rng.integers(90)] = int(rng.integers(256))  # among counts, stamps and end pose
        try:
            light = unpack(struct.pack("<2sBI", b"SL", 4, zlib.crc32(forged)) + forged)
        except ValueError:
            refused += 1
        else:
            np.linalg.cholesky(light.covariance)
            assert np.isfinite(light.landmarks).all()
    assert 50 < refused < 500


def test_a_message_of_more_landmarks_than_can_be_is_refused(make_submap):
    rest = bytearray(pack(make_submap(12, agent="one"), LightConfig(landmarks=12))[7:])
    at = 1 + 3 + 9 + 16
    assert struct.unpack_from("<H", rest, at)[0] == 12
    struct.pack_into("<H", rest, at, 60000)
    with pytest.raises(ValueError, match="cannot have 60000 landmarks"):
        unpack(struct.pack("<2sBI", b"SL", 4, zlib.crc32(rest)) + rest)


def test_an_older_version_is_refused_by_name(make_submap):
    data = bytearray(pack(make_submap(12)))
    data[2] = 2
    with pytest.raises(ValueError, match="not a submap for the air of version 4"):
        unpack(bytes(data))
