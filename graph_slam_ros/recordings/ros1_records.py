"""Connections and messages of a ROS 1 bag (format 2.0), chunk by chunk, with or without an index.

rosbags needs the index, which is written when a recording ends, and fails with assertions on damaged files.
"""

import os
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import replace
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import BinaryIO, TypeAlias

from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.files import opened
from graph_slam_ros.recordings.decompression import MOST_BYTES, decompressed
from graph_slam_ros.recordings.definitions import in_cdr
from graph_slam_ros.recordings.part import BagError, BagMessage, Part, Topic

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = b"\x02", b"\x03", b"\x05", b"\x06", b"\x07"
_MOST_HEADER = 2**20
Fields: TypeAlias = dict[str, bytes]
Record: TypeAlias = tuple[Fields, bytes]
_DAMAGE = (FormatError, struct.error, KeyError, ValueError)


class Ros1Part(Part):
    """A ROS 1 bag. Its topics are read from the index, or by reading everything. Raises FormatError, OSError."""

    def __init__(self, file: Path) -> None:
        super().__init__(file)
        losses: list[str] = []
        try:
            self._sum_up(_index(file))
        except _DAMAGE:
            self._sum_up(_records(file, losses))
        if not self.topics:
            raise BagError(f"{file}: no topic in it{' that is whole; ' + losses[0] if losses else ''}")

    def _sum_up(self, records: Iterator[Record]) -> None:
        """Count the messages of each topic, which may have several connections, one for each publisher."""
        connections, counts, first_ns = dict[int, tuple[Topic, str]](), Counter[int](), 2**64
        for fields, data in records:
            if fields["op"] == _CONNECTION:
                connections[_number(fields, "conn")] = _connection(fields, data)
            elif fields["op"] == _CHUNK_INFO:
                first_ns = min(first_ns, _time(fields["start_time"]))
                for number, count in struct.iter_unpack("<II", data):
                    counts[number] += count
            else:
                first_ns = min(first_ns, _time(fields["time"]))
                counts[_number(fields, "conn")] += 1
        by_name: dict[str, Topic] = {}
        for number, (topic, md5) in connections.items():
            known = by_name.get(topic.name)
            if known is None or known.encoding == "ros1":  # a publisher may have no definition, and the next has
                known = in_cdr(replace(topic, count=known.count if known else 0), md5, self.ros1)
            by_name[topic.name] = replace(known, count=known.count + counts[number])
        self.topics, self.first_ns = list(by_name.values()), first_ns

    def messages(self, topics: Collection[str], losses: list[str], warnings: list[str]) -> Iterator[BagMessage]:
        """Messages in order of the file. A damaged chunk is skipped, a truncated end stops; ``losses`` says so."""
        names: dict[int, str] = {}
        for fields, data in _records(self.file, losses):
            number = _number(fields, "conn")
            if fields["op"] == _CONNECTION:
                names[number] = _connection(fields, data)[0].name
            elif names.get(number) in topics:
                yield BagMessage(names[number], _time(fields["time"]), data)


def _index(path: Path) -> Iterator[Record]:
    with BufferedReader(opened(path, follow=True)) as stream:
        size = os.fstat(stream.fileno()).st_size
        stream.seek(len(MAGIC))
        fields, _ = _record(stream, size)
        (at,) = struct.unpack("<Q", fields["index_pos"])
        if not len(MAGIC) < at < size:
            raise FormatError("no index")
        stream.seek(at)
        while stream.tell() < size:
            record = _record(stream, size)
            if record[0]["op"] in (_CONNECTION, _CHUNK_INFO):
                yield record


def _records(path: Path, losses: list[str]) -> Iterator[Record]:
    """Connections and messages, inside and outside of chunks."""
    read = 0
    with BufferedReader(opened(path, follow=True)) as stream:
        size = os.fstat(stream.fileno()).st_size
        stream.seek(len(MAGIC))
        while (at := stream.tell()) < size:
            try:
                fields, data = _record(stream, size)
            except _DAMAGE as error:
                lost = f"{size - at} of {size} bytes are lost"
                losses.append(f"{path.name}: cut off after {read} messages, {lost} ({error})")
                return
            try:
                for record in _inside(fields, data) if fields["op"] == _CHUNK else [(fields, data)]:
                    if _is_usable(*record):
                        read += record[0]["op"] == _MESSAGE
                        yield record
            except _DAMAGE as error:
                losses.append(f"{path.name}: a damaged chunk of {len(data)} bytes was passed over ({error})")


def _inside(fields: Fields, data: bytes) -> Iterator[Record]:
    plain = decompressed(data, _word(fields, "compression"), _number(fields, "size"))
    inside = BytesIO(plain)
    while inside.tell() < len(plain):
        yield _record(inside, len(plain))


def _is_usable(fields: Fields, data: bytes) -> bool:
    """Return whether a record is a connection or a message. Raises as ``_record`` does where that is damaged."""
    if fields["op"] == _CONNECTION:
        _connection(fields, data)
    elif fields["op"] == _MESSAGE:
        _time(fields["time"])
    else:
        return False
    _number(fields, "conn")
    return True


def _record(stream: BinaryIO, size: int) -> Record:
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


def _connection(fields: Fields, data: bytes) -> tuple[Topic, str]:
    """The topic of a connection, and the checksum of its type."""
    more = _fields(data)
    md5, text = (more.get(name, b"").decode(errors="replace") for name in ("md5sum", "message_definition"))
    return Topic(_word(fields, "topic"), _word(more, "type").replace("/", "/msg/"), 0, text, "ros1"), md5


def _word(fields: Fields, name: str) -> str:
    return fields[name].decode()


def _number(fields: Fields, name: str) -> int:
    (number,) = struct.unpack("<I", fields[name])
    return int(number)


def _time(value: bytes) -> int:
    seconds, nanoseconds = struct.unpack("<II", value)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
