"""The records of an mcap file in order: one reader for intact, damaged and truncated files.

The library parses the records. The walk from one record to the next is ours, because the library's readers end at the
first damage, trust every length, and decompress without limit.
"""

import io
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, TypeAlias

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Schema
from mcap.stream_reader import MAGIC_SIZE
from mcap.summary import Summary
from mcap.writer import Writer

from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.files import opened
from graph_slam_ros.recordings.decompression import MOST_BYTES, decompressed
from graph_slam_ros.recordings.definitions import in_cdr
from graph_slam_ros.recordings.part import BagError, BagMessage, Part, Topic

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "graph_slam_ros"
"""What the head of our own files names as the program that wrote them."""
_HEAD = struct.Struct("<BQ")  # opcode and length of a record
_READ: dict[Opcode, Any] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.MESSAGE: Message,
    Opcode.CHUNK: Chunk,
    Opcode.DATA_END: DataEnd,
}
_MOST_PADDING = 64  # a later version may add fields; after a damaged length there is more
_BLOCK, _FIRST_BLOCK = 2**20, 2**12
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, times of logging and publishing; then the data
# A chunk's head: opcode, length, two times, size, checksum, codec; then the length of its data.
_CHUNK = re.compile(rb"\x06(?=(.{8}).{28}(\0{4}|\x04\0{3}zstd|\x03\0{3}lz4)(.{8}))", re.DOTALL)
_CHUNK_HEAD = 57


Contents: TypeAlias = tuple[dict[int, Schema], dict[int, Channel], dict[int, int], int]
"""Schemas and channels by id, messages by channel id, and the time of the first message."""


class _Stream(io.BufferedReader):
    """A file that is never read beyond ``end``, because a length in a damaged file may be 2^60."""

    def __init__(self, path: Path, follow: bool = True) -> None:
        super().__init__(opened(path, follow=follow))
        self.size = self.end = os.fstat(self.fileno()).st_size

    def go(self, at: int, end: int | None = None) -> None:
        self.end = self.size if end is None else end
        self.seek(at)

    def read(self, size: int | None = -1, /) -> bytes:
        left = self.end - self.tell()
        if size is not None and size > left:
            raise EndOfFile()
        return super().read(left if size is None or size < 0 else size)


def begin(profile: str = "", library: str = LIBRARY) -> bytes:
    """Return the first bytes of a file that we write."""
    head = io.BytesIO()
    Writer(head, use_chunking=False).start(profile, library)
    return head.getvalue()


class McapPart(Part):
    """An mcap file. Topics are read from the summary, or by reading everything if that is damaged or missing."""

    def __init__(self, file: Path) -> None:
        super().__init__(file)
        losses: list[str] = []
        schemas, self._channels, counts, self.first_ns = _summed_up(file) or _read_through(file, losses)
        for number, channel in self._channels.items():
            self.topics.append(self._topic(channel, schemas.get(channel.schema_id), counts.get(number, 0)))
        if not self.topics:
            raise BagError(f"{file}: no topic in it{' that is whole; ' + losses[0] if losses else ''}")

    def messages(self, topics: Collection[str], losses: list[str], warnings: list[str]) -> Iterator[BagMessage]:
        """Messages in order of the file."""
        # a channel's own record may sit in a damaged chunk: the summary knows it, too
        names = {channel.id: channel.topic for channel in self._channels.values()}
        for record in records(self.file, losses, warnings):
            if isinstance(record, Message):
                name = names.get(record.channel_id, "")
                if name in topics:
                    yield BagMessage(name, record.log_time, record.data)
            elif isinstance(record, Channel):
                names[record.id] = record.topic

    def _topic(self, channel: Channel, schema: Schema | None, count: int) -> Topic:
        type_name = schema.name if schema else ""
        if type_name.count("/") == 1:
            type_name = type_name.replace("/", "/msg/")
        has_text = schema is not None and schema.encoding in ("ros2msg", "ros1msg")
        definition = schema.data.decode(errors="replace") if schema and has_text else ""
        topic = Topic(channel.topic, type_name, count, definition, channel.message_encoding)
        return in_cdr(topic, channel.metadata.get("md5sum", ""), self.ros1) if topic.encoding == "ros1" else topic


