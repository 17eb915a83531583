"""Bags: one iterator of CDR messages over mcap, sqlite3 and ROS 1 recordings, and a writer of mcap.

mcap files are read through the stream reader, one path for whole and damaged ones: what is whole is read, what is lost
is told. sqlite3 and ROS 1 bags are read by rosbags.
"""

import heapq
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.mcap_records import Contents, contents, is_mcap, records
from graph_slam_ros.ros.interfaces import typestore


class BagError(GraphSlamError):
    """A recording that cannot be read, or does not hold what was asked for."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A recorded topic.

    Attributes
    ----------
    definition : the message definition recorded with it (ROS .msg text), or empty
    encoding : of its messages
    """

    name: str
    type: str
    count: int
    definition: str = ""
    encoding: str = "cdr"


@dataclass(frozen=True, slots=True)
class BagMessage:
    """One recorded message: CDR bytes and the time it was received."""

    topic: str
    log_ns: int
    cdr: bytes


class Bag(Protocol):
    """A recording, opened."""

    topics: dict[str, Topic]
    losses: list[str]

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """Messages of the named topics in order of recording; what could not be read adds to ``losses``."""


def open_bag(path: Path | str) -> Bag:
    """Open a file (mcap, db3, ROS 1 bag) or a folder that holds them, split or not.

    Raises
    ------
    BagError
        No such file, not a recording, or nothing whole in it.
    """
    path = Path(path)
    files = _files(path)
    try:
        if all(is_mcap(file) for file in files):
            return _McapBag(files)
    except OSError as error:
        raise BagError(f"{path}: {error.strerror}") from None
    if path.is_dir() and (path / "metadata.yaml").exists():
        files = [path]
    return _RosbagsBag(files)


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [_filled(path)]
    if not path.exists():
        raise BagError(f"{path}: no such file or folder")
    if not path.is_dir():
        raise BagError(f"{path}: neither a file nor a folder")
    for suffix in (".mcap", ".db3", ".bag"):
        found = sorted((file for file in path.glob(f"*{suffix}") if file.is_file()), key=_natural)
        if found:
            return [_filled(file) for file in found]
    raise BagError(f"{path}: no recording (.mcap, .db3, .bag) in this folder")


def _filled(file: Path) -> Path:
    if file.stat().st_size == 0:
        raise BagError(f"{file}: the file is empty")
    return file


