# SPDX-License-Identifier: Apache-2.0
"""Reading and writing rosbag2 bags (mcap and sqlite3) without ROS; bags of ROS 1 are read as well.

A bag is a folder with ``metadata.yaml``, as ``ros2 bag`` makes it; a path that ends in ``.mcap`` is a single file, as
Foxglove opens it. Writing is all or nothing, and the same input gives the same bytes.
"""

from __future__ import annotations

import shutil
import struct
import tempfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self, TextIO

import yaml
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, ReaderError, StoragePlugin, Writer

from slam_bags.storage.bag_calibration import FILE_NAME, calibration_file
from slam_bags.storage.bag_owner import OWNER, require_free
from slam_bags.storage.bag_salvage import is_whole_mcap, salvage_mcap
from slam_bags.storage.bag_types import typestore
from slam_bags.storage.ros1_bag import Ros1Reader
from slam_core.messages.base import Message
from slam_core.storage.files import atomic_text, name_file, naming, replace
from slam_core.storage.output_folder import free_name

LATCHED_TOPICS = ("tf_static", "static_transforms", "robot_description")
"""Last parts of topics that are transient-local wherever they stand."""

COMPRESSIONS = ("zstd", "none")

_FOREVER = QosTime(2147483647, 4294967295)
_STORAGE_SUFFIXES = (".mcap", ".db3")


class _QuickYaml:
    """As much of ruamel's YAML as rosbags writes with, by the C library: a third of the time to write a small bag."""

    default_flow_style = False

    def __init__(self, typ: str) -> None:
        """Take what ruamel's does."""

    def dump(self, data: Any, stream: TextIO) -> None:
        """Write data as block YAML."""
        yaml.dump(data, stream, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper), default_flow_style=False)


# The profile of every topic is YAML of its own: parsing all of them anew takes half the time to open a bag. Another
# release of rosbags, as it may be beside a sourced ROS 2, may do this elsewhere, and then does so as ever.
with suppress(ImportError, AttributeError):
    from rosbags.rosbag2 import storage_mcap, writer

    storage_mcap.parse_qos = cache(storage_mcap.parse_qos)  # type: ignore[attr-defined,assignment]
    writer.YAML = _QuickYaml  # type: ignore[attr-defined,assignment]


class BagMessage(NamedTuple):
    """One message of a bag; ``stamp_ns`` is the time of recording."""

    topic: str
    stamp_ns: int
    message: Message


