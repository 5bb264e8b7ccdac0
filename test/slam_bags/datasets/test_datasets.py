# SPDX-License-Identifier: Apache-2.0
"""Data sets in miniature, made here; and the public ones where they are."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from slam_bags.datasets.euroc import EurocDataset
from slam_bags.datasets.files import Dataset
from slam_bags.datasets.kitti import KittiDataset
from slam_bags.datasets.rgbd import RgbdDataset
from slam_bags.reading.readings import DepthReading, ImuReading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.storage.bag import BagWriter
from slam_bringup.commands.convert import command
from slam_core.geometry import invert_transform, make_transform, so3_exp

EUROC_YAML = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [{T}]
resolution: [64, 48]
intrinsics: [50.0, 50.0, 31.5, 23.5]
distortion_coefficients: [-0.1, 0.01, 0.0, 0.0]
"""
STAMPS = (1403715273262142976, 1403715273312143104)


def convert(dataset: Dataset, path: Path) -> SensorBag:
    from slam_bags.storage.sensor_writer import SensorWriter

    with BagWriter(path) as bag:
        assert list(dataset.write(SensorWriter(bag))) == list(range(len(dataset)))
    return SensorBag(path)


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def make_euroc(root: Path) -> tuple[Path, np.ndarray]:
    T_body_left = make_transform(so3_exp(np.array([0.3, -0.2, 0.1])), np.array([0.1, 0.2, 0.3]))
    for number in (0, 1):
        T = T_body_left.copy()
        T[:3, 3] += T[:3, :3] @ [0.11 * number, 0.0, 0.0]
        cam = root / "mav0" / f"cam{number}"
        lines = ["#timestamp [ns],filename"]
        for stamp in STAMPS:
            write_image(cam / "data" / f"{stamp}.png", np.full((48, 64), 10 + number, np.uint8))
            lines.append(f"{stamp},{stamp}.png")
        (cam / "data.csv").write_text("\r\n".join(lines) + "\r\n")
        (cam / "sensor.yaml").write_text(EUROC_YAML.format(T=", ".join(str(v) for v in T.ravel())))
    truth = root / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    truth.parent.mkdir()
    truth.write_text("#t\n" + "".join(f"{s},1,2,3,1,0,0,0" + ",0" * 9 + "\n" for s in STAMPS))
    imu = root / "mav0" / "imu0" / "data.csv"
    imu.parent.mkdir()
    imu.write_text("#t\n" + "".join(f"{s - 5},0.1,0.2,0.3,0,0,9.8\n" for s in STAMPS))
    return root, T_body_left


def test_euroc_folders(tmp_path: Path) -> None:
    source, T_body_left = make_euroc(tmp_path / "euroc")
    with convert(EurocDataset(source), tmp_path / "bag") as bag:
        readings, sensors, truth = list(bag.readings()), bag.sensors[""], bag.ground_truth("")
    stereo = [r for r in readings if isinstance(r, StereoReading)]
    assert tuple(r.stamp_ns for r in stereo) == STAMPS
    assert (stereo[0].pair.left[0, 0], stereo[0].pair.right[0, 0]) == (10, 11)
    assert sum(isinstance(r, ImuReading) for r in readings) == 2
    assert sensors.right is not None
    assert sensors.left is not None
    assert sensors.right.baseline == pytest.approx(0.11)
    assert truth is not None
    # The pair is parallel, so rectification turns nothing: base_link is the left camera with X forward.
    expected = np.eye(4)
    expected[:3, 3] = [1, 2, 3]
    expected = expected @ T_body_left @ invert_transform(sensors.transform("base", "left"))
    np.testing.assert_allclose(truth.poses[0], expected, atol=1e-9)


