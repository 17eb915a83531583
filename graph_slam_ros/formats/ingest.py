"""The journal: what the pipeline accepted, in that order, as JSON records in mcap, on disk as it goes.

One channel per kind of record; the order of the file is the order of acceptance, and ``sequence`` counts it. Each flush
writes one chunk, which carries its CRC. A sequence may be split over several files, ``ingest.mcap``,
``ingest_1.mcap``, ...
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message
from mcap.writer import CompressionType, Writer

from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.durable import AppendedFile
from graph_slam_ros.formats.mcap_records import records

_ENCODE = json.JSONEncoder(separators=(",", ":"), check_circular=False, allow_nan=False).encode
_PART = re.compile(r"ingest(?:_(\d+))?\.mcap")
_SCHEMA = _ENCODE({"type": "object", "properties": {"type": {"type": "string"}}, "required": ["type"]}).encode()


class IngestWriter:
    """Appends records to one new file: they wait in memory for the next ``flush`` of that."""

    def __init__(self, path: Path) -> None:
        self.file = AppendedFile(path)
        self._chunk = _Chunk()
        self._writer = Writer(self.file, chunk_size=self._chunk, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._writer.start(profile="", library="graph_slam_ros")
        self._schema = self._writer.register_schema("graph_slam_ros.Measurement", "jsonschema", _SCHEMA)
        self._channels: dict[str, int] = {}
        self._sequence = 0
        self._stamp_ns = 0

    def write(self, several: Iterable[Mapping[str, Any]]) -> None:
        """Append records, as one chunk; one without a stamp is filed under the last."""
        *others, last = several
        for record in others:
            self._add(record)
        self._chunk.is_full = True
        self._add(last)
        self._chunk.is_full = False

    def _add(self, record: Mapping[str, Any]) -> None:
        kind = record["type"]
        if kind not in self._channels:
            self._channels[kind] = self._writer.register_channel(kind, "json", self._schema)
        self._stamp_ns = record.get("stamp_ns", self._stamp_ns)
        data = _ENCODE(record).encode()
        self._writer.add_message(self._channels[kind], self._stamp_ns, data, self._stamp_ns, self._sequence)
        self._sequence += 1

    def end(self) -> AppendedFile:
        """Append the index; returns the file, which is to be closed."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        return self.file

    def close(self) -> None:
        """Write the index and close the file."""
        self.end().close()


class _Chunk(int):
    """The size beyond which the library ends a chunk: none, until the last record of a flush comes."""

    is_full = False

    def __lt__(self, size: int) -> bool:
        return self.is_full


def part_name(name: str, part: int) -> str:
    """Of the files that a recording is split over."""
    return f"{name}_{part}.mcap" if part else f"{name}.mcap"


def ingest_files(folder: Path) -> list[Path]:
    """The files of a run's sequence, in order."""
    parts = {file: _PART.fullmatch(file.name) for file in folder.glob("ingest*.mcap")}
    numbered = {file: int(part[1] or 0) for file, part in parts.items() if part and file.is_file()}
    return sorted(numbered, key=lambda file: numbered[file])


def read_ingest(folder: Path, losses: list[str]) -> Iterator[dict[str, Any]]:
    """Records in order of acceptance, up to the first that cannot be read; what is lost adds to ``losses``."""
    lost = len(losses)
    for part, file in enumerate(ingest_files(folder)):
        if file.name != (due := part_name("ingest", part)):
            losses.append(f"{due}: not there; what came after was not read")
        if len(losses) > lost:  # what came after would be out of place
            return
        known: set[int] = set()
        expected = 0
        for record in records(file, losses):
            if isinstance(record, Channel):
                if record.message_encoding != "json":
                    raise FormatError(f"{file.name}: channel {record.topic} is {record.message_encoding}, not json")
                known.add(record.id)
            elif isinstance(record, Message) and record.channel_id in known:
                if record.sequence != expected:
                    losses.append(f"{file.name}: record {expected} is missing; what came after was not read")
                    return
                expected += 1
                try:
                    yield json.loads(record.data)
                except ValueError:
                    raise FormatError(f"{file.name}: record {record.sequence} is not JSON") from None
