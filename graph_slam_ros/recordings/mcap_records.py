"""The records of an mcap file in order: one reader for intact, damaged and truncated files.

The library parses the records. The walk from one record to the next is ours, because the library's readers end at the
first damage, trust every length, and decompress without limit.
"""

import errno
import io
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import MAGIC_SIZE
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
_READ: dict[int, Any] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.MESSAGE: Message,
    Opcode.CHUNK: Chunk,
    Opcode.STATISTICS: Statistics,
    Opcode.DATA_END: DataEnd,
}
_MOST_PADDING = 32  # a later version may add fields; after a damaged length there is more
_BLOCK, _FIRST_BLOCK = 2**20, 2**12
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, times of logging and publishing; then the data
# A chunk's head: opcode, length, two times, size, checksum, codec; then the length of its data.
_CHUNK = re.compile(rb"\x06(?=(.{8}).{28}(\0{4}|\x04\0{3}zstd|\x03\0{3}lz4)(.{8}))", re.DOTALL)
_CHUNK_HEAD = 57


class _Whole(io.BytesIO):
    """The data of one record, of which too few bytes are an error."""

    def read(self, size: int | None = -1, /) -> bytes:
        out = super().read(size)
        if size is not None and len(out) < size:
            raise EndOfFile()
        return out