class RawMessage(NamedTuple):
    """One message of a bag as CDR bytes."""

    topic: str
    stamp_ns: int
    data: bytes


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a bag: its type (``sensor_msgs/msg/Image``), its messages, and whether it is latched."""

    type_name: str
    count: int
    latched: bool = False
    best_effort: bool = False


def offered_qos(latched: bool = False, depth: int = 1000, *, best_effort: bool = False) -> Qos:
    """The profile a bag says its publisher offered: reliable unless ``best_effort``, transient-local if ``latched``."""
    reliability = QosReliability.BEST_EFFORT if best_effort else QosReliability.RELIABLE
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    return Qos(
        QosHistory.KEEP_LAST,
        depth,
        reliability,
        durability,
        _FOREVER,
        _FOREVER,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        False,
    )


class BagWriter:
    """Writes a bag under a temporary name; leaving the ``with`` block without an error renames it to ``path``.

    Parameters
    ----------
    path
        Folder, or a single file if it ends in ``.mcap``. After writing it is where the bag is: beside the name that
        was asked for, should something have taken that in the meantime.
    storage
        "mcap" or "sqlite3".
    overwrite
        Whether a bag of ours that is there is replaced; anything else never is.
    compression
        "zstd", which every reader of mcap knows, or "none"; sqlite3 is never compressed.

    Raises
    ------
    ValueError
        If there is something at ``path`` that must not be replaced.
    """

    def __init__(
        self,
        path: Path,
        storage: str = "mcap",
        *,
        overwrite: bool = True,
        compression: str = "zstd",
        calibration: str = "",
    ) -> None:
        if storage not in ("mcap", "sqlite3"):
            raise ValueError(f"bag storage must be mcap or sqlite3, got '{storage}'")
        if compression not in COMPRESSIONS:
            raise ValueError(f"bag compression must be {' or '.join(COMPRESSIONS)}, got '{compression}'")
        self._is_compressed = compression == "zstd" and storage == "mcap"
        self.path = Path(path)
        self._single_file = self.path.suffix == ".mcap"
        if self._single_file and storage != "mcap":
            raise ValueError(f"{path} is an mcap file, storage is '{storage}'")
        require_free(self.path, overwrite=overwrite)
        self._overwrite = overwrite
        self._storage = StoragePlugin[storage.upper()]
        self._connections: dict[str, Connection] = {}
        self._calibration = calibration

    def __enter__(self) -> Self:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._workshop = Path(tempfile.mkdtemp(prefix=f".{self.path.name}.", suffix=".part", dir=self.path.parent))
        name = self.path.stem if self._single_file else self.path.name
        self._writer = Writer(self._workshop / name, version=9, storage_plugin=self._storage)
        self._writer.set_custom_data(*OWNER)
        if self._calibration:
            self._writer.set_custom_data(FILE_NAME, self._calibration)
        if self._is_compressed:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            with naming(self.path):
                if error is not None:
                    name_file(error, self.path)
                    self._writer.abort()
                    return
                self._writer.close()
                self._rename()
        finally:
            shutil.rmtree(self._workshop, ignore_errors=True)

    def write(self, topic: str, message: Message, stamp_ns: int) -> None:
        """Append one message made by :class:`slam_bags.storage.bag_types.BagTypes`."""
        type_name = message.__msgtype__
        self.write_raw(topic, type_name, bytes(typestore().serialize_cdr(message, type_name)), stamp_ns)

    def write_raw(self, topic: str, type_name: str, data: bytes, stamp_ns: int) -> None:
        """Append one message of type ``type_name`` as CDR bytes."""
        if topic not in self._connections:
            self.declare(topic, type_name)
        self._writer.write(self._connections[topic], stamp_ns, data)

    def declare(self, topic: str, type_name: str, *, latched: bool | None = None, best_effort: bool = False) -> None:
        """Make a topic known before its first message; ``latched`` follows from the name unless given."""
        latched = topic.rsplit("/", 1)[-1] in LATCHED_TOPICS if latched is None else latched
        if type_name not in typestore().fielddefs:
            raise ValueError(f"{topic}: message type {type_name} is not known")
        self._connections[topic] = self._writer.add_connection(
            topic,
            type_name,
            typestore=typestore(),
            offered_qos_profiles=[offered_qos(latched, best_effort=best_effort)],
        )

    def _rename(self) -> None:
        made = self._writer.path
        if self._single_file:
            made = made / f"{made.name}.mcap"
        try:
            require_free(self.path, overwrite=self._overwrite)
        except ValueError:
            self.path = free_name(self.path)
        replace(made, self.path)
        if self._calibration:
            atomic_text(calibration_file(self.path), self._calibration)


class BagReader:
    """Reads a bag folder, or a single ``.mcap``, ``.db3`` or ROS 1 ``.bag`` file.

    A truncated or damaged bag is read up to where it breaks off; ``warning`` then says so.

    Raises
    ------
    ValueError
        If there is no bag at ``path`` or it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.warning = ""
        self._salvaged: tempfile.TemporaryDirectory[str] | None = None

    def __enter__(self) -> Self:
        source = _storage_of(self.path)
        try:
            self._reader = _opened(source)
        except ValueError as error:
            if source.suffix != ".mcap":
                raise
            self._reader = self._open_salvaged(source, error)
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()
        if self._salvaged is not None:
            self._salvaged.cleanup()

    @property
    def topics(self) -> dict[str, TopicInfo]:
        """Every topic with its type and number of messages, sorted by name."""
        by_topic = groupby(sorted(self._reader.connections, key=_topic), key=_topic)
        return {topic: _topic_info(list(connections)) for topic, connections in by_topic}

    @property
    def start_ns(self) -> int:
        """Time of the first message, ns."""
        return int(self._reader.start_time)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message, s."""
        return max(int(self._reader.duration) - 1, 0) / 1e9

    @property
    def is_indexed(self) -> bool:
        """True if what was recorded at some time is found without reading all that is before."""
        return all(getattr(storage, "chunks", True) for storage in getattr(self._reader, "storages", ()))

    def raw(
        self, topics: Collection[str] | None = None, spans: Iterable[tuple[int, int]] | None = None
    ) -> Iterator[RawMessage]:
        """Messages of some topics (all by default) as bytes, in the order of their time.

        ``spans``: only of these times, each from the first until before the second, ns, in their order.
        """
        wanted = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not wanted:
            return
        count = 0
        for start, stop in [(None, None)] if spans is None else spans:
            messages = iter(self._reader.messages(wanted, start, stop))
            while (message := self._next(messages, count)) is not None:
                connection, stamp, data = message
                yield RawMessage(connection.topic, int(stamp), bytes(data))
                count += 1

    def _next(
        self, messages: Iterator[tuple[Connection, int, bytes]], count: int
    ) -> tuple[Connection, int, bytes] | None:
        """The next message; where a bag is damaged it ends after the ``count`` messages before."""
        try:
            return next(messages, None)
        except Exception as error:  # whatever decompression, a database or the parser makes of damaged bytes
            if count == 0:
                raise ValueError(f"{self.path} cannot be read: {error}") from error
            self.warning = f"{self.path} is damaged after {count} messages, what follows is lost: {error}"
            return None

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Messages of some topics (all by default), decoded, in the order of their time."""
        types = {name: info.type_name for name, info in self.topics.items()}
        for topic, stamp, data in self.raw(topics):
            yield BagMessage(topic, stamp, self.decode(types[topic], data))

    def decode(self, type_name: str, data: bytes) -> Message:
        """A message of its CDR bytes; ValueError if it is of an unknown type or broken."""
        try:
            return typestore().deserialize_cdr(data, type_name)
        except KeyError as error:
            raise ValueError(f"{self.path}: message type {type_name} is not known") from error
        except Exception as error:
            raise ValueError(f"{self.path}: a {type_name} cannot be decoded: {error}") from error

    def _open_salvaged(self, source: Path, error: ValueError) -> Reader | Ros1Reader:
        self._salvaged = tempfile.TemporaryDirectory(prefix="slam-bag-")
        target = Path(self._salvaged.name) / source.name
        kept = salvage_mcap(source, target)
        try:
            reader = _opened(target)
        except ValueError:
            self._salvaged.cleanup()
            raise error from None
        self.warning = f"{source} is truncated: read {kept} of {source.stat().st_size} bytes, what follows is lost"
        return reader


