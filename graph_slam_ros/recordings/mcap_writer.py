"""Writes mcap in chunks, compressed, with the bytes of the library's writer, in half of its time for a message."""

import struct
import zlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, Schema, Statistics, SummaryOffset
from mcap.writer import MCAP0_MAGIC

from graph_slam_ros.recordings.mcap_records import LIBRARY, begin

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode and length, channel, sequence, when logged, when published
_MESSAGE_BYTES = 22  # of these after the length
_INDEX = struct.Struct("<BQHI")
_NO_METADATA: Mapping[str, str] = MappingProxyType({})
_FOOTER = struct.Struct("<BQQQ")


class Stream(Protocol):
    """A stream that bytes are appended to."""

    def write(self, data: bytes, /) -> int:
        """Append data."""

    def tell(self) -> int:
        """Return the position of the next byte."""


class McapWriter:
    """Appends messages to a stream, which gets them chunk by chunk.

    Parameters
    ----------
    chunk_bytes : a chunk ends when it has more; None: when ``end_chunk`` is called
    """

    def __init__(self, stream: Stream, profile: str = "", chunk_bytes: int | None = None) -> None:
        self._stream, self._chunk_bytes = stream, chunk_bytes
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._parts: list[bytes] = []  # of the present chunk
        self._size = 0
        self._index: dict[int, list[int]] = {}  # of each channel, in turns: stamp, place in the chunk
        self._chunks: list[ChunkIndex] = []
        self._counts: dict[int, int] = {}  # messages by channel
        stream.write(begin(profile, LIBRARY))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; returns its id."""
        self._schemas.append(Schema(len(self._schemas) + 1, data, encoding, name))
        self._add(_written(self._schemas[-1]))
        return len(self._schemas)

    def register_channel(
        self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str] = _NO_METADATA
    ) -> int:
        """Add a channel; returns its id."""
        self._channels.append(Channel(len(self._channels) + 1, topic, encoding, dict(metadata), schema))
        self._add(_written(self._channels[-1]))
        return len(self._channels)

    def add_message(self, channel: int, logged_ns: int, data: bytes, published_ns: int, sequence: int = 0) -> None:
        """Append a message."""
        length = _MESSAGE_BYTES + len(data)
        head = _MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence, logged_ns, published_ns)
        index = self._index.setdefault(channel, [])
        index.append(logged_ns)
        index.append(self._size)
        self._parts.append(head)
        self._add(data, len(head) + len(data))

    def _add(self, data: bytes, size: int | None = None) -> None:
        self._parts.append(data)
        self._size += len(data) if size is None else size
        if self._chunk_bytes is not None and self._size > self._chunk_bytes:
            self.end_chunk()

    def end_chunk(self) -> None:
        """Write the present chunk, if it has messages, with its index."""
        if not self._index:
            return
        data = b"".join(self._parts)
        packed = zstandard.compress(data)
        stamps = [stamp for index in self._index.values() for stamp in index[::2]]
        first_ns, last_ns = min(stamps), max(stamps)
        record = _written(Chunk("zstd", packed, last_ns, first_ns, zlib.crc32(data), len(data)))
        start = self._stream.tell()
        self._stream.write(record)
        at, offsets, indices = start + len(record), dict[int, int](), list[bytes]()
        for channel, index in self._index.items():
            offsets[channel], size = at, len(index) * 8
            head = _INDEX.pack(Opcode.MESSAGE_INDEX, size + 6, channel, size)
            indices.append(head + struct.pack(f"<{len(index)}Q", *index))
            at += len(indices[-1])
            self._counts[channel] = self._counts.get(channel, 0) + len(index) // 2
        self._stream.write(b"".join(indices))
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(record),
                chunk_start_offset=start,
                compression="zstd",
                compressed_size=len(packed),
                message_end_time=last_ns,
                message_index_length=at - start - len(record),
                message_index_offsets=offsets,
                message_start_time=first_ns,
                uncompressed_size=len(data),
            )
        )
        self._parts, self._size, self._index = [], 0, {}

    def finish(self) -> None:
        """Write what is left, and the summary. The stream stays open."""
        self.end_chunk()
        self._stream.write(_written(DataEnd(0)))
        start, summary = self._stream.tell(), b""
        offsets = list[SummaryOffset]()
        groups: list[tuple[Opcode, list[Any]]] = [(Opcode.SCHEMA, self._schemas), (Opcode.CHANNEL, self._channels)]
        groups += [(Opcode.STATISTICS, [self._statistics()]), (Opcode.CHUNK_INDEX, self._chunks)]
        for opcode, records in groups:
            group = b"".join(map(_written, records))
            offsets.append(SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        offset_start = start + len(summary)
        for code in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            offsets.append(SummaryOffset(code, offset_start, 0))
        summary += b"".join(map(_written, offsets))
        crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, 20, start, offset_start), zlib.crc32(summary))
        self._stream.write(summary + _written(Footer(start, offset_start, crc)) + MCAP0_MAGIC)

    def _statistics(self) -> Statistics:
        first_ns = min((one.message_start_time for one in self._chunks), default=0)
        last_ns = max((one.message_end_time for one in self._chunks), default=0)
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=last_ns,
            message_start_time=first_ns,
            metadata_count=0,
            schema_count=len(self._schemas),
        )


def _written(record: Any) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    out: bytes = builder.end()  # type: ignore[no-untyped-call]
    return out
