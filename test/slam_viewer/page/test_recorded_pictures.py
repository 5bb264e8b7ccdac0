# SPDX-License-Identifier: Apache-2.0
"""A run shows its pictures from its own result, without the bag."""

from __future__ import annotations

import cv2
import numpy as np

from slam_bags.storage.bag import BagWriter
from slam_bags.storage.bag_types import BagTypes
from slam_core.messages import compressed_image_message, header_message
from slam_viewer.page.page import _age_colours
from slam_viewer.page.pictures import RecordedPictures

TYPES = BagTypes()


def test_each_agent_has_its_newest_picture_at_a_time(tmp_path):
    with BagWriter(tmp_path / "result.mcap") as bag:
        for agent, level in (("one", 40), ("two", 200)):
            for stamp in (10, 20):
                jpeg = cv2.imencode(".jpg", np.full((32, 48, 3), level + stamp, np.uint8))[1].tobytes()
                message = compressed_image_message(TYPES, header_message(TYPES, stamp, "camera"), jpeg, "jpeg")
                bag.write(f"/{agent}/features/image/compressed", message, stamp)
    pictures = RecordedPictures(tmp_path / "result.mcap")
    assert pictures
    assert pictures.at("one", 9) is None
    assert abs(int(pictures.at("one", 15).image.mean()) - 50) <= 1
    assert abs(int(pictures.at("two", 99).image.mean()) - 220) <= 1
    assert "two" in pictures.at("two", 99).caption


def test_a_result_without_pictures_shows_none(tmp_path):
    with BagWriter(tmp_path / "result.mcap"):
        pass
    assert not RecordedPictures(tmp_path / "result.mcap")


def test_landmarks_turn_from_orange_to_green_with_the_submaps_that_saw_them():
    new, middle, old = _age_colours(np.array([1, 3, 50])).astype(int)
    assert new.tolist() == [230, 140, 0]
    assert old.tolist() == [20, 160, 60]
    assert new[0] > middle[0] > old[0]