def _natural(path: Path) -> list[tuple[int, str]]:
    """bag_2 before bag_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


class _McapBag:
    def __init__(self, files: list[Path]) -> None:
        self._files = files
        self.losses: list[str] = []
        self.topics: dict[str, Topic] = {}
        self._contents: dict[Path, Contents] = {}
        for file in files:
            found = self._contents[file] = contents(file)
            for channel in found.channels.values():
                self._add_topic(file, channel, found.schemas.get(channel.schema_id), found.counts.get(channel.id, 0))
        if not self.topics:
            lost: list[str] = []
            for _ in records(files[0], lost):
                pass
            raise BagError(f"{files[0]}: no topic in it{' that is whole; ' + lost[0] if lost else ''}")

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """Of several files in order of time: they may be parts of one recording split by time or by topic."""
        return heapq.merge(*(self._of(file, topics) for file in self._files), key=lambda message: message.log_ns)

    def _of(self, file: Path, topics: Collection[str]) -> Iterator[BagMessage]:
        # a channel's own record may sit in a damaged chunk: the summary knows it, too
        names = {channel.id: channel.topic for channel in self._contents[file].channels.values()}
        read, losses = 0, list[str]()
        for record in records(file, losses):
            if isinstance(record, Message):
                read += 1
                name = names.get(record.channel_id, "")
                if name in topics:
                    yield BagMessage(name, record.log_time, record.data)
            elif isinstance(record, Channel):
                names[record.id] = record.topic
        missing = sum(self._contents[file].counts.values()) - read
        if missing > 0:
            losses.append(f"{file.name}: {missing} of its messages could not be read")
        self.losses += [loss for loss in losses if loss not in self.losses]  # a file may be read more than once

    def _add_topic(self, file: Path, channel: Channel, schema: Schema | None, count: int) -> None:
        encoding, type_name = channel.message_encoding, schema.name if schema else ""
        if type_name.count("/") == 1:
            type_name = type_name.replace("/", "/msg/")
        definition = schema.data.decode(errors="replace") if schema and schema.encoding == "ros2msg" else ""
        old = self.topics.get(channel.topic)
        if old is not None and old.type != type_name:
            raise BagError(f"{file.name}: topic {channel.topic} is {type_name} here, {old.type} elsewhere in the bag")
        self.topics[channel.topic] = Topic(
            channel.topic, type_name, count + (old.count if old else 0), definition, encoding
        )


class _RosbagsBag:
    """sqlite3 and ROS 1 recordings; messages of ROS 1 are turned into CDR where their type is ours."""

    def __init__(self, files: list[Path]) -> None:
        self._name = files[0].name
        self.losses: list[str] = []
        self.topics: dict[str, Topic] = {}
        try:
            self._reader = AnyReader(files, default_typestore=typestore())
            self._reader.open()
        except Exception as error:  # rosbags raises asserts and parser errors on damaged files
            what = str(error) or type(error).__name__
            raise BagError(f"{files[0]}: not a readable recording ({what.splitlines()[0]})") from None
        for connection in self._reader.connections:
            old = self.topics.get(connection.topic)
            count = connection.msgcount + (old.count if old else 0)
            self.topics[connection.topic] = self._topic(connection, count)

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:  # to rosbags, no connection means all of them
            return
        records = self._reader.messages(connections)
        while True:
            try:
                connection, log_ns, raw = next(records)
                cdr = bytes(raw)
                if not self._reader.is2 and self.topics[connection.topic].encoding == "cdr":
                    cdr = bytes(typestore().ros1_to_cdr(raw, connection.msgtype))
            except StopIteration:
                return
            except Exception as error:
                self.losses.append(f"{self._name}: cut off ({type(error).__name__}: {error})")
                return
            yield BagMessage(connection.topic, log_ns, cdr)

    def _topic(self, connection: Any, count: int) -> Topic:
        name, type_name = connection.topic, connection.msgtype
        if self._reader.is2:
            definition = connection.msgdef.data if connection.msgdef.format.name == "MSG" else ""
            return Topic(name, type_name, count, definition)
        return Topic(name, type_name, count, encoding="cdr" if self._is_ours(type_name) else "ros1")

    def _is_ours(self, type_name: str) -> bool:
        """Whether a recorded ROS 1 type, and all it is made of, has our fields (a header's ``seq`` aside)."""
        recorded, ours = self._reader.typestore.fielddefs, typestore().fielddefs
        if type_name not in recorded or type_name not in ours:
            return False
        theirs = [field for field in recorded[type_name][1] if field[0] != "seq"]
        inner = {name for name in re.findall(r"\w+/msg/\w+", repr(theirs)) if not name.startswith("builtin_")}
        return theirs == list(ours[type_name][1]) and all(map(self._is_ours, inner))


class BagWriter:
    """Writes CDR messages into one mcap file that Foxglove and ``ros2 bag`` open; every chunk carries its CRC."""

    def __init__(self, path: Path | str) -> None:
        self._stream = Path(path).open("wb")  # noqa: SIM115 - closed by close()
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="graph_slam_ros")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def write(self, topic: str, type_name: str, stamp_ns: int, cdr: bytes) -> None:
        """Append one message, received at ``stamp_ns``."""
        if topic not in self._channels:
            if type_name not in self._schemas:
                text, _ = typestore().generate_msgdef(type_name, ros_version=2)
                self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", text.encode())
            self._channels[topic] = self._writer.register_channel(
                topic, "cdr", self._schemas[type_name], {"offered_qos_profiles": ""}
            )
        sequence = self._sequence[topic] = self._sequence.get(topic, -1) + 1
        self._writer.add_message(self._channels[topic], stamp_ns, cdr, stamp_ns, sequence)

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()
        self._stream.close()

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()
