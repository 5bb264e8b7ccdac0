# SPDX-License-Identifier: Apache-2.0
"""A calibration that a user gives counts instead of the bag's, offline and for the nodes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration_folder import BASELINE_FACTOR, TOF_FOCAL_FACTOR, TOF_SHIFT_M, write_calibrations
from slam_bags.reading.extrinsics import StaticTransform, extrinsics_urdf
from slam_bags.reading.rig_calibration import RigCalibration, read_rig_calibration
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.processes.launch_plan import plan_launch
from slam_bringup.processes.node_graph import plan_nodes
from slam_core.camera_info import CameraInfoFile, read_camera_info
from slam_core.geometry import make_transform

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    return write_calibrations(DEMO, tmp_path / "calibration")


def test_cameras_and_their_places_are_those_of_the_calibration(folders: tuple[Path, Path]) -> None:
    with SensorBag(DEMO) as plain:
        own = plain.sensors[""]
    with SensorBag(DEMO, BagNames(calibration=read_rig_calibration(folders))) as bag:
        given = bag.sensors[""]
        graph = plan_nodes(
            choose(load_system_config(None), "fuse", "sjsam", "none"),
            bag.sensors,
            False,
            "",
            calibration=bag.calibration,
        )
    assert own.right is not None
    assert given.right is not None
    assert given.right.baseline == pytest.approx(BASELINE_FACTOR * own.right.baseline)
    assert own.tof is not None
    assert given.tof is not None
    assert given.tof.camera.fx == pytest.approx(TOF_FOCAL_FACTOR * own.tof.camera.fx)
    step = given.transform("left", "tof")[:3, 3] - own.transform("left", "tof")[:3, 3]
    np.testing.assert_allclose(step, [0.0, TOF_SHIFT_M, 0.0], atol=1e-9)
    # The place of the left camera in the rig is not the calibration's.
    np.testing.assert_allclose(given.transform("base", "left"), own.transform("base", "left"), atol=1e-12)
    parameters = {spec.executable: spec.parameters for spec in graph.specs}
    assert parameters["stereo_driver"]["right_info"] == str(folders[0] / "right.yaml")
    assert parameters["tof_driver"]["info"] == str(folders[1] / "tof.yaml")
    assert not any("camera_info" in topic for topic in graph.played)
    (transform,) = (StaticTransform.parse(text) for text in graph.transforms)
    assert (transform.parent, transform.child) == ("stereo_left_optical_frame", "tof_optical_frame")
    np.testing.assert_allclose(transform.T, given.transform("left", "tof"), atol=1e-12)


def test_parameters_of_the_calibration_count_before_those_of_the_user(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    known = read_rig_calibration(folders).parameters
    assert load_system_config(None, known=known).sjsam.calibration.sigma_scale == 0.003
    own = tmp_path / "own.yaml"
    own.write_text("sjsam:\n  calibration.sigma_scale: 0.1\n")
    assert load_system_config(own, known=known).sjsam.calibration.sigma_scale == 0.1


def test_what_does_not_fit_together_is_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    stereo, tof = folders
    assert not read_rig_calibration(()).is_given
    with pytest.raises(ValueError, match="holds no calibration"):
        read_rig_calibration([tmp_path])
    with pytest.raises(ValueError, match="both calibrate the camera left, right"):
        read_rig_calibration([stereo, stereo])
    left = read_camera_info(tof / "left.yaml").info
    turned = replace(left, R=Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix())
    CameraInfoFile(turned, "left").write(stereo / "left.yaml")
    with pytest.raises(ValueError, match="against another left camera"):
        read_rig_calibration([stereo, tof])
    (tof / "extrinsics.yaml").write_text("nothing")
    with pytest.raises(ValueError, match="no extrinsics file"):
        read_rig_calibration([tof])


def test_rectified_images_take_no_calibration(folders: tuple[Path, Path]) -> None:
    calibration = read_rig_calibration(folders[:1])
    names = {"left": "/stereo/left/image_rect", "right": "/stereo/right/image_rect"}
    bag = SensorBag(DEMO, BagNames(calibration=calibration))
    with pytest.raises(ValueError, match="are rectified: a calibration is for raw images"):
        bag._camera_info({**names, "left_info": "/stereo/left/camera_info"}, "left", "left_info")


def test_a_launch_takes_a_calibration_for_one_rig(folders: tuple[Path, Path]) -> None:
    values = {"mode": "fuse", "calibration": f"{folders[0]}, {folders[1]}"}
    parameters = {node.executable: node.parameters for node in plan_launch(values).nodes}
    assert parameters["stereo_driver"]["left_info"] == str(folders[0] / "left.yaml")
    assert parameters["tof_driver"]["info"] == str(folders[1] / "tof.yaml")
    assert parameters["sjsam"]["calibration.sigma_scale"] == 0.003
    player = plan_launch(values | {"bag": str(DEMO)}).nodes[-1]
    assert player.parameters["transforms"][0].startswith("stereo_left_optical_frame tof_optical_frame ")
    for more in ({"agents": "one,two"}, {"rectified": "true"}):
        with pytest.raises(ValueError, match="that of one rig"):
            plan_launch(values | more)


def test_a_urdf_joint_says_the_same() -> None:
    T = make_transform(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.1, 0.2, -0.3]))
    root = ElementTree.fromstring(f"<robot>{extrinsics_urdf('left', 'tof', T)}</robot>")
    origin = root.find("joint/origin")
    assert origin is not None
    xyz, rpy = (np.array(origin.attrib[name].split(), dtype=float) for name in ("xyz", "rpy"))
    np.testing.assert_allclose(xyz, T[:3, 3], atol=1e-8)
    # URDF: turns about the fixed axes x, y and z, in this order.
    np.testing.assert_allclose(Rotation.from_euler("xyz", rpy).as_matrix(), T[:3, :3], atol=1e-8)
    assert RigCalibration().transforms("left", "tof") == ()


@pytest.mark.parametrize(
    "text", ["a b 1 2 3", "a b 1 2 3 0 0 0 1 5", "a b 1 2 3 0 0 0 2", "a b 1 2 3 0 0 x 1", "a", ""]
)
def test_a_line_that_is_no_transform_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not PARENT CHILD x y z qx qy qz qw"):
        StaticTransform.parse(text)


def test_the_numbers_of_a_transform_stay_as_they_were_written() -> None:
    text = "a b 0.1 0.2 0.3 0.1825741858350554 0.3651483716701107 0.5477225575051661 0.7302967433402213"
    assert StaticTransform.parse(text).text == text