@dataclass(slots=True)
class _Contents:
    """Schemas and channels by id, messages by channel id and, by the summary, of all; the time of the first."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    announced: int | None = None
    first_ns: int = 2**64


def _size(file: io.FileIO) -> int:
    return os.fstat(file.fileno()).st_size


def _part(file: io.FileIO, at: int, size: int) -> bytes:
    """A part of a file, read whole or not at all, because a length in a damaged file may be 2^60."""
    if not 0 <= at <= _size(file) - size:
        raise EndOfFile()
    return os.pread(file.fileno(), size, at)


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
        with opened(file, follow=True) as stream:
            known = _summary(stream)
        if known.announced is None or not known.channels:
            known = _contents(records(file, losses))
        self._channels, self.first_ns = known.channels, known.first_ns
        for number, channel in known.channels.items():
            self.topics.append(self._topic(channel, known.schemas.get(channel.schema_id), known.counts[number]))
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


def _contents(records: Iterable[McapRecord]) -> _Contents:
    out = _Contents()
    for record in records:
        if isinstance(record, Message):
            out.counts[record.channel_id] += 1
            out.first_ns = min(out.first_ns, record.log_time)
        elif isinstance(record, Schema):
            out.schemas[record.id] = record
        elif isinstance(record, Channel):
            out.channels[record.id] = record
        elif isinstance(record, Statistics):
            out.counts.update(record.channel_message_counts)
            out.announced, out.first_ns = record.message_count, record.message_start_time
    return out


def _summary(file: io.FileIO) -> _Contents:
    """The contents by the summary at the end; empty where that is damaged or missing."""
    try:
        end = _size(file) - MAGIC_SIZE - 4  # of the footer, but for the checksum of all from the summary on; 0: none
        start, _, crc = struct.unpack("<QQI", _part(file, end - 16, 20))
        data = _part(file, start, min(end - start, MOST_BYTES)) if start else b""
        return _contents(_inside(data[: -16 - _HEAD.size])) if crc in (0, zlib.crc32(data)) else _Contents()
    except Exception:  # of a damaged file the library raises almost anything
        return _Contents()


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
    with opened(path, follow=follow) as file:
        at = (_next_chunk(file, max(0, _size(file) - last_bytes)) or _size(file)) if last_bytes else MAGIC_SIZE
        while True:
            try:
                record, after = _record(file, at)
            except Exception as error:  # see _summary
                next_chunk = _next_chunk(file, at + 1)
                losses.append(f"{path.name}: {_lost(error, read, at, next_chunk, _size(file))}")
                if next_chunk is None:
                    break
                at = next_chunk
                continue
            is_unindexed |= isinstance(record, Message)
            unchecked |= isinstance(record, Chunk) and not record.uncompressed_crc
            if isinstance(record, DataEnd):
                unchecked |= is_unindexed and not record.data_section_crc
                if is_unindexed and record.data_section_crc not in (0, _checksum(file, at)):
                    losses.append(f"{path.name}: damaged: its data do not agree with their checksum")
                ends_whole = _part(file, _size(file) - MAGIC_SIZE, MAGIC_SIZE) == MAGIC
                if len(losses) == known and not ends_whole:  # of a journal it may be more than the summary
                    where = losses if warnings is None else warnings
                    where.append(f"{path.name}: cut off in the summary at its end; all {read} messages were read")
                break
            try:
                for one in _inside(_plain(record)) if isinstance(record, Chunk) else filter(None, [record]):
                    read += isinstance(one, Message)
                    yield one
            except Exception as error:  # see _summary
                losses.append(f"{path.name}: a damaged chunk of {after - at} bytes was passed over ({_what(error)})")
            at = after
        announced = _summary(file).announced
        if announced is not None and announced != read:  # a record whose kind is damaged is passed over in silence
            missing = f"{announced - read} of its messages could not be read"
            losses.append(f"{path.name}: {missing if read < announced else f'{read - announced} messages too many'}")
    if unchecked and len(losses) > known and warnings is not None:
        warnings.append(f"{path.name}: carries no checksums: more of it may be damaged than was found")


def _record(file: io.FileIO, at: int) -> tuple[McapRecord | None, int]:
    """The record at a position, or nothing if it is of no interest, and the position of the next one.

    Raises almost any exception if the record is damaged.
    """
    opcode, length = _HEAD.unpack(_part(file, at, _HEAD.size))
    begins = at + _HEAD.size
    if begins + length > _size(file):
        raise EndOfFile()
    if opcode not in _READ:
        return None, begins + length
    if length > MOST_BYTES:
        raise FormatError(f"a record of {length} bytes; {MOST_BYTES} is the limit")
    return _parsed(opcode, _part(file, begins, length), 0, length), begins + length


def _inside(data: bytes) -> Iterator[McapRecord]:
    """The records of a chunk or of the summary one by one, because a list of them would double the memory."""
    at = 0
    while at < len(data):
        opcode, length = _HEAD.unpack_from(data, at)
        begins = at + _HEAD.size
        at = begins + length
        if at > len(data):
            raise EndOfFile()
        if opcode in _READ:
            yield _parsed(opcode, data, begins, at)


def _parsed(opcode: int, data: bytes, begin: int, end: int) -> McapRecord:
    """A record of the data from begin to end."""
    if opcode == Opcode.MESSAGE:  # the library reads number by number
        if end - begin < _MESSAGE.size:
            raise EndOfFile()
        channel, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(data, begin)
        return Message(channel, log_ns, data[begin + _MESSAGE.size : end], publish_ns, sequence)
    stream = ReadDataStream(_Whole(data[begin:end]))
    record: McapRecord = _READ[opcode].read(stream)
    if end - begin - stream.count > _MOST_PADDING:
        raise FormatError(f"a record of {end - begin} bytes with {stream.count} in it")
    return record


def _plain(chunk: Chunk) -> bytes:
    plain = decompressed(chunk.data, chunk.compression, chunk.uncompressed_size)
    if chunk.uncompressed_crc not in (0, zlib.crc32(plain)):
        raise FormatError("its checksum is another")
    return plain


def _next_chunk(file: io.FileIO, at: int) -> int | None:
    """Return the position of the next intact chunk: its header is consistent, and its end is in the file.

    The search reads small blocks first and doubles their size, so that many forged headers cost little.
    """
    size = _FIRST_BLOCK
    while (at := _data_from(file, at)) < _size(file):
        block = _part(file, at, min(size + _CHUNK_HEAD, _size(file) - at))
        for found in _CHUNK.finditer(block):
            if found.start() >= size:
                break
            length, within = int.from_bytes(found[1], "little"), int.from_bytes(found[3], "little")
            begins = at + found.start()
            is_whole = length == within + 36 + len(found[2]) and begins + _HEAD.size + length <= _size(file)
            if is_whole and length <= MOST_BYTES:
                return begins
        at += size
        size = min(2 * size, _BLOCK)
    return None


def _data_from(file: io.FileIO, at: int) -> int:
    """The next byte that is stored on the disk: a sparse file may claim a terabyte."""
    try:
        return os.lseek(file.fileno(), at, os.SEEK_DATA)
    except OSError as error:  # nothing follows; or the file system does not know
        return _size(file) if error.errno == errno.ENXIO else at


def _lost(error: Exception, read: int, at: int, next_chunk: int | None, size: int) -> str:
    if next_chunk is None:
        return f"cut off after {read} messages, {max(0, size - at)} of {size} bytes are lost ({_what(error)})"
    return f"damaged at {at}: {next_chunk - at} bytes were passed over ({_what(error)})"


def _what(error: Exception) -> str:
    return str(error) if isinstance(error, FormatError) else type(error).__name__


def _checksum(file: io.FileIO, end: int) -> int:
    crc = 0
    for at in range(0, end, _BLOCK):
        crc = zlib.crc32(_part(file, at, min(_BLOCK, end - at)), crc)
    return crc