def test_kitti_folders(tmp_path: Path) -> None:
    source = tmp_path / "kitti"
    for side, value in (("image_0", 20), ("image_1", 21)):
        for i in range(2):
            write_image(source / side / f"{i:06d}.png", np.full((40, 60), value, np.uint8))
    (source / "calib.txt").write_text("P0: 50 0 30 0 0 50 20 0 0 0 1 0\nP1: 50 0 30 -25 0 50 20 0 0 0 1 0\n")
    (source / "times.txt").write_text("0.0\n1.036e-01\n")
    (source / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 1.5\n")
    with convert(KittiDataset(source), tmp_path / "bag") as bag:
        readings, sensors, truth = list(bag.readings()), bag.sensors[""], bag.ground_truth("")
    assert [r.stamp_ns for r in readings if isinstance(r, StereoReading)] == [10**9, 10**9 + 103_600_000]
    assert sensors.right is not None
    assert sensors.right.baseline == pytest.approx(0.5)
    assert truth is not None
    np.testing.assert_allclose(truth.poses[1][:3, 3], [1.5, 0.0, 0.0], atol=1e-9)


def make_tum(root: Path) -> Path:
    for i in range(2):
        write_image(root / "rgb" / f"{i}.png", np.full((48, 64, 3), 90, np.uint8))
        write_image(root / "depth" / f"{i}.png", np.full((48, 64), 10_000, np.uint16))
    (root / "rgb.txt").write_text("# rgb\n1305031102.175304 rgb/0.png\n1305031102.211214 rgb/1.png\n")
    (root / "depth.txt").write_text("1305031102.160407 depth/0.png\n1305031102.226738 depth/1.png\n")
    (root / "groundtruth.txt").write_text("1305031102.1758 1 2 3 0 0 0 1\n")
    return root


def test_tum_rgbd_folders(tmp_path: Path) -> None:
    with convert(RgbdDataset(make_tum(tmp_path / "tum")), tmp_path / "bag") as bag:
        readings, sensors, truth = list(bag.readings()), bag.sensors[""], bag.ground_truth("")
    depth = readings[0]
    assert isinstance(depth, DepthReading)
    assert depth.stamp_ns == 1_305_031_102_175_304_000
    assert (depth.raw.image.dtype, depth.raw.image[0, 0]) == (np.float32, 2.0)
    assert sensors.measurement == "depth"
    assert sensors.tof is not None
    assert sensors.tof.camera.fx == 525.0
    assert truth is not None
    np.testing.assert_allclose(truth.poses[0][:3, 3], [3.0, -1.0, -2.0], atol=1e-9)


@pytest.mark.parametrize(("number", "fx", "distortion"), [(1, 517.3, 5), (2, 520.9, 5), (3, 535.4, 0)])
def test_the_head_of_a_tum_list_names_the_camera(tmp_path: Path, number: int, fx: float, distortion: int) -> None:
    source = make_tum(tmp_path / "tum")
    rgb = source / "rgb.txt"
    rgb.write_text(f"# color images\n# file: 'rgbd_dataset_freiburg{number}_xyz.bag'\n" + rgb.read_text())
    dataset = RgbdDataset(source)
    assert [f"TUM RGB-D publishes for freiburg{number}" in said for said in dataset.assumed] == [True]
    with convert(dataset, tmp_path / "bag") as bag:
        tof = bag.sensors[""].tof
    assert tof is not None
    assert (tof.camera.fx, len(tof.camera.distortion)) == (fx, distortion)
    (tmp_path / "camera-intrinsics.txt").write_text("50 0 31.5\n0 51 23.5\n0 0 1\n")
    dataset = RgbdDataset(source)
    assert dataset.assumed == [f"the camera matrix of {tmp_path / 'camera-intrinsics.txt'}, a folder above the images"]
    with convert(dataset, tmp_path / "again") as bag:
        tof = bag.sensors[""].tof
    assert tof is not None
    assert (tof.camera.fx, tof.camera.distortion) == (50.0, ())


@pytest.mark.parametrize(
    ("stamps", "why"),
    [(("2.0", "1.9", "2.1"), "do not ascend .1.png after 0.png."), (("1e-6", "2e-6", "3e-6"), "0.001 ms")],
)
def test_tum_stamps_that_are_no_camera_s_are_refused_and_the_order_of_the_lists_taken_with_a_rate(
    tmp_path: Path, stamps: tuple[str, ...], why: str
) -> None:
    source = make_tum(tmp_path / "tum")
    for name in ("rgb", "depth"):
        write_image(
            source / name / "2.png",
            np.full((48, 64), 5000 if name == "depth" else 90, "u2" if name == "depth" else "u1"),
        )
        rows = [f"{stamp} {name}/{i}.png" for i, stamp in enumerate(stamps)]
        (source / f"{name}.txt").write_text("\n".join(rows))
    with pytest.raises(ValueError, match=f"stamps of rgb.txt .*{why}.*--rate HZ"):
        RgbdDataset(source)
    dataset = RgbdDataset(source, rate=20.0)
    assert dataset.left_out["poses, as the stamps of the frames are not those of the recording"] == 1
    with convert(dataset, tmp_path / "bag") as bag:
        readings = [r for r in bag.readings() if isinstance(r, DepthReading)]
        assert bag.ground_truth("") is None
    assert [(r.stamp_ns, r.raw.image[0, 0]) for r in readings] == [
        (10**9, 2.0),
        (1_050_000_000, 2.0),
        (1_100_000_000, 1.0),
    ]


def test_a_data_set_s_own_name_leads_to_its_kind() -> None:
    result = CliRunner().invoke(command, ["tum", "x", "-o", "y"])
    assert result.exit_code == 2
    assert "'tum' is read by rgbd: slam convert rgbd SOURCE -o BAG" in result.output


def make_numbered(root: Path) -> Path:
    for i in (3, 4, 5):
        write_image(root / "images" / f"{i:05d}.png", np.full((48, 64, 3), 90, np.uint8))
        if i != 4:
            write_image(root / "depth" / f"{i:05d}.png", np.full((48, 64), 2000, np.uint16))
    (root / "K.txt").write_text("50 0 31.5\n0 51 23.5\n0 0 1\n")
    poses = [make_transform(so3_exp(np.array([0.0, 0.1 * i, 0.0])), np.array([i, 0.0, 0.0])) for i in range(3)]
    np.savetxt(root / "poses.txt", np.array(poses).reshape(3, 16), fmt="%.4f")
    return root


def test_numbered_frames_are_paired_by_name_and_what_has_no_partner_is_named(tmp_path: Path) -> None:
    dataset = RgbdDataset(make_numbered(tmp_path / "office"))
    assert dataset.left_out["pictures without a depth image"] == 1
    with convert(dataset, tmp_path / "bag") as bag:
        readings, sensors, truth = list(bag.readings()), bag.sensors[""], bag.ground_truth("")
    assert [r.stamp_ns for r in readings if isinstance(r, DepthReading)] == [10**9, 10**9 + 200_000_000]
    assert sensors.tof is not None
    assert (sensors.tof.camera.fx, sensors.tof.camera.fy) == (50.0, 51.0)
    assert truth is not None
    # The camera's x is the rig's right: its steps go along -y of a level world.
    np.testing.assert_allclose(truth.poses[2][:3, 3], [0.0, -2.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(truth.poses[2][:3, :3] @ truth.poses[2][:3, :3].T, np.eye(3), atol=1e-12)


def test_a_folder_that_states_no_camera_matrix_asks_for_one(tmp_path: Path) -> None:
    source = make_numbered(tmp_path / "office")
    calibration = (source / "K.txt").rename(tmp_path / "camera.txt")
    with pytest.raises(ValueError, match="states no camera matrix: give it by --calibration"):
        RgbdDataset(source)
    with convert(RgbdDataset(source, calibration), tmp_path / "bag") as bag:
        assert bag.sensors[""].tof is not None
        assert bag.sensors[""].tof.camera.fx == 50.0


def test_stamps_that_a_source_does_not_have_are_told(tmp_path: Path) -> None:
    source = make_numbered(tmp_path / "office")
    assert RgbdDataset(source).assumed == ["10 frames per second, as the source has no stamps (--rate HZ)"]
    dataset = RgbdDataset(source, rate=20.0)
    assert not dataset.assumed
    with convert(dataset, tmp_path / "bag") as bag:
        stamps = [r.stamp_ns for r in bag.readings() if isinstance(r, DepthReading)]
    assert stamps == [10**9, 10**9 + 100_000_000]
    tum = make_tum(tmp_path / "tum")
    assert RgbdDataset(tum).assumed == [
        "fx 525, fy 525, cx 319.5, cy 239.5: usual values, as nothing names the camera (--calibration FILE)"
    ]
    for kind, folder in ((RgbdDataset, tum), (EurocDataset, make_euroc(tmp_path / "euroc")[0])):
        with pytest.raises(ValueError, match="has the stamps of the frames: leave --rate out"):
            kind(folder, rate=20.0)


def test_an_excerpt_of_euroc_with_text_tables(tmp_path: Path) -> None:
    source, _ = make_euroc(tmp_path / "euroc")
    mav = source / "mav0"
    rows = [f"{s - 5} 0.1 0.2 0.3 0 0 9.8" for s in (STAMPS[0] - 2 * 10**9, *STAMPS)]
    (mav / "imu0" / "data.csv").rename(mav / "imu0" / "data.txt").write_text("\n".join(rows))
    (mav / "state_groundtruth_estimate0" / "data.csv").unlink()
    (mav / "truth_body_imu.txt").write_text("# t\n" + "".join(f"{s / 1e9:.5f} 1 2 3 0 0 0 1\n" for s in STAMPS))
    dataset = EurocDataset(mav)
    assert dataset.left_out["IMU readings outside the time of the images"] == 1
    with convert(dataset, tmp_path / "bag") as bag:
        readings, truth = list(bag.readings()), bag.ground_truth("")
    samples = [r.sample for r in readings if isinstance(r, ImuReading)]
    assert [s.stamp_ns for s in samples] == [s - 5 for s in STAMPS]
    assert np.linalg.norm(samples[0].linear_acceleration) == pytest.approx(9.8)
    assert truth is not None
    assert len(truth) == 2


@pytest.mark.parametrize(
    ("dataset", "text"), [(EurocDataset, "not found"), (KittiDataset, "not found"), (RgbdDataset, "not found")]
)
def test_a_missing_folder_is_named(tmp_path: Path, dataset: type, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        dataset(tmp_path / "nothing")


def test_folders_of_something_else_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no RGB-D folder"):
        RgbdDataset(tmp_path)
    with pytest.raises(ValueError, match="none of the image folders"):
        KittiDataset(tmp_path)
    with pytest.raises(ValueError, match=r"camera calibration \(--calibration\) not found"):
        EurocDataset(tmp_path)


def test_a_broken_image_is_named(tmp_path: Path) -> None:
    source = make_tum(tmp_path / "tum")
    (source / "depth" / "1.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"depth.1\.png: expected an image of uint16"):
        convert(RgbdDataset(source), tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


@pytest.mark.data
def test_the_public_keyframes_of_euroc(data_dir: Path, tmp_path: Path) -> None:
    dataset = EurocDataset(
        data_dir / "euroc_v101_visnav100" / "euroc_V1",
        data_dir / "euroc_v101_micro95" / "MicroEurocDataset",
        data_dir / "traj_gt_openvins" / "euroc_mav" / "V1_01_easy.txt",
    )
    assert len(dataset) == 50
    with convert(dataset, tmp_path / "bag") as bag:
        sensors, truth = bag.sensors[""], bag.ground_truth("")
    assert sensors.right is not None
    assert sensors.right.baseline == pytest.approx(0.110, abs=1e-3)
    assert truth is not None
    assert len(truth) > 1000


@pytest.mark.data
def test_the_public_excerpt_of_euroc_has_imu_and_truth(data_dir: Path, tmp_path: Path) -> None:
    with convert(EurocDataset(data_dir / "euroc_mh01_10hz"), tmp_path / "bag") as bag:
        truth, counts = bag.ground_truth(""), {role: bag.count("", role) for role in ("left", "imu")}
    assert counts == {"left": 80, "imu": 1680}
    assert truth is not None
    assert len(truth) > 1500


@pytest.mark.data
def test_the_public_office_of_the_hololens(data_dir: Path, tmp_path: Path) -> None:
    dataset = RgbdDataset(data_dir / "hololens_office_120")
    assert len(dataset) == 120
    assert not any(dataset.left_out.values())
    with convert(dataset, tmp_path / "bag") as bag:
        truth = bag.ground_truth("")
    assert truth is not None
    assert truth.length_m == pytest.approx(9.4, abs=0.1)
