# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from slam_bags.storage.bag import BagReader, BagWriter
from slam_bags.storage.bag_types import BagTypes
from slam_core.messages import header_message, image_message, transform_message

TYPES = BagTypes()


def write(path: Path, storage: str = "mcap", count: int = 30, *, overwrite: bool = False) -> Path:
    with BagWriter(path, storage, overwrite=overwrite) as bag:
        transform = transform_message(TYPES, 1, "base_link", "camera", np.eye(4))
        bag.write("/tf_static", TYPES.TFMessage(transforms=[transform]), 1)
        for i in range(count):
            image = np.random.default_rng(i).integers(0, 256, (200, 300), np.uint8)  # nothing to compress
            image[0, 0] = i
            bag.write("/image", image_message(TYPES, header_message(TYPES, 10 + i, "camera"), image), 10 + i)
    return path


@pytest.mark.parametrize(("name", "storage"), [("bag", "mcap"), ("bag", "sqlite3"), ("bag.mcap", "mcap")])
def test_what_is_written_is_read_in_order(tmp_path: Path, name: str, storage: str) -> None:
    with BagReader(write(tmp_path / name, storage)) as bag:
        topics = bag.topics
        stamps = [(m.topic, m.stamp_ns, int(m.message.data[0])) for m in bag.messages(["/image"])]
    assert stamps == [("/image", 10 + i, i) for i in range(30)]
    assert (topics["/image"].type_name, topics["/image"].count) == ("sensor_msgs/msg/Image", 30)
    assert topics["/tf_static"].latched
    assert not topics["/image"].latched


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_the_same_input_gives_the_same_bytes(tmp_path: Path, storage: str) -> None:
    first, second = (write(tmp_path / folder / "bag", storage) for folder in ("one", "two"))
    for file in first.iterdir():
        assert file.read_bytes() == (second / file.name).read_bytes()


def test_bags_are_compressed_as_mcap_has_it_unless_told_otherwise(tmp_path: Path) -> None:
    sizes = {}
    for compression in ("zstd", "none"):
        with BagWriter(tmp_path / compression, compression=compression) as bag:
            for i in range(30):
                image = np.full((200, 300), i, np.uint8)
                bag.write("/image", image_message(TYPES, header_message(TYPES, 10 + i, "camera"), image), 10 + i)
        file = next((tmp_path / compression).glob("*.mcap"))
        sizes[compression] = file.stat().st_size
        assert (b"zstd" in file.read_bytes()) == (compression == "zstd")
        with BagReader(tmp_path / compression) as bag:
            assert [int(m.message.data[-1]) for m in bag.messages()] == list(range(30))
    assert sizes["zstd"] < 0.1 * sizes["none"]
    with pytest.raises(ValueError, match="zstd or none"):
        BagWriter(tmp_path / "x", compression="lz4")


def fail_while_writing(path: Path) -> None:
    with BagWriter(path) as bag:
        bag.write("/tf_static", TYPES.TFMessage(transforms=[]), 1)
        raise RuntimeError


def test_a_failure_leaves_nothing_and_keeps_what_was_there(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", count=2)
    with pytest.raises(RuntimeError):
        fail_while_writing(path)
    assert [p.name for p in tmp_path.iterdir()] == ["bag"]
    with BagReader(path) as old:
        assert old.topics["/image"].count == 2


@pytest.mark.parametrize(("name", "storage"), [("bag", "mcap"), ("bag", "sqlite3"), ("bag.mcap", "mcap")])
def test_a_bag_of_ours_is_replaced_when_told_to_and_never_otherwise(tmp_path: Path, name: str, storage: str) -> None:
    write(tmp_path / name, storage, count=5)
    with pytest.raises(ValueError, match="exists: choose another name, or say --overwrite"):
        write(tmp_path / name, storage)
    with BagReader(write(tmp_path / name, storage, count=3, overwrite=True)) as bag:
        assert bag.topics["/image"].count == 3
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_what_is_not_a_bag_of_ours_is_never_replaced(tmp_path: Path) -> None:
    with_notes = write(tmp_path / "with_notes", count=1)
    (with_notes / "notes.txt").write_text("mine")
    truncated = write(tmp_path / "truncated.mcap")
    truncated.write_bytes(truncated.read_bytes()[:-9])
    folder, file = tmp_path / "folder", tmp_path / "file.mcap"
    folder.mkdir()
    (folder / "thesis.tex").write_text("mine")
    file.write_text("mine")
    with Writer(tmp_path / "recorded", version=9, storage_plugin=StoragePlugin.MCAP):
        pass
    for path in (with_notes, truncated, folder, file, tmp_path / "recorded", tmp_path / "recorded" / "recorded.mcap"):
        before = sorted(p.name for p in path.iterdir()) if path.is_dir() else path.read_bytes()
        with pytest.raises(ValueError, match="is not a bag that slam wrote"):
            write(path, overwrite=True)
        assert before == (sorted(p.name for p in path.iterdir()) if path.is_dir() else path.read_bytes())


def test_a_recording_whose_name_was_taken_meanwhile_is_kept_beside(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.write("/tf_static", TYPES.TFMessage(transforms=[]), 1)
        (tmp_path / "a.mcap").write_text("mine")
    assert bag.path == tmp_path / "a_1.mcap"
    with BagReader(bag.path) as reader:
        assert reader.topics["/tf_static"].count == 1
    assert (tmp_path / "a.mcap").read_text() == "mine"


def test_a_truncated_mcap_is_read_in_part_and_says_so(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.mcap").read_bytes()
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(whole[: len(whole) * 2 // 3])
    with BagReader(broken) as bag:
        read = [m.stamp_ns for m in bag.raw()]
        assert "broken.mcap is truncated" in bag.warning
    assert 0 < len(read) < 31
    assert read == sorted(read)


def test_a_bag_folder_with_a_truncated_file_is_read_in_part(tmp_path: Path) -> None:
    file = write(tmp_path / "bag") / "bag.mcap"
    file.write_bytes(file.read_bytes()[:-20])
    with BagReader(tmp_path / "bag") as bag:
        assert "truncated" in bag.warning
        assert len(list(bag.raw(["/image"]))) == 30


def test_a_killed_recording_without_metadata_is_found(tmp_path: Path) -> None:
    (write(tmp_path / "bag") / "metadata.yaml").unlink()
    with BagReader(tmp_path / "bag") as bag:
        assert bag.topics["/image"].count == 30


@pytest.mark.parametrize("content", [b"", b"not a bag at all, by far"])
@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_what_is_no_bag_is_refused_in_one_line(tmp_path: Path, content: bytes, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"cannot be read as a bag") as caught, BagReader(path):
        pass
    assert "\n" not in str(caught.value)


def test_missing_bags_and_empty_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no bag at"), BagReader(tmp_path / "nothing"):
        pass
    with pytest.raises(ValueError, match="is no bag"), BagReader(tmp_path):
        pass


def test_broken_bytes_are_refused(tmp_path: Path) -> None:
    with BagReader(write(tmp_path / "bag", count=1)) as bag:
        raw = next(bag.raw(["/image"]))
        with pytest.raises(ValueError, match="cannot be decoded"):
            bag.decode("sensor_msgs/msg/Image", raw.data[:30])
        with pytest.raises(ValueError, match="not known"):
            bag.decode("other_msgs/msg/Thing", raw.data)


def test_storage_must_fit(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="storage is 'sqlite3'"):
        BagWriter(tmp_path / "a.mcap", "sqlite3")
    with pytest.raises(ValueError, match="must be mcap or sqlite3"):
        BagWriter(tmp_path / "a", "zip")
