"""Bags: one iterator of CDR messages over mcap, sqlite3 and ROS 1 recordings, and a writer of mcap.

Intact and damaged files are read the same way. Everything intact is read; what is lost is reported.
"""

import heapq
import re
import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from types import TracebackType

import yaml
from mcap.writer import CompressionType, Writer

from graph_slam_ros.errors import FormatError, similar_file
from graph_slam_ros.formats.durable import AppendedFile
from graph_slam_ros.formats.files import opened, read_text
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings import mcap_records, ros1_records, sqlite_records
from graph_slam_ros.recordings.decompression import ZSTD_MAGIC, zstd_message
from graph_slam_ros.recordings.part import BagError, BagMessage, Part, Topic

__all__ = ["Bag", "BagError", "BagMessage", "BagWriter", "Topic", "open_bag"]

_SUFFIXES = (".mcap", ".db3", ".bag", ".bag.active", ".mcap.zstd", ".db3.zstd")
_PACKED = {
    b"\x1f\x8b": "gzip",
    ZSTD_MAGIC: "zstd",
    b"BZh": "bzip2",
    b"\x04\x22\x4d\x18": "lz4",
    b"\xfd7zXZ": "xz",
    b"PK": "zip",
}
_HEAD_BYTES, _TAR_AT, _MOST_NAMED = 512, 257, 5
_WINDOW_BYTES, _OVERHEAD = 64 * 2**20, 256


