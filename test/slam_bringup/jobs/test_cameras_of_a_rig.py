# SPDX-License-Identifier: Apache-2.0
"""Work with a bag of a rig with several cameras: what one of them shows of itself, its pictures, the mode of a run."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.storage.bag import BagWriter
from slam_bags.storage.sensor_writer import LEFT_FRAME, RIGHT_FRAME, T_BASE_OPTICAL, TOF_FRAME, SensorWriter
from slam_bringup.jobs.refine import refine
from slam_bringup.terminal.mapping_options import mode_for
from slam_core.camera import Camera
from slam_core.messages import rectified_info
from slam_core.trajectory import Trajectory
from slam_viewer.page.pictures import BagPictures

CAMERA = Camera(160, 120, 141.5, 141.5, 79.5, 59.5)
INFO = rectified_info(CAMERA)
STAMPS = (10**9, 11 * 10**8, 12 * 10**8)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A depth camera at the back, a stereo camera and its depth in front."""
    picture = np.random.default_rng(0).integers(0, 255, (120, 160)).astype(np.uint8)
    with BagWriter(tmp_path / "bag") as bag:
        writers = {name: SensorWriter(bag, camera=name) for name in ("back", "front")}
        writers["back"].extrinsics(1, {TOF_FRAME: T_BASE_OPTICAL})
        writers["front"].extrinsics(1, {LEFT_FRAME: T_BASE_OPTICAL, RIGHT_FRAME: T_BASE_OPTICAL})
        for stamp in STAMPS:
            writers["back"].depth(stamp, np.full((120, 160), 2.0, np.float32), INFO, measurement="depth",
                                  amplitude=picture)  # fmt: skip
            writers["front"].stereo(stamp, picture, picture, (INFO, rectified_info(CAMERA, 0.1)))
    return tmp_path / "bag"


def test_a_run_is_stereo_where_any_camera_of_the_rig_is(bag: Path) -> None:
    with SensorBag(bag) as opened:
        assert opened.rigs == {"": ("back", "front")}
        assert mode_for(opened, None) == "stereo"


def test_the_first_camera_is_refined_for_itself(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (120, 160)).astype(np.uint8)
    with BagWriter(tmp_path / "bag") as bag:
        for name in ("back", "front"):
            writer = SensorWriter(bag, camera=name)
            writer.extrinsics(1, {LEFT_FRAME: T_BASE_OPTICAL, RIGHT_FRAME: T_BASE_OPTICAL})
            for stamp in STAMPS:
                writer.stereo(stamp, picture, np.roll(picture, -8, axis=1), (INFO, rectified_info(CAMERA, 0.1)))
    with pytest.raises(ValueError, match="no significant error to correct"):  # of too few images
        refine(tmp_path / "bag")


def test_the_page_shows_pictures_of_the_first_camera(bag: Path) -> None:
    landmarks = SimpleNamespace(positions=np.array([[3.0, 0, 0]]), linked=np.array([True]), sightings=np.array([1]))
    trajectory = Trajectory(np.array(STAMPS), np.stack([np.eye(4)] * len(STAMPS)))
    run = SimpleNamespace(map=SimpleNamespace(landmarks=lambda: landmarks), trajectories={"": trajectory})
    pictures = BagPictures(run, bag)  # type: ignore[arg-type]
    assert pictures._stamps == {"": list(STAMPS)}
