# SPDX-License-Identifier: Apache-2.0
"""Every conversion there and back over real CDR bytes, and every contradiction named."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from slam_bags.storage.bag_types import BagTypes, typestore
from slam_core import messages as m
from slam_core.camera import Camera, CameraInfo
from slam_core.geometry import boxplus
from slam_core.types import DepthImage, Features, ImuSample, PoseEstimate, RelativeMotion, Submap

TYPES = BagTypes()
STAMP = 1_403_715_273_262_142_976
CAMERA = Camera(8, 6, 50.0, 51.0, 3.5, 2.5)


def over_the_wire(message: Any) -> Any:
    """The message as a reader of its bytes sees it."""
    name = message.__msgtype__
    return typestore().deserialize_cdr(bytes(typestore().serialize_cdr(message, name)), name)


def header(stamp: int = STAMP, frame: str = "frame") -> Any:
    return m.header_message(TYPES, stamp, frame)


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return boxplus(np.eye(4), rng.normal(size=6))


def random_covariance(rng: np.random.Generator, n: int = 6) -> np.ndarray:
    A = rng.normal(size=(n, n))
    return A @ A.T + np.eye(n)


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_are_exact(stamp: int) -> None:
    assert m.stamp_ns(over_the_wire(header_only(stamp))) == stamp


def header_only(stamp: int) -> Any:
    return TYPES.PoseStamped(header=header(stamp))


@pytest.mark.parametrize(
    ("encoding", "dtype", "channels"),
    [("mono8", "u1", 1), ("bgr8", "u1", 3), ("rgb8", "u1", 3), ("bgra8", "u1", 4), ("16UC1", "u2", 1),
     ("8SC1", "i1", 1), ("32FC1", "f4", 1), ("64FC1", "f8", 1)],
)  # fmt: skip
@settings(max_examples=20)
@given(data=st.data())
def test_images_survive(encoding: str, dtype: str, channels: int, data: st.DataObject) -> None:
    size = data.draw(st.tuples(st.integers(0, 7), st.integers(1, 9)))
    shape = size if channels == 1 else (*size, channels)
    image = data.draw(hnp.arrays(np.dtype(dtype), shape))
    message = over_the_wire(m.image_message(TYPES, header(), image, encoding))
    np.testing.assert_array_equal(m.image_from_message(message), image)
    assert message.encoding == encoding
    assert m.stamp_ns(message) == STAMP


def test_image_rows_may_be_padded_and_big_endian() -> None:
    image = np.arange(6, dtype=">u2").reshape(2, 3)
    padded = np.zeros((2, 10), np.uint8)
    padded[:, :6] = image.view(np.uint8)
    message = TYPES.Image(
        header=header(), height=2, width=3, encoding="16UC1", is_bigendian=1, step=10, data=padded.ravel()
    )
    np.testing.assert_array_equal(m.image_from_message(over_the_wire(message)), image.astype(np.uint16))


@pytest.mark.parametrize(
    ("change", "text"),
    [({"encoding": "nv21"}, "encoding 'nv21'"), ({"step": 4}, "step is 4"), ({"height": 9}, "truncated")],
)
def test_image_contradictions_are_named(change: dict[str, Any], text: str) -> None:
    message = m.image_message(TYPES, header(), np.zeros((6, 8), np.uint8))
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(ValueError, match=text):
        m.image_from_message(message)


def test_image_encoding_must_fit_the_array() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        m.image_message(TYPES, header(), np.zeros((4, 4), np.uint8), "16UC1")


def test_grey_of_colour_is_opencvs_and_of_sixteen_bits_is_refused(rng: np.random.Generator) -> None:
    colour = rng.integers(0, 256, (5, 4, 3), dtype=np.uint8)
    for encoding, conversion in (("bgr8", cv2.COLOR_BGR2GRAY), ("rgb8", cv2.COLOR_RGB2GRAY)):
        grey = m.grey_from_message(m.image_message(TYPES, header(), colour, encoding))
        np.testing.assert_array_equal(grey, cv2.cvtColor(colour, conversion))
    deep = m.image_message(TYPES, header(), np.full((3, 3), 0x7FFF, np.uint16), "mono16")
    assert (m.grey_from_message(deep) == 0x7F).all()
    with pytest.raises(ValueError, match="8 or 16 bits"):
        m.grey_from_message(m.image_message(TYPES, header(), np.zeros((3, 3), np.float32)))


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_pattern_becomes_the_grey_of_its_colour(pattern: str) -> None:
    colour = {"r": 40, "g": 100, "b": 220}
    mosaic = np.tile(np.array([colour[c] for c in pattern], np.uint8).reshape(2, 2), (6, 8))
    grey = m.grey_from_message(m.image_message(TYPES, header(), mosaic, f"bayer_{pattern}8"))
    assert abs(float(grey[4, 4]) - (0.299 * 40 + 0.587 * 100 + 0.114 * 220)) < 1.5


def test_a_camera_in_colour_gives_grey_and_colours_a_grey_one_grey_alone(rng: np.random.Generator) -> None:
    colour = rng.integers(0, 256, (4, 6, 3), dtype=np.uint8)
    for encoding, image in (("rgb8", colour), ("bgr8", colour[..., ::-1])):
        grey, kept = m.grey_and_colour_from_message(m.image_message(TYPES, header(), image, encoding))
        np.testing.assert_array_equal(kept(), colour)
        np.testing.assert_array_equal(grey, cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY))
    assert m.grey_and_colour_from_message(m.image_message(TYPES, header(), colour[..., 0]))[1]() is None


def test_pictures_beside_depth_keep_their_values_and_colours_become_grey(rng: np.random.Generator) -> None:
    amplitude = rng.random((4, 5)).astype(np.float32)
    np.testing.assert_array_equal(m.picture_from_message(m.image_message(TYPES, header(), amplitude)), amplitude)
    colour = rng.integers(0, 256, (4, 5, 3), dtype=np.uint8)
    grey = m.picture_from_message(m.image_message(TYPES, header(), colour, "rgb8"))
    np.testing.assert_array_equal(grey, cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY))


def test_yuv_images_hold_their_grey() -> None:
    image = np.arange(96, dtype=np.uint8).reshape(6, 8, 2)
    for encoding, channel in (("yuv422", 1), ("uyvy", 1), ("yuyv", 0), ("yuv422_yuy2", 0)):
        grey = m.grey_from_message(m.image_message(TYPES, header(), image, encoding))
        np.testing.assert_array_equal(grey, image[..., channel])


def test_compressed_images_decode(rng: np.random.Generator) -> None:
    image = rng.integers(0, 256, (12, 16), dtype=np.uint8)
    png = cv2.imencode(".png", image)[1].tobytes()
    message = over_the_wire(m.compressed_image_message(TYPES, header(), png, "png"))
    np.testing.assert_array_equal(m.grey_from_message(message), image)
    message.data = message.data[:20]
    with pytest.raises(ValueError, match="cannot be decoded"):
        m.image_from_message(message)


def test_compressed_depth_in_metres_inverts_the_quantiser() -> None:
    depth = np.array([[1.0, 2.5], [4.0, np.nan]], np.float32)
    a, b = 100.0, 10.0
    quantised = np.where(np.isfinite(depth), a / np.nan_to_num(depth, nan=1.0) + b, 0).round().astype(np.uint16)
    prefix = np.array([0], "<i4").tobytes() + np.array([a, b], "<f4").tobytes()
    data = prefix + cv2.imencode(".png", quantised)[1].tobytes()
    message = m.compressed_image_message(TYPES, header(), data, "32FC1; compressedDepth png")
    np.testing.assert_allclose(m.image_from_message(message), a / (quantised - b) * np.where(quantised, 1, np.nan))


def test_metres_of_millimetres_and_of_metres() -> None:
    millimetres = m.image_message(TYPES, header(), np.array([[0, 1500]], np.uint16))
    np.testing.assert_allclose(m.metres_from_message(millimetres), [[np.nan, 1.5]], rtol=2e-7)
    metres = m.image_message(TYPES, header(), np.array([[np.inf, -1.0, 2.0]], np.float32))
    np.testing.assert_array_equal(m.metres_from_message(metres), np.array([[np.nan, np.nan, 2.0]], np.float32))


@pytest.mark.parametrize(
    "camera",
    [
        CAMERA,
        Camera(8, 6, 50.0, 51.0, 3.5, 2.5, "plumb_bob", (-0.28, 0.07, 1e-4, 2e-5, 0.0)),
        Camera(8, 6, 50.0, 51.0, 3.5, 2.5, "rational_polynomial", (0.1, 0.2, 0.0, 0.0, 0.3, 0.1, 0.2, 0.3)),
        Camera(8, 6, 50.0, 51.0, 3.5, 2.5, "equidistant", (0.1, 0.2, 0.3, 0.4)),
    ],
)
def test_camera_infos_survive(camera: Camera) -> None:
    R = boxplus(np.eye(4), np.array([0, 0, 0, 0.01, 0.02, -0.01]))[:3, :3]
    info = CameraInfo(camera, R, np.array([[40.0, 0, 4, -5], [0, 40, 3, 0], [0, 0, 1, 0]]))
    back = m.camera_info_from_message(over_the_wire(m.camera_info_message(TYPES, header(), info)))
    assert back.camera == camera
    np.testing.assert_array_equal(back.R, R)
    np.testing.assert_array_equal(back.P, info.P)
    assert back.baseline == pytest.approx(0.125)


def test_an_uncalibrated_camera_is_refused() -> None:
    with pytest.raises(ValueError, match="focal length 0 px: the camera is not calibrated"):
        m.camera_info_from_message(TYPES.CameraInfo(header=header(), width=640, height=480))


def test_a_cropped_camera_is_refused() -> None:
    message = m.camera_info_message(TYPES, header(), m.rectified_info(CAMERA))
    message.roi.width = 4
    with pytest.raises(ValueError, match="region of interest"):
        m.camera_info_from_message(message)


CLOUD = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("count", "<i4"), ("id", "<f8"), ("flag", "u1", (3,))])


@settings(max_examples=30)
@given(hnp.arrays(CLOUD, st.one_of(st.tuples(st.integers(0, 9)), st.tuples(st.integers(2, 4), st.integers(1, 5)))))
def test_structured_clouds_survive(cloud: np.ndarray) -> None:
    back = m.cloud_from_message(over_the_wire(m.cloud_message(TYPES, header(), cloud)))
    assert back.shape == cloud.shape
    assert back.dtype.names == CLOUD.names
    assert back.tobytes() == cloud.tobytes()


def test_big_endian_clouds_are_read(rng: np.random.Generator) -> None:
    points = rng.normal(size=(4, 3)).astype(np.float32)
    message = m.points_message(TYPES, header(), points)
    message.is_bigendian = True
    message.data = points.astype(">f4").view(np.uint8).ravel()
    np.testing.assert_array_equal(m.points_from_message(over_the_wire(message)), points)


def test_cloud_contradictions_are_named(rng: np.random.Generator) -> None:
    message = m.points_message(TYPES, header(), rng.normal(size=(4, 3)))
    message.data = message.data[:-1]
    with pytest.raises(ValueError, match="truncated: 48 bytes announced, 47 there"):
        m.points_from_message(message)
    message.fields[2].offset = 9
    with pytest.raises(ValueError, match="'z' ends beyond the point of 12 bytes"):
        m.points_from_message(message)
    message.fields = message.fields[:2]
    with pytest.raises(ValueError, match="no field z"):
        m.points_from_message(m.cloud_message(TYPES, header(), np.zeros(2, dtype=[("x", "f4"), ("y", "f4")])))


def laser_scan(**changes: Any) -> Any:
    fields = {"angle_min": -1.0, "angle_max": 1.0, "angle_increment": 0.5, "range_min": 0.2, "range_max": 8.0,
              "ranges": np.array([1.0, 0.1, np.nan, np.inf, 4.0], np.float32), **changes}  # fmt: skip
    times = {"time_increment": 0.0, "scan_time": 0.1, "intensities": np.zeros(0, np.float32)}
    return over_the_wire(TYPES.LaserScan(header=header(), **times, **fields))


def test_a_laser_scan_has_points_where_it_measured() -> None:
    points = m.points_from_scan(laser_scan())
    np.testing.assert_array_equal(np.isfinite(points[:, 0]), [True, False, False, False, True])
    np.testing.assert_allclose(points[0], [np.cos(-1.0), np.sin(-1.0)], atol=1e-6)
    np.testing.assert_allclose(points[4], [4 * np.cos(1.0), 4 * np.sin(1.0)], atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"ranges": np.zeros(0, np.float32)}, "no ranges"),
        ({"angle_increment": 0.0}, "angle_increment 0"),
        ({"angle_min": np.nan}, "angle_min nan"),
        ({"range_max": 0.1}, "from 0.2"),
    ],
)
def test_a_laser_scan_without_points_is_named(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        m.points_from_scan(laser_scan(**changes))


def make_features(rng: np.random.Generator, n: int) -> Features:
    def floats(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    return Features(
        STAMP, floats(n, 3), floats(n, 2), floats(n), floats(n, 2), floats(n), floats(n),
        rng.integers(0, 3, n).astype(np.uint8), floats(n, 128), CAMERA, "left",
        rng.integers(0, 2**24, n, dtype=np.int32, endpoint=True),
    )  # fmt: skip


@pytest.mark.parametrize("n", [0, 1, 37])
def test_features_survive(rng: np.random.Generator, n: int) -> None:
    features = make_features(rng, n)
    sent = m.features_messages(TYPES, features)
    assert [f.name for f in sent.cloud.fields] == (
        ["x", "y", "z", "u", "v", "depth", "sigma_u", "sigma_v", "sigma_depth", "response", "source", "track"]
    )
    assert {(f.datatype, f.count) for f in sent.cloud.fields} == {(7, 1)}
    back = m.features_from_messages(*map(over_the_wire, sent))
    for name in ("xyz", "uv", "depth", "sigma_uv", "sigma_depth", "response", "source", "descriptors", "track_ids"):
        np.testing.assert_array_equal(getattr(back, name), getattr(features, name))
        assert getattr(back, name).flags.c_contiguous, "sums over another layout round otherwise"
    assert (back.stamp_ns, back.camera, back.frame_id) == (STAMP, CAMERA, "left")


def test_features_of_a_bag_without_tracks_have_none(rng: np.random.Generator) -> None:
    cloud, descriptors, info = m.features_messages(TYPES, make_features(rng, 5))
    points = m.cloud_from_message(cloud)
    old = points[[name for name in points.dtype.names if name != "track"]]
    packed = np.zeros(5, [(name, "<f4") for name in old.dtype.names])
    for name in old.dtype.names:
        packed[name] = old[name]
    back = m.features_from_messages(m.cloud_message(TYPES, header(), packed), descriptors, info)
    np.testing.assert_array_equal(back.track_ids, np.zeros(5))
    np.testing.assert_array_equal(back.uv[:, 0], points["u"])


def test_features_refuse_wrong_descriptors_and_nan(rng: np.random.Generator) -> None:
    cloud, descriptors, info = m.features_messages(TYPES, make_features(rng, 5))
    short = m.image_message(TYPES, header(), np.zeros((4, 128), np.float32))
    with pytest.raises(ValueError, match="5 features need as many rows"):
        m.features_from_messages(cloud, short, info)
    cloud.data[:4] = np.array([np.nan], np.float32).view(np.uint8)
    with pytest.raises(ValueError, match="not finite"):
        m.features_from_messages(cloud, descriptors, info)


def test_depth_images_survive(rng: np.random.Generator) -> None:
    depth = rng.uniform(0.5, 5.0, (6, 8)).astype(np.float32)
    depth[1, 2] = np.nan
    image = DepthImage(STAMP, depth, depth * np.float32(0.01), CAMERA, depth * np.float32(9), None)
    sent = m.depth_messages(TYPES, image)
    assert sent.intensity is None
    back = m.depth_from_messages(
        *(over_the_wire(x) for x in (sent.depth, sent.noise, sent.camera_info, sent.amplitude))
    )
    for name in ("depth", "sigma", "amplitude"):
        np.testing.assert_array_equal(getattr(back, name), getattr(image, name))
    np.testing.assert_array_equal(m.points_from_message(sent.points), image.points().reshape(-1, 3))
    wrong = m.image_message(TYPES, header(), np.zeros((5, 8), np.float32))
    with pytest.raises(ValueError, match="noise image must be 32FC1 of 8 x 6 px"):
        m.depth_from_messages(sent.depth, wrong, sent.camera_info)


def make_submap(rng: np.random.Generator, n: int, agent: str, follows: bool) -> Submap:
    path = tuple(PoseEstimate(STAMP + i, random_pose(rng), random_covariance(rng)) for i in range(3))
    return Submap(
        agent, 7, STAMP, STAMP + 2, path[-1].T, rng.normal(size=(n, 3)), random_covariance(rng, 6 + 3 * n),
        rng.integers(0, 2**40, n), rng.integers(1, 50, n).astype(np.int32),
        unit_rows(rng.normal(size=(n, 128))).astype(np.float32), path, follows, 3,
    )  # fmt: skip


def unit_rows(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


@pytest.mark.parametrize("compact", [False, True])
@pytest.mark.parametrize(("n", "agent", "follows"), [(0, "", True), (11, "fireman_2", False)])
def test_submaps_survive_exactly_or_rounded(
    rng: np.random.Generator, n: int, agent: str, follows: bool, compact: bool
) -> None:
    submap = make_submap(rng, n, agent, follows)
    messages = m.submap_messages(TYPES, submap, compact=compact)
    back = m.submap_from_messages(m.SubmapMessages(*map(over_the_wire, messages)))
    expected = m.rounded(submap) if compact else submap
    for name in ("end_pose", "landmarks", "covariance", "landmark_ids", "sightings", "descriptors"):
        np.testing.assert_array_equal(getattr(back, name), getattr(expected, name), err_msg=name)
    for name in ("end_pose", "landmark_ids", "sightings"):
        np.testing.assert_array_equal(getattr(back, name), getattr(submap, name), err_msg=name)
    assert [getattr(back, k) for k in ("agent", "index", "start_stamp_ns", "end_stamp_ns", "follows_previous")] == [
        agent,
        7,
        STAMP,
        STAMP + 2,
        follows,
    ]
    assert back.session == submap.session == 3
    for a, b in zip(back.path, submap.path, strict=True):
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.T, b.T)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_a_mixed_up_set_of_submap_messages_is_refused(rng: np.random.Generator) -> None:
    sets = [m.submap_messages(TYPES, make_submap(rng, n, "a", True)) for n in (3, 4)]
    with pytest.raises(ValueError, match="gaussian of 3 landmarks must have 15 rows, got 18"):
        m.submap_from_messages(sets[0]._replace(gaussian=sets[1].gaussian))
    late = sets[0].path
    late.header.stamp.sec += 1
    with pytest.raises(ValueError, match="share stamp and frame"):
        m.submap_from_messages(sets[0]._replace(path=late))


def compact_covariance(rng: np.random.Generator, n: int, smallest: float) -> tuple[np.ndarray, np.ndarray]:
    """A covariance whose correlations have eigenvalues down to ``smallest``, and what is sent of it."""
    basis = np.linalg.qr(rng.normal(size=(6 + 3 * n, 6 + 3 * n)))[0]
    correlated = (basis * np.geomspace(1.0, smallest, len(basis))) @ basis.T
    scale = np.geomspace(1e-4, 1.0, len(basis))
    covariance = np.tril(scale[:, None] * correlated * scale)
    covariance += np.tril(covariance, -1).T
    return covariance, m.rounded(replace(make_submap(rng, n, "a", True), covariance=covariance)).covariance


@pytest.mark.parametrize("n", [0, 1, 2, 40])
def test_a_compact_covariance_is_positive_definite_and_hardly_changed(rng: np.random.Generator, n: int) -> None:
    covariance, sent = compact_covariance(rng, n, 1e-6)
    assert np.abs(sent - covariance).max() > 0.0
    assert np.linalg.eigvalsh(sent)[0] > 0.0
    L = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(L, np.linalg.solve(L, sent).T)
    assert np.abs(np.linalg.eigvalsh(whitened) - 1.0).max() < 1e-3


def test_a_covariance_that_rounding_would_change_goes_out_in_full(rng: np.random.Generator) -> None:
    covariance, sent = compact_covariance(rng, 40, 1e-11)
    np.testing.assert_array_equal(sent, covariance)


def test_a_compact_submap_takes_a_quarter_of_its_numbers(rng: np.random.Generator) -> None:
    submap = make_submap(rng, 150, "a", True)
    sent = sum(len(typestore().serialize_cdr(x, x.__msgtype__)) for x in m.submap_messages(TYPES, submap, compact=True))
    assert sent < 0.29 * (submap.covariance.nbytes + submap.descriptors.nbytes)


def test_a_full_submap_sends_each_number_of_the_covariance_once(rng: np.random.Generator) -> None:
    submap = make_submap(rng, 150, "a", True)
    gaussian = m.submap_messages(TYPES, submap).gaussian
    assert len(gaussian.data) < 0.51 * submap.covariance.nbytes


def test_compact_descriptors_compare_as_before(rng: np.random.Generator) -> None:
    submap = make_submap(rng, 50, "a", True)
    sent = m.rounded(submap).descriptors
    np.testing.assert_allclose(np.linalg.norm(sent, axis=1), 1.0, atol=1e-6)
    assert np.abs(sent @ sent.T - submap.descriptors @ submap.descriptors.T).max() < 0.01


def test_submap_cloud_holds_the_marginals(rng: np.random.Generator) -> None:
    submap = make_submap(rng, 4, "", True)
    cloud = m.cloud_from_message(m.submap_messages(TYPES, submap).landmarks)
    assert cloud["cov_xy"][2] == np.float32(submap.covariance[6 + 6, 6 + 7])
    assert cloud["cov_zz"][3] == np.float32(submap.covariance[6 + 11, 6 + 11])


def test_odometry_and_pose_keep_the_covariance(rng: np.random.Generator) -> None:
    estimate = PoseEstimate(STAMP, random_pose(rng), random_covariance(rng))
    for message in (
        m.odometry_message(TYPES, "odom", "base_link", estimate),
        m.pose_with_covariance_message(TYPES, "odom", estimate),
    ):
        back = m.estimate_from_message(over_the_wire(message))
        assert back.stamp_ns == STAMP
        np.testing.assert_allclose(back.T, estimate.T, atol=1e-14)
        np.testing.assert_array_equal(back.covariance, estimate.covariance)


def test_motions_survive_and_an_unknown_one_is_none(rng: np.random.Generator) -> None:
    motion = RelativeMotion(STAMP - 10**8, STAMP, random_pose(rng), random_covariance(rng))
    back = m.motion_from_message(over_the_wire(m.motion_message(TYPES, "base_link", STAMP, motion)))
    assert back is not None
    assert (back.start_stamp_ns, back.end_stamp_ns) == (STAMP - 10**8, STAMP)
    np.testing.assert_allclose(back.T, motion.T, atol=1e-14)
    received = m.motion_as_received(motion)
    assert received is not None
    np.testing.assert_array_equal(received.T, back.T)
    np.testing.assert_array_equal(received.covariance, back.covariance)
    assert m.motion_as_received(None) is None
    assert m.motion_from_message(m.motion_message(TYPES, "base_link", STAMP, None)) is None
    with pytest.raises(ValueError, match="<frame>@<start ns>"):
        m.motion_from_message(m.pose_with_covariance_message(TYPES, "odom", PoseEstimate(1, np.eye(4), np.eye(6))))


def test_paths_and_transforms_survive(rng: np.random.Generator) -> None:
    poses = [PoseEstimate(STAMP + i, random_pose(rng), np.eye(6)) for i in range(3)]
    path = m.path_from_message(over_the_wire(m.path_message(TYPES, STAMP, "map", poses)))
    for (stamp, T), pose in zip(path, poses, strict=True):
        assert stamp == pose.stamp_ns
        np.testing.assert_allclose(T, pose.T, atol=1e-14)
    message = over_the_wire(m.transform_message(TYPES, STAMP, "map", "odom", poses[0].T))
    parent, child, T = m.transform_from_message(message)
    assert (parent, child) == ("map", "odom")
    np.testing.assert_allclose(T, poses[0].T, atol=1e-14)
    pose = rng.normal(size=7)
    pose[3:] /= 1.001 * np.linalg.norm(pose[3:])
    parent, child, same = m.pose7_from_message(over_the_wire(m.pose7_message(TYPES, STAMP, "map", "odom", pose)))
    assert (parent, child) == ("map", "odom")
    np.testing.assert_array_equal(same, pose)


def test_poses_that_are_none_are_refused() -> None:
    pose = m.pose_message(TYPES, np.eye(4))
    pose.orientation.w = 0.5
    with pytest.raises(ValueError, match="unit norm"):
        m.pose_from_message(pose)
    pose.position.x = float("nan")
    with pytest.raises(ValueError, match="not finite"):
        m.pose_from_message(pose)


def test_imu_samples_survive_and_gaps_are_refused(rng: np.random.Generator) -> None:
    sample = ImuSample(STAMP, rng.normal(size=3), rng.normal(size=3))
    message = over_the_wire(m.imu_message(TYPES, "imu", sample))
    back = m.imu_from_message(message)
    np.testing.assert_array_equal(back.angular_velocity, sample.angular_velocity)
    np.testing.assert_array_equal(back.linear_acceleration, sample.linear_acceleration)
    message.angular_velocity_covariance = np.full(9, -1.0)
    with pytest.raises(ValueError, match="no angular velocity"):
        m.imu_from_message(message)


def test_ellipsoids_hold_995_promille_of_the_probability(rng: np.random.Generator) -> None:
    covariance = random_covariance(rng, 3)
    message = over_the_wire(m.ellipsoid_markers(TYPES, header(), np.zeros((1, 3)), covariance[None], np.array([42])))
    clear, sphere = message.markers
    assert (clear.action, sphere.type, sphere.text) == (3, 2, "42")
    T = m.pose_from_message(sphere.pose)
    semi_axes = np.array([sphere.scale.x, sphere.scale.y, sphere.scale.z]) / 2
    samples = rng.multivariate_normal(np.zeros(3), covariance, 20_000) @ T[:3, :3] / semi_axes
    assert np.mean(np.sum(samples**2, axis=1) < 1.0) == pytest.approx(0.995, abs=0.002)
