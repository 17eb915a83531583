"""The ingest sequence on disk: what the pipeline accepted, in that order, as JSON records in mcap.

One channel per kind of record; the order of the file is the order of acceptance. A sequence may be split over several
files, ``ingest.mcap``, ``ingest_1.mcap``, ...
"""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message
from mcap.writer import CompressionType, Writer

from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.mcap_records import records

_ENCODE = json.JSONEncoder(separators=(",", ":"), check_circular=False, allow_nan=False).encode
_PART = re.compile(r"ingest(?:_(\d+))?\.mcap")
_SCHEMA = _ENCODE({"type": "object", "properties": {"type": {"type": "string"}}, "required": ["type"]}).encode()


class IngestWriter:
    """Appends records to one file."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("wb")
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="graph_slam_ros")
        self._schema = self._writer.register_schema("graph_slam_ros.Measurement", "jsonschema", _SCHEMA)
        self._channels: dict[str, int] = {}
        self._sequence = 0
        self._stamp_ns = 0

    def write(self, record: Mapping[str, Any]) -> None:
        """Append one record; one without a stamp is filed under the last."""
        kind = record["type"]
        if kind not in self._channels:
            self._channels[kind] = self._writer.register_channel(kind, "json", self._schema)
        self._stamp_ns = record.get("stamp_ns", self._stamp_ns)
        data = _ENCODE(record).encode()
        self._writer.add_message(self._channels[kind], self._stamp_ns, data, self._stamp_ns, self._sequence)
        self._sequence += 1

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()


def ingest_files(folder: Path) -> list[Path]:
    """The files of a run's sequence, in order."""
    parts = {file: _PART.fullmatch(file.name) for file in folder.glob("ingest*.mcap")}
    numbered = {file: int(part[1] or 0) for file, part in parts.items() if part and file.is_file()}
    return sorted(numbered, key=lambda file: numbered[file])


def read_ingest(folder: Path, losses: list[str]) -> Iterator[dict[str, Any]]:
    """Records in order of acceptance; what could not be read adds to ``losses``."""
    for file in ingest_files(folder):
        known: set[int] = set()
        for record in records(file, losses):
            if isinstance(record, Channel):
                if record.message_encoding != "json":
                    raise FormatError(f"{file.name}: channel {record.topic} is {record.message_encoding}, not json")
                known.add(record.id)
            elif isinstance(record, Message) and record.channel_id in known:
                try:
                    yield json.loads(record.data)
                except ValueError:
                    raise FormatError(f"{file.name}: record {record.sequence} is not JSON") from None