class Bag:
    """An open recording: one file, or several parts.

    Attributes
    ----------
    topics : by name
    losses, warnings : what could not be read, and what to beware of, as far as it has been read
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        self._parts = sorted(parts, key=lambda part: part.first_ns)
        self.topics: dict[str, Topic] = {}
        self.losses: list[str] = []
        self.warnings: list[str] = []
        for part in parts:
            for topic in part.topics:
                self._add(part.file, topic)

    def _add(self, file: Path, topic: Topic) -> None:
        old = self.topics.get(topic.name)
        if old is not None and old.type != topic.type:
            raise BagError(f"{file.name}: topic {topic.name} is {topic.type} here, {old.type} elsewhere in the bag")
        self.topics[topic.name] = replace(topic, count=topic.count + (old.count if old else 0))

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """Messages of the named topics in order of receive time; those of one time in order of the file.

        Messages are sorted within a window. A message that was written more than 64 MiB too late stays out of order.
        """
        return _in_order(self._merged(topics))

    def _merged(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """The messages of several parts, split by time or topic. A part is opened when its time has come."""

        def of(part: Part) -> Iterator[BagMessage]:
            yield BagMessage("", part.first_ns, b"")
            yield from self._of(part, topics)

        return (m for m in heapq.merge(*map(of, self._parts), key=attrgetter("log_ns")) if m.topic)

    def _of(self, part: Part, topics: Collection[str]) -> Iterator[BagMessage]:
        losses, warnings, damaged = list[str](), list[str](), 0
        for message in part.messages(topics, losses, warnings):
            try:
                plain = _plain(message)
            except FormatError as error:
                losses.append(f"{part.file.name}: a message of {message.topic} was passed over ({error})")
                continue
            if of_ros1 := part.ros1.get(message.topic):
                try:
                    plain = replace(plain, cdr=of_ros1(plain.cdr))
                except Exception:  # of damaged bytes rosbags raises struct, index, unicode and assertion errors
                    damaged += 1
                    continue
            yield plain
        if damaged:
            losses.append(f"{part.file.name}: {damaged} of its messages are not what their types say")
        for known, new in ((self.losses, losses), (self.warnings, warnings)):
            known += [line for line in dict.fromkeys(new) if line not in known]  # a file may be read more than once


def open_bag(path: Path | str) -> Bag:
    """Open a file (mcap, db3, ROS 1 bag), or a folder of such files, split or not.

    Raises
    ------
    BagError
        No such file, not a recording, or nothing whole in it.
    """
    path = Path(path)
    try:
        files, missing, others = _as_listed(path, _files(path))
        bag = Bag([_part(file) for file in files])
    except OSError as error:
        raise BagError(f"{path}: {error.strerror}") from None
    except FormatError as error:
        raise BagError(str(error)) from None
    bag.losses += [*missing, *_still_packed(path, files)]
    bag.warnings += others
    names = {re.sub(r"[_-]?\d+$", "", file.stem) for file in files}
    there = (re.search(r"_(\d{1,4})\.\w+(\.zstd)?$", file.name) for file in (*files, *path.glob("*.zstd")))
    numbers = {int(found[1]) for found in there if found}
    gaps = sorted({*range(max(numbers, default=0))} - numbers)
    if len(names) == 1 and 0 in numbers and len(gaps) < len(files) and not _names_in(path / "metadata.yaml"):
        bag.losses += [f"{path}: part {number} is not there, between others" for number in gaps]
    if len(names) > 1 and not (path / "metadata.yaml").is_file():
        bag.warnings.append(f"{path}: {len(files)} files of different names are read as one recording: name one")
    return bag


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if not path.exists():
        raise BagError(f"{path}: no such file or folder{similar_file(path)}")
    if not path.is_dir():
        raise BagError(f"{path}: neither a file nor a folder")
    for suffix in _SUFFIXES:
        if found := sorted(file for file in path.glob(f"*{suffix}") if file.is_file()):
            return found
    within = [*dict.fromkeys(one.parent.name for suffix in _SUFFIXES for one in sorted(path.glob(f"*/*{suffix}")))]
    several = f"; give one of those in it: {', '.join(within[:_MOST_NAMED])}" if within else ""
    raise BagError(f"{path}: no recording (.mcap, .db3, .bag) in this folder{several}")


def _part(file: Path) -> Part:
    """Open a file by its first bytes, whatever its name."""
    with opened(file, follow=True) as stream:
        begins = stream.read(_HEAD_BYTES)
    if not begins:
        raise BagError(f"{file}: the file is empty")
    for magic, kind in _KINDS.items():
        if begins.startswith(magic):
            return kind(file)
    for magic, codec in _PACKED.items():
        if begins.startswith(magic):
            raise BagError(f"{file}: {_unpacking(file, codec)}")
    if begins[_TAR_AT:].startswith(b"ustar"):
        raise BagError(f"{file}: {_unpacking(file, 'tar')}")
    raise BagError(f"{file}: not a readable recording: neither mcap, sqlite3 nor ROS 1 (a graph: graph_slam optimize)")


# By how a file begins. rosbags reads whole files alone, and of a damaged one nothing.
_KINDS: dict[bytes, Callable[[Path], Part]] = {
    mcap_records.MAGIC: mcap_records.McapPart,
    sqlite_records.MAGIC: sqlite_records.SqlitePart,
    ros1_records.MAGIC: ros1_records.Ros1Part,
}


def _as_listed(path: Path, found: list[Path]) -> tuple[list[Path], list[str], list[str]]:
    """The files that metadata.yaml names, the losses (named, and not there), and warnings (there, and not named)."""
    there = {file.name.removesuffix(".zstd"): file for file in found}
    named = [Path(name).name.removesuffix(".zstd") for name in _names_in(path / "metadata.yaml")]
    files = [there[name] for name in dict.fromkeys(named) if name in there]
    if not files:
        return found, [], []
    lost = [name for name in named if name not in there and not (path / f"{name}.zstd").is_file()]
    missing = [f"{path / name}: not there, though metadata.yaml names it" for name in lost]
    others = [file.name for file in found if file not in files]
    mend = "metadata.yaml does not name it: if it is a part of the recording, ros2 bag reindex"
    return files, missing, [f"{path / name}: not read, as {mend}" for name in others]


def _still_packed(path: Path, files: list[Path]) -> list[str]:
    """The losses of files that are compressed as a whole, next to others that are not."""
    there = {file.name for file in files}
    if not path.is_dir() or any(name.endswith(".zstd") for name in there):
        return []
    packed = sorted(file for file in path.glob("*.zstd") if file.name.removesuffix(".zstd") not in there)
    return [f"{file.name}: not read: {_unpacking(file)}" for file in packed if file.stem.endswith((".db3", ".mcap"))]


def _unpacking(file: Path, codec: str = "zstd") -> str:
    """Say how a file is unpacked that is compressed as a whole, or is an archive."""
    name = shlex.quote(str(file))
    if codec in ("zip", "tar") or ".tar." in file.name or file.suffix in (".tgz", ".tbz", ".txz"):
        return f"an archive: unpack it, and give the folder in it: {'unzip' if codec == 'zip' else 'tar xf'} {name}"
    whole = file.with_suffix("") if file.suffix in (".zstd", ".gz", ".bz2", ".lz4") else Path("UNPACKED")
    mend = f"unpack it first: {codec} -dc < {name} > {shlex.quote(str(whole))}"
    return f"the whole file is compressed with {codec}: {mend}"


def _names_in(metadata: Path) -> list[str]:
    try:
        content = yaml.safe_load(read_text(metadata, follow=True))
        return [str(name) for name in content["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (OSError, ValueError, yaml.YAMLError, TypeError, KeyError, RecursionError):
        return []


def _in_order(messages: Iterable[BagMessage]) -> Iterator[BagMessage]:
    heap: list[tuple[int, int, BagMessage]] = []
    held, add = 0, list[tuple[int, int, BagMessage]].append  # sorted once: nearly in order, that is cheaper than a heap
    for number, message in enumerate(messages):
        add(heap, (message.log_ns, number, message))
        held += len(message.cdr) + _OVERHEAD
        if held > _WINDOW_BYTES and add is not heapq.heappush:
            heap.sort()
            add = heapq.heappush
        while held > _WINDOW_BYTES:
            first = heapq.heappop(heap)[2]
            held -= len(first.cdr) + _OVERHEAD
            yield first
    heap.sort(reverse=True)
    while heap:
        yield heap.pop()[2]


def _plain(message: BagMessage) -> BagMessage:
    """The message without rosbag2's own compression; no CDR message begins like a compressed one."""
    return replace(message, cdr=zstd_message(message.cdr)) if message.cdr.startswith(ZSTD_MAGIC) else message


class BagWriter:
    """Writes CDR messages into one mcap file, which Foxglove and ``ros2 bag`` can open. Each chunk has its CRC.

    What a full disk does not accept is kept, and the next ``write`` tries again.
    """

    def __init__(self, path: Path | str) -> None:
        self.file = AppendedFile(Path(path))
        self._writer = Writer(self.file, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._writer.start(profile="ros2", library=mcap_records.LIBRARY)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def write(self, topic: str, type_name: str, stamp_ns: int, cdr: bytes) -> None:
        """Append one message, received at ``stamp_ns``. Raises OSError, and keeps the message."""
        if topic not in self._channels:
            if type_name not in self._schemas:
                text, _ = typestore().generate_msgdef(type_name, ros_version=2)
                self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", text.encode())
            schema, more = self._schemas[type_name], {"offered_qos_profiles": ""}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema, more)
        sequence = self._sequence[topic] = self._sequence.get(topic, -1) + 1
        self._writer.add_message(self._channels[topic], stamp_ns, cdr, stamp_ns, sequence)
        self.file.flush()

    def end(self) -> AppendedFile:
        """Append the index. Returns the file, which the caller closes."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        return self.file

    def close(self) -> None:
        """Write the index and close the file."""
        self.end().close()

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()
