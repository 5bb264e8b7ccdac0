# SPDX-License-Identifier: Apache-2.0
"""Bytes and type of TFMessage against rosbags and against the description that REP-2016 hashes."""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from slam_bags.storage.bag_types import BagTypes, typestore
from slam_core.geometry import boxplus
from slam_core.messages import transform_message
from slam_core.messages.tf_message import TYPE_HASH, tf_message_class, transforms_from_octets, transforms_to_octets

TYPES = BagTypes()
TRANSFORM = "geometry_msgs/msg/TransformStamped"


def transforms(rng):
    """Frames whose names have every length that alignment has to make up for."""
    poses = boxplus(np.eye(4), rng.normal(size=(9, 6)))
    return [transform_message(TYPES, 7 * 10**9 + k, "m" * k, "söd"[: k % 4], T) for k, T in enumerate(poses)]


def test_bytes_are_those_of_another_library_there_and_back(rng):
    for sent in ([], transforms(rng)):
        message = TYPES.TFMessage(transforms=sent)
        theirs = bytes(typestore().serialize_cdr(message, message.__msgtype__))
        assert transforms_to_octets(sent) == theirs
        assert transforms_from_octets(TYPES, theirs) == sent
        big = bytes(typestore().serialize_cdr(message, message.__msgtype__, little_endian=False))
        assert transforms_from_octets(TYPES, big) == sent


@pytest.mark.parametrize("cut", [3, 7, 30, -1])
def test_bytes_that_are_none_are_refused(rng, cut):
    with pytest.raises(ValueError, match=r"no (CDR|TFMessage)"):
        transforms_from_octets(TYPES, transforms_to_octets(transforms(rng))[:cut])
    with pytest.raises(ValueError, match="no CDR of version 1"):
        transforms_from_octets(TYPES, b"\x00\x07" + transforms_to_octets([])[2:])


def described(type_name, fields):
    return {"type_name": type_name, "fields": [{"name": f["name"], "type": f["type"]} for f in fields]}


def test_hash_is_that_of_the_description():
    file = Path(sys.prefix) / "share/geometry_msgs/msg/TransformStamped.json"
    if not file.exists():
        pytest.skip("the descriptions of messages are not installed")
    element = json.loads(file.read_text())["type_description_msg"]
    parts = [element["type_description"], *element["referenced_type_descriptions"]]
    kind = {"type_id": 145, "capacity": 0, "string_capacity": 0, "nested_type_name": TRANSFORM}
    whole = {
        "type_description": described("tf2_msgs/msg/TFMessage", [{"name": "transforms", "type": kind}]),
        "referenced_type_descriptions": sorted(
            (described(**{k: p[k] for k in ("type_name", "fields")}) for p in parts), key=lambda part: part["type_name"]
        ),
    }
    assert hashlib.sha256(json.dumps(whole).encode()).digest() == TYPE_HASH[1:]


def test_a_type_that_is_described_otherwise_is_refused():
    messages = pytest.importorskip("geometry_msgs.msg", reason="rclpy's messages are not installed")
    with pytest.raises(ImportError, match="describes its messages otherwise"):
        tf_message_class(messages.Point)
