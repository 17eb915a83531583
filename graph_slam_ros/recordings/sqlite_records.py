"""Topics and messages of a rosbag2 sqlite3 file: read only, in order of writing, up to the first damage.

rosbags sorts the file by time, so that one bad page makes all of it unreadable.
"""

import sqlite3
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from graph_slam_ros.errors import FormatError
from graph_slam_ros.recordings.decompression import MOST_BYTES

MAGIC = b"SQLite format 3\x00"
_DEFINITIONS = "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
_LEAST_LIMIT = 2**20  # bytes of a text or blob; none is longer than the file
_ROWS = "SELECT topic_id, timestamp, CASE WHEN topic_id IN ({}) THEN data END FROM messages ORDER BY id"


@dataclass(frozen=True, slots=True)
class Contents:
    """Topics (name, type, encoding) by number, messages by topic, definitions by type, time of the first message."""

    topics: dict[int, tuple[str, str, str]]
    counts: dict[int, int]
    definitions: dict[str, str]
    first_ns: int


def contents(path: Path) -> Contents:
    """Read the topics. Raises FormatError if it is no rosbag2 file, or if its topics cannot be read."""
    try:
        with closing(_connection(path)) as database:
            kinds = dict(database.execute("SELECT name, type FROM sqlite_master WHERE type IN ('table', 'view')"))
            if not kinds.get("topics") == kinds.get("messages") == "table":
                rtabmap = "a map of RTAB-Map: rtabmap-databaseViewer exports its graph as g2o"
                why = rtabmap if {"Node", "Link"} <= kinds.keys() else "no tables of rosbag2 in it"
                raise FormatError(f"{path}: not a readable recording: {why}")
            for table in ("topics", "messages", "message_definitions"):
                _refuse_computed(database, path, table)
            rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            topics = {int(number): (str(name), str(kind), str(code)) for number, name, kind, code in rows}
            definitions: dict[str, str] = {}
            try:
                counts = dict(database.execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"))
                first_ns = int(database.execute("SELECT MIN(timestamp) FROM messages").fetchone()[0])
            except (sqlite3.Error, TypeError, ValueError):  # empty, or damaged farther on
                counts, first_ns = _counted(database)
            with suppress(sqlite3.Error):  # before Iron there are none
                definitions = dict(database.execute(_DEFINITIONS))
    except (sqlite3.Error, TypeError, ValueError) as error:
        raise FormatError(f"{path}: not a readable recording ({error})") from None
    return Contents(topics, counts, definitions, first_ns)


def _counted(database: sqlite3.Connection) -> tuple[dict[int, int], int]:
    """Messages by topic, and the time of the first, up to the first damage."""
    counts, first_ns = dict[int, int](), 2**64
    with suppress(sqlite3.Error):
        for topic, stamp in database.execute("SELECT topic_id, timestamp FROM messages ORDER BY id"):
            if isinstance(topic, int) and isinstance(stamp, int):
                counts[topic] = counts.get(topic, 0) + 1
                first_ns = min(first_ns, stamp)
    return counts, first_ns if counts else 0


def _refuse_computed(database: sqlite3.Connection, path: Path, table: str) -> None:
    """Raise FormatError if a table has computed columns: a few bytes may then produce gigabytes."""
    columns = database.execute(f"PRAGMA table_xinfo({table})").fetchall()
    computed = [str(name) for _, name, *_, hidden in columns if hidden]
    if computed:
        raise FormatError(f"{path}: not a readable recording: the column {computed[0]} of {table} is computed")


def messages(path: Path, topics: Sequence[int], losses: list[str]) -> Iterator[tuple[int, int, bytes]]:
    """Topic, time and bytes of each message of some topics in order of writing. What is lost adds to ``losses``."""
    if _has_companion(path, "-journal"):
        losses.append(f"{path.name}: its recorder was stopped while it wrote; what it wrote last may be lost")
    read = 0
    with closing(_connection(path)) as database:
        marks = ", ".join("?" * len(topics))
        try:
            # All rows: of a search for some, the last one before the damage is lost, which may be all of /tf_static.
            for topic, stamp, data in database.execute(_ROWS.format(marks), topics):
                if topic not in topics:
                    continue
                if isinstance(topic, int) and isinstance(stamp, int) and isinstance(data, bytes):
                    read += 1
                    yield topic, stamp, data
                else:
                    losses.append(f"{path.name}: a message without time or content was passed over")
        except sqlite3.Error as error:
            losses.append(f"{path.name}: cut off after {read} messages ({error})")


def damage(path: Path) -> str:
    """The damage that sqlite reports, or nothing. Rows may be missing that reading does not notice."""
    try:
        with closing(_connection(path)) as database:
            (found,) = database.execute("PRAGMA quick_check(1)").fetchone()
    except sqlite3.Error as error:
        found = error
    return "" if found == "ok" else " ".join(str(found).split())


def _connection(path: Path) -> sqlite3.Connection:
    """Open read-only and without locks, unless a log of writes must be read with the file."""
    how = "mode=ro" if _has_companion(path, "-wal") else "mode=ro&immutable=1"
    database = sqlite3.connect(f"file:{quote(str(path.absolute()))}?{how}", uri=True)
    database.text_factory = _text
    if sys.version_info >= (3, 11):
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _most(path))
    database.execute("PRAGMA trusted_schema = OFF")
    database.execute("PRAGMA writable_schema = ON")  # else a file that is cut is not opened at all; it is read only
    return database


def _most(path: Path) -> int:
    """The length of the longest text or blob that the file and its log can contain."""
    log = path.with_name(path.name + "-wal")
    size = path.stat().st_size + (log.stat().st_size if log.is_file() else 0)
    return min(MOST_BYTES, max(_LEAST_LIMIT, size))


def _has_companion(path: Path, ending: str) -> bool:
    file = path.with_name(path.name + ending)
    return file.is_file() and file.stat().st_size > 0


def _text(raw: bytes) -> str:
    return raw.decode(errors="replace")
