"""JSON records in mcap, on disk as they come: the journal of what the pipeline accepted, and what left the map.

One channel per kind of record; the order of the file is that in which they came, and ``sequence`` counts it. Each flush
writes one chunk, which carries its CRC. What is recorded may be split over several files, ``ingest.mcap``,
``ingest_1.mcap``, ...
"""

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from mcap.records import Channel, Message
from mcap.writer import CompressionType, Writer

from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.durable import AppendedFile
from graph_slam_ros.measurements.types import Measurement, from_record
from graph_slam_ros.recordings.bag import BagWriter
from graph_slam_ros.recordings.mcap_records import LIBRARY, records

_ENCODE = json.JSONEncoder(separators=(",", ":"), check_circular=False, allow_nan=False).encode
INGEST = "ingest"
IN_A_MAP = {"type": "begins_in_a_map"}
"""The first record of the journal of such a run; its start is in ``start.mcap``."""
CORRECTION = "correction"  # a record of T_map_odom, where that is known: a restart goes on with the last one at once
START, MAP, SCHEMA = "start.mcap", "map.mcap", "graph_slam_ros.Map"
CONDENSED, LEFT = "condensed", "graph_slam_ros.Left"  # of what has left the map
LEDGER, CHANGES = "ledger.csv", "ledger_changes.csv"
MEASUREMENT = "graph_slam_ros.Measurement"
SCHEMAS = {INGEST: MEASUREMENT, "map": SCHEMA, "start": SCHEMA, CONDENSED: LEFT}
"""Of the recordings of a run, by their names."""
_SCHEMA = _ENCODE({"type": "object", "properties": {"type": {"type": "string"}}, "required": ["type"]}).encode()


