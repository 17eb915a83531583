"""Connections and messages of a ROS 1 bag (format 2.0), chunk by chunk, with or without an index.

rosbags needs the index, which is written when a recording ends, and fails with assertions on damaged files.
"""

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import BinaryIO

from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.files import opened
from graph_slam_ros.recordings.decompression import MOST_BYTES, decompressed

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = b"\x02", b"\x03", b"\x05", b"\x06", b"\x07"
_MOST_HEADER = 2**20
Fields = dict[str, bytes]


@dataclass(frozen=True, slots=True)
class Connection:
    """A topic of one publisher; the definition is ROS .msg text, or empty."""

    topic: str
    type: str
    definition: str
    md5: str


@dataclass(frozen=True, slots=True)
class Message:
    """One message, in ROS 1's serialisation."""

    topic: str
    log_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Contents:
    """Connections and their messages by number, time of the first message, and what could not be read."""

    connections: dict[int, Connection]
    counts: dict[int, int]
    first_ns: int
    lost: str = ""


def contents(path: Path) -> Contents:
    """The contents, from the index or by reading everything. Raises FormatError, OSError."""
    try:
        return _indexed(path)
    except (FormatError, struct.error, KeyError, ValueError):
        pass
    losses: list[str] = []
    connections, counts, first_ns = dict[int, Connection](), dict[int, int](), 2**64
    for fields, data in _records(path, losses):
        number = _number(fields, "conn")
        if fields["op"] == _CONNECTION:
            connections[number] = _connection(fields, data)
        else:
            counts[number] = counts.get(number, 0) + 1
            first_ns = min(first_ns, _time(fields["time"]))
    return Contents(connections, counts, first_ns, losses[0] if losses else "")


def messages(path: Path, losses: list[str]) -> Iterator[Message]:
    """Messages in order of the file. A damaged chunk is skipped, a truncated end stops; each adds to ``losses``."""
    topics: dict[int, str] = {}
    for fields, data in _records(path, losses):
        number = _number(fields, "conn")
        if fields["op"] == _CONNECTION:
            topics[number] = _connection(fields, data).topic
        elif number in topics:
            yield Message(topics[number], _time(fields["time"]), data)


def _indexed(path: Path) -> Contents:
    with BufferedReader(opened(path, follow=True)) as stream:
        size = os.fstat(stream.fileno()).st_size
        stream.seek(len(MAGIC))
        fields, _ = _record(stream, size)
        (at,) = struct.unpack("<Q", fields["index_pos"])
        if not len(MAGIC) < at < size:
            raise FormatError("no index")
        stream.seek(at)
        connections, counts, first_ns = dict[int, Connection](), dict[int, int](), 2**64
        while stream.tell() < size:
            fields, data = _record(stream, size)
            if fields["op"] == _CONNECTION:
                connections[_number(fields, "conn")] = _connection(fields, data)
            elif fields["op"] == _CHUNK_INFO:
                first_ns = min(first_ns, _time(fields["start_time"]))
                for number, count in struct.iter_unpack("<II", data):
                    counts[number] = counts.get(number, 0) + count
        return Contents(connections, counts, first_ns)


def _records(path: Path, losses: list[str]) -> Iterator[tuple[Fields, bytes]]:
    """Connections and messages, inside and outside of chunks."""
    read = 0
    with BufferedReader(opened(path, follow=True)) as stream:
        size = os.fstat(stream.fileno()).st_size
        stream.seek(len(MAGIC))
        while (at := stream.tell()) < size:
            try:
                fields, data = _record(stream, size)
            except (FormatError, struct.error, KeyError, ValueError) as error:
                lost = f"{size - at} of {size} bytes are lost"
                losses.append(f"{path.name}: cut off after {read} messages, {lost} ({error})")
                return
            try:
                if fields["op"] == _CHUNK:
                    plain = decompressed(data, _word(fields, "compression"), _number(fields, "size"))
                    inside = BytesIO(plain)
                    while inside.tell() < len(plain):
                        found = _checked(*_record(inside, len(plain)))
                        if found is not None:
                            read += found[0]["op"] == _MESSAGE
                            yield found
                else:
                    found = _checked(fields, data)
                    if found is not None:
                        read += found[0]["op"] == _MESSAGE
                        yield found
            except (FormatError, struct.error, KeyError, ValueError) as error:
                losses.append(f"{path.name}: a damaged chunk of {len(data)} bytes was passed over ({error})")


def _checked(fields: Fields, data: bytes) -> tuple[Fields, bytes] | None:
    """A connection or a message that can be used; nothing for other records. Raises as ``_record`` does."""
    if fields["op"] == _CONNECTION:
        _connection(fields, data)
    elif fields["op"] == _MESSAGE:
        _time(fields["time"])
    else:
        return None
    _number(fields, "conn")
    return fields, data


def _record(stream: BinaryIO, size: int) -> tuple[Fields, bytes]:
    """The next record's header and data. A length beyond the end of the file is refused."""
    fields = _fields(_sized(stream, size, _MOST_HEADER))
    if "op" not in fields:
        raise FormatError("a record of no kind")
    return fields, _sized(stream, size, MOST_BYTES)


def _sized(stream: BinaryIO, size: int, most: int) -> bytes:
    (length,) = struct.unpack("<I", stream.read(4))
    if length > min(most, size - stream.tell()):
        raise FormatError(f"{length} bytes announced, {size - stream.tell()} left")
    return stream.read(length)


def _fields(header: bytes) -> Fields:
    fields: Fields = {}
    at = 0
    while at < len(header):
        (length,) = struct.unpack_from("<I", header, at)
        name, equals, value = header[at + 4 : at + 4 + length].partition(b"=")
        if not equals or at + 4 + length > len(header):
            raise FormatError("a damaged header")
        fields[name.decode()] = value
        at += 4 + length
    return fields


def _connection(fields: Fields, data: bytes) -> Connection:
    more = _fields(data)
    md5, text = (more.get(name, b"").decode(errors="replace") for name in ("md5sum", "message_definition"))
    return Connection(_word(fields, "topic"), _word(more, "type"), text, md5)


def _word(fields: Fields, name: str) -> str:
    return fields[name].decode()


def _number(fields: Fields, name: str) -> int:
    (number,) = struct.unpack("<I", fields[name])
    return int(number)


def _time(value: bytes) -> int:
    seconds, nanoseconds = struct.unpack("<II", value)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