def _summed_up(file: Path) -> Contents | None:
    try:
        with _Stream(file) as stream:
            summary = _summary(stream)
    except Exception:  # of a damaged file the library raises almost anything
        return None
    if summary is None or summary.statistics is None or not summary.channels:
        return None
    counts, first_ns = summary.statistics.channel_message_counts, summary.statistics.message_start_time
    return summary.schemas, summary.channels, counts, first_ns


def _read_through(file: Path, losses: list[str]) -> Contents:
    schemas, channels, counts, first_ns = dict[int, Schema](), dict[int, Channel](), Counter[int](), 2**64
    for record in records(file, losses):
        if isinstance(record, Message):
            counts[record.channel_id] += 1
            first_ns = min(first_ns, record.log_time)
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
    return schemas, channels, counts, first_ns


def records(
    path: Path, losses: list[str], warnings: list[str] | None = None, *, follow: bool = True, last_bytes: int = 0
) -> Iterator[McapRecord]:
    """Schemas, channels and messages in order of the file; of the last bytes alone, if so many are named.

    A damaged part is skipped up to the next chunk; a truncated end stops the reading. Each adds a line to ``losses``. A
    line in ``warnings`` names damage in a file without checksums, which may have more, or one that is cut off behind
    its messages, which else is a loss. ``follow``: the file may be a symbolic link.
    """
    known = len(losses)
    read, unchecked, is_unindexed = 0, False, False
    with _Stream(path, follow) as stream:
        at = (_next_chunk(stream, max(0, stream.size - last_bytes)) or stream.size) if last_bytes else MAGIC_SIZE
        while True:
            try:
                record, after = _record(stream, at)
            except Exception as error:  # see _summed_up
                next_chunk = _next_chunk(stream, at + 1)
                losses.append(f"{path.name}: {_lost(error, read, at, next_chunk, stream.size)}")
                if next_chunk is None:
                    break
                at = next_chunk
                continue
            if isinstance(record, Chunk):
                unchecked |= not record.uncompressed_crc
                try:
                    for inner in _inside(record):
                        read += isinstance(inner, Message)
                        yield inner
                except Exception as error:  # see _summed_up
                    losses.append(
                        f"{path.name}: a damaged chunk of {after - at} bytes was passed over ({_what(error)})"
                    )
            elif isinstance(record, DataEnd):
                if is_unindexed and record.data_section_crc not in (0, _checksum(stream, at)):
                    losses.append(f"{path.name}: damaged: its data do not agree with their checksum")
                unchecked |= is_unindexed and not record.data_section_crc
                if len(losses) == known and not _ends_whole(stream):  # of a journal it may be more than the summary
                    where = losses if warnings is None else warnings
                    where.append(f"{path.name}: cut off in the summary at its end; all {read} messages were read")
                break
            elif record is not None:
                is_unindexed |= isinstance(record, Message)
                read += isinstance(record, Message)
                yield record
            at = after
        announced = _announced(stream)
        if announced is not None and announced != read:  # a record whose kind is damaged is passed over in silence
            what = f"{announced - read} of its messages could not be read"
            if read > announced:
                what = f"{read - announced} messages too many"
            losses.append(f"{path.name}: {what}")
    if unchecked and len(losses) > known and warnings is not None:
        warnings.append(f"{path.name}: carries no checksums: more of it may be damaged than was found")


def _record(stream: _Stream, at: int) -> tuple[McapRecord | None, int]:
    """The record at a position, or nothing if it is of no interest, and the position of the next one.

    Raises almost any exception if the record is damaged.
    """
    stream.go(at)
    opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
    after = at + _HEAD.size + length
    if after > stream.size:
        raise EndOfFile()
    if opcode not in _READ:
        return None, after
    if length > MOST_BYTES:
        raise FormatError(f"a record of {length} bytes; {MOST_BYTES} is the limit")
    stream.end = after
    return _parsed(opcode, ReadDataStream(stream), length), after


def _parsed(opcode: int, stream: ReadDataStream, length: int) -> McapRecord:
    start = stream.count
    kind = _READ[Opcode(opcode)]
    record: McapRecord = Message.read(stream, length) if kind is Message else kind.read(stream)
    padding = length - (stream.count - start)
    if not 0 <= padding <= _MOST_PADDING:
        raise FormatError(f"a record of {length} bytes with {length - padding} in it")
    stream.read(padding)
    return record