class RecordWriter:
    """Appends records to one new file. They stay in memory until the next flush of that file."""

    def __init__(self, path: Path, schema: str = MEASUREMENT) -> None:
        self.file = AppendedFile(path)
        self._chunk = _Chunk()
        self._writer = Writer(self.file, chunk_size=self._chunk, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._writer.start(profile="", library=LIBRARY)
        self._schema = self._writer.register_schema(schema, "jsonschema", _SCHEMA)
        self._channels: dict[str, int] = {}
        self._sequence = self._stamp_ns = 0

    def write(self, several: Sequence[Mapping[str, Any]]) -> None:
        """Append records as one chunk. A record without a stamp gets the last stamp."""
        for record in several:
            kind, self._stamp_ns = record["type"], record.get("stamp_ns", self._stamp_ns)
            if kind not in self._channels:
                self._channels[kind] = self._writer.register_channel(kind, "json", self._schema)
            channel, data = self._channels[kind], _ENCODE(record).encode()
            self._chunk.is_full = record is several[-1]  # not before: a channel, too, ends a chunk that is full
            self._writer.add_message(channel, self._stamp_ns, data, self._stamp_ns, self._sequence)
            self._chunk.is_full = False
            self._sequence += 1

    def end(self) -> AppendedFile:
        """Append the index. Returns the file, which the caller closes."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        return self.file


AnyPart = TypeVar("AnyPart", bound=RecordWriter | BagWriter)


class PartedFile(Generic[AnyPart]):
    """A recording under one name in a folder that is split into files, its parts.

    What the disk does not accept is kept, for ended parts and the present one, and is written in that order.

    Parameters
    ----------
    make : returns the writer of a new file
    """

    def __init__(self, folder: Path, name: str, make: Callable[[Path], AnyPart]) -> None:
        self._folder, self._name, self._make = folder, name, make
        self._part = 0
        self._present: AnyPart | None = None
        self._ended: list[AppendedFile] = []

    def present(self) -> AnyPart:
        """The present part, which is created if there is none."""
        if self._present is None:
            self._present = self._make(self._folder / part_name(self._name, self._part))
        return self._present

    @property
    def unwritten(self) -> int:
        """The number of bytes that are not in files yet."""
        return sum(file.unwritten for file in self._files())

    def flush(self) -> None:
        """Write what is kept in memory. Raises OSError; then some of it is still kept."""
        self._close_ended()
        for file in self._files():
            file.flush()

    def sync(self) -> None:
        """Sync to disk what was flushed. It may be called from another thread. Raises OSError."""
        present = self._present
        if present is not None:
            present.file.sync()

    def end(self) -> None:
        """End the present part, and begin the next with the next record. Raises OSError as ``flush`` does."""
        if self._present is not None:
            self._ended.append(self._present.end())
            self._present = None
            self._part += 1
        self._close_ended()

    def abandon(self) -> None:
        """Leave everything on the disk as it is."""
        for file in self._files():
            file.abandon()

    def _close_ended(self) -> None:
        while self._ended:
            self._ended[0].close()
            del self._ended[0]

    def _files(self) -> list[AppendedFile]:
        return self._ended + ([self._present.file] if self._present is not None else [])


class _Chunk(int):
    """The size at which the library ends a chunk: unlimited, until the last record of a flush."""

    is_full = False

    def __lt__(self, size: int) -> bool:
        return self.is_full


def part_name(name: str, part: int) -> str:
    """The file name of one part of a recording."""
    return f"{name}_{part}.mcap" if part else f"{name}.mcap"


def parts_of(folder: Path, name: str = INGEST) -> list[Path]:
    """The files of a recording in a run folder, in order."""
    pattern = re.compile(rf"{name}(?:_(\d+))?\.mcap")
    parts = {file: pattern.fullmatch(file.name) for file in folder.glob(f"{name}*.mcap")}
    numbered = {file: int(part[1] or 0) for file, part in parts.items() if part}
    return sorted(numbered, key=lambda file: numbered[file])


def read_measurements(
    folder: Path, losses: list[str], processed: int = 0, used_ns: int | None = None
) -> Iterator[Measurement]:
    """The measurements and events of ``read_ingest``."""
    return map(from_record, read_ingest(folder, losses, processed, used_ns))


def read_ingest(
    folder: Path, losses: list[str], processed: int = 0, used_ns: int | None = None
) -> Iterator[dict[str, Any]]:
    """The journal of a run folder in order of acceptance; or what a map lacks that has processed some of its records.

    These are the records after them. Before them come earlier ones that were not in order yet: newer than ``used_ns``,
    the stamp of the last odometry that was used.
    """
    waited: list[dict[str, Any]] = []
    count = 0
    for file, channel, message in _messages(folder, INGEST, losses):
        if channel in (CORRECTION, IN_A_MAP["type"]):
            if channel != CORRECTION and not (processed or (folder / START).exists()):
                losses.append(f"{START}: not there, though the run began in a map: what follows is without it")
            continue
        if count >= processed:
            yield from waited
            waited.clear()
            yield _decoded(file, message)
        elif channel == "control":
            if _decoded(file, message).get("event") in ("time_jump", "clock_step"):
                waited.clear()
        elif channel != "initial_pose" and used_ns is not None and message.log_time > used_ns:
            waited.append(_decoded(file, message))
        count += 1
    yield from waited


def read_records(folder: Path, name: str, losses: list[str], kind: str = "") -> Iterator[dict[str, Any]]:
    """Records (of a ``type``) as they were written, up to the first that cannot be read; that adds to ``losses``."""
    for file, of, message in _messages(folder, name, losses):
        if not kind or of == kind:
            yield _decoded(file, message)


def _decoded(file: str, message: Message) -> Any:
    try:
        record = json.loads(message.data)
    except ValueError:
        raise FormatError(f"{file}: record {message.sequence} is not JSON") from None
    if not isinstance(record, dict):
        raise FormatError(f"{file}: record {message.sequence} is not a JSON object")
    return record


def _messages(folder: Path, name: str, losses: list[str]) -> Iterator[tuple[str, str, Message]]:
    """The same before decoding, each with its file and its kind."""
    lost = len(losses)
    for part, file in enumerate(parts_of(folder, name)):
        if file.name != (due := part_name(name, part)):
            losses.append(f"{due}: not there; what came after was not read")
        if len(losses) > lost:
            if file.name == due:
                losses.append(f"{due}: not read, with what came after it: it would be out of place")
            return
        known: dict[int, str] = {}
        expected = 0
        for record in records(file, losses, follow=False):
            if isinstance(record, Channel):
                if record.message_encoding != "json":
                    raise FormatError(f"{file.name}: channel {record.topic} is {record.message_encoding}, not json")
                known[record.id] = record.topic
            elif isinstance(record, Message) and record.channel_id in known:
                if record.sequence != expected:
                    losses.append(f"{file.name}: record {expected} is missing; what came after was not read")
                    return
                expected += 1
                yield file.name, known[record.channel_id], record
