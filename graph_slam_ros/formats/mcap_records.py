"""The records of an mcap file in order: one way to read whole, damaged and truncated files.

The summary at the end is used where it is whole; the records themselves always come through the stream reader.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.reader import make_reader
from mcap.records import Channel, Chunk, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk

_MAGIC = b"\x89MCAP0\r\n"
_MAX_CHUNK_BYTES = 256 * 2**20  # declared size, checked before anything is decompressed
_MAX_RECORD_BYTES = 2**30


@dataclass(frozen=True, slots=True)
class Contents:
    """What a file holds: schemas and channels by id, messages by channel id."""

    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    counts: dict[int, int]


def is_mcap(path: Path) -> bool:
    """Whether the file begins as an mcap file does. Raises OSError."""
    with path.open("rb") as stream:
        return stream.read(len(_MAGIC)) == _MAGIC


def contents(path: Path) -> Contents:
    """From the summary, or by reading everything where there is no whole one."""
    try:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except Exception:  # of a damaged file the library raises almost anything
        summary = None
    if summary is not None and summary.statistics is not None and summary.channels:
        return Contents(summary.schemas, summary.channels, summary.statistics.channel_message_counts)
    found = Contents({}, {}, {})
    for record in records(path, []):
        if isinstance(record, Message):
            found.counts[record.channel_id] = found.counts.get(record.channel_id, 0) + 1
        elif isinstance(record, Schema):
            found.schemas[record.id] = record
        elif isinstance(record, Channel):
            found.channels[record.id] = record
    return found


def records(path: Path, losses: list[str]) -> Iterator[McapRecord]:
    """Schemas, channels and messages in order of the file.

    A damaged chunk is passed over and a cut tail ends it; each adds a line to ``losses``.
    """
    read = 0
    with path.open("rb") as stream:
        reader = StreamReader(stream, emit_chunks=True, record_size_limit=_MAX_RECORD_BYTES).records
        while True:
            try:
                record = next(reader)
            except StopIteration:
                return
            except Exception as error:  # see contents
                at, size = stream.tell(), path.stat().st_size
                losses.append(
                    f"{path.name}: cut off after {read} messages ({type(error).__name__} at {at} of {size} bytes)"
                )
                return
            if isinstance(record, Chunk):
                for inner in _unpacked(path, record, losses):
                    read += isinstance(inner, Message)
                    yield inner
            elif isinstance(record, Statistics):  # the summary repeats schemas and channels
                return
            else:
                read += isinstance(record, Message)
                yield record


def _unpacked(path: Path, chunk: Chunk, losses: list[str]) -> list[McapRecord]:
    if chunk.uncompressed_size > _MAX_CHUNK_BYTES:
        losses.append(f"{path.name}: a chunk of {chunk.uncompressed_size} bytes is over the limit and was passed over")
        return []
    try:
        return breakup_chunk(chunk, validate_crc=True)
    except Exception as error:  # see contents
        losses.append(f"{path.name}: a damaged chunk was passed over ({type(error).__name__})")
        return []