def _storage_of(path: Path) -> Path:
    """The folder if it is a whole bag, else its one storage file: a killed recorder leaves no metadata.yaml."""
    if not path.exists():
        raise ValueError(f"no bag at {path}")
    if path.is_file() or (path / "metadata.yaml").exists():
        files = [p for p in path.glob("*.mcap")] if path.is_dir() else []
        damaged = [p for p in files if not is_whole_mcap(p)]
        return damaged[0] if len(files) == 1 and damaged else path
    files = sorted(p for p in path.iterdir() if p.suffix in _STORAGE_SUFFIXES)
    if len(files) != 1:
        hint = ": ros2 bag reindex makes it one, or name a file" if files else ""
        raise ValueError(f"{path} is no bag: no metadata.yaml and {len(files)} storage files (.mcap, .db3){hint}")
    return files[0]


def _opened(path: Path) -> Reader | Ros1Reader:
    try:
        reader = Ros1Reader(path) if path.suffix == ".bag" and path.is_file() else Reader(path)
        reader.open()
    except (ReaderError, FileNotFoundError, AssertionError, struct.error, OSError, TypeError, ValueError) as error:
        hint = "; each of its files can be read alone" if path.is_dir() else ""
        raise ValueError(f"{path} cannot be read as a bag: {error}{hint}") from error
    return reader


def _topic(connection: Connection) -> str:
    return connection.topic


def _topic_info(connections: list[Connection]) -> TopicInfo:
    extensions = [c.ext for c in connections]
    profiles = [q for e in extensions if isinstance(e, ConnectionExtRosbag2) for q in e.offered_qos_profiles]
    latched = any(q.durability == QosDurability.TRANSIENT_LOCAL for q in profiles)
    best_effort = bool(profiles) and all(q.reliability == QosReliability.BEST_EFFORT for q in profiles)
    return TopicInfo(connections[0].msgtype, sum(c.msgcount for c in connections), latched, best_effort)