def _inside(chunk: Chunk) -> Iterator[McapRecord]:
    """The records of a chunk one by one, because a list of them would double the memory."""
    plain = decompressed(chunk.data, chunk.compression, chunk.uncompressed_size)
    if chunk.uncompressed_crc not in (0, zlib.crc32(plain)):
        raise FormatError("its checksum is another")
    at, size = 0, len(plain)
    while at < size:
        opcode, length = _HEAD.unpack_from(plain, at)
        at += _HEAD.size
        after = at + length
        if after > size:
            raise EndOfFile()
        if opcode == Opcode.MESSAGE and length >= _MESSAGE.size:  # the library reads number by number
            channel, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(plain, at)
            yield Message(channel, log_ns, plain[at + _MESSAGE.size : after], publish_ns, sequence)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            yield _parsed(opcode, ReadDataStream(io.BytesIO(plain[at:])), length)
        at = after


def _next_chunk(stream: _Stream, at: int) -> int | None:
    """Return the position of the next intact chunk: its header is consistent, and its end is in the file.

    The search reads small blocks first and doubles their size, so that many forged headers cost little.
    """
    size = _FIRST_BLOCK
    while (at := _data_from(stream, at)) < stream.size:
        stream.go(at)
        block = stream.read(min(size + _CHUNK_HEAD, stream.size - at))
        for found in _CHUNK.finditer(block):
            if found.start() >= size:
                break
            length, within = int.from_bytes(found[1], "little"), int.from_bytes(found[3], "little")
            begins = at + found.start()
            is_whole = length == within + 36 + len(found[2]) and begins + _HEAD.size + length <= stream.size
            if is_whole and length <= MOST_BYTES:
                return begins
        at += size
        size = min(2 * size, _BLOCK)
    return None


def _data_from(stream: _Stream, at: int) -> int:
    """The next byte that is stored on the disk: a sparse file may claim a terabyte."""
    try:
        return os.lseek(stream.fileno(), at, os.SEEK_DATA)
    except OSError:  # nothing follows; or the file system does not know
        return at if at < stream.size and not _knows_holes(stream) else stream.size


def _knows_holes(stream: _Stream) -> bool:
    try:
        os.lseek(stream.fileno(), 0, os.SEEK_HOLE)
    except OSError:
        return False
    return True


def _lost(error: Exception, read: int, at: int, next_chunk: int | None, size: int) -> str:
    if next_chunk is None:
        return f"cut off after {read} messages, {max(0, size - at)} of {size} bytes are lost ({_what(error)})"
    return f"damaged at {at}: {next_chunk - at} bytes were passed over ({_what(error)})"


def _what(error: Exception) -> str:
    return str(error) if isinstance(error, FormatError) else type(error).__name__


def _summary(stream: _Stream) -> Summary | None:
    return make_reader(stream).get_summary() if _has_whole_summary(stream) else None


def _announced(stream: _Stream) -> int | None:
    """Return the number of messages by the summary; None if it is damaged or does not have the number."""
    try:
        summary = _summary(stream)
    except Exception:  # see _summed_up
        return None
    return summary.statistics.message_count if summary is not None and summary.statistics is not None else None


def _has_whole_summary(stream: _Stream) -> bool:
    """The footer: the position of the summary, and its checksum, 0 if there is none."""
    end = stream.size - MAGIC_SIZE - 4
    stream.go(end - 16)
    summary, _, crc = struct.unpack("<QQI", stream.read(20))
    is_whole = 0 < summary < end and crc in (0, _checksum(stream, end, summary))
    stream.go(0)
    return is_whole


def _ends_whole(stream: _Stream) -> bool:
    stream.go(stream.size - MAGIC_SIZE)
    return stream.read(MAGIC_SIZE) == MAGIC


def _checksum(stream: _Stream, end: int, start: int = 0) -> int:
    stream.go(start, end)
    crc = 0
    while block := stream.read(min(_BLOCK, end - stream.tell())):
        crc = zlib.crc32(block, crc)
    stream.end = stream.size
    return crc
