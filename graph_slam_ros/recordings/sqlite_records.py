"""Topics and messages of a rosbag2 sqlite3 file: read only, in order of writing, up to the first damage.

rosbags sorts the file by time, so that one bad page makes all of it unreadable.
"""

import sqlite3
import sys
from collections.abc import Collection, Iterator
from contextlib import closing, suppress
from pathlib import Path
from urllib.parse import quote

from graph_slam_ros.errors import FormatError
from graph_slam_ros.recordings.decompression import MOST_BYTES
from graph_slam_ros.recordings.part import BagMessage, Part, Topic

MAGIC = b"SQLite format 3\x00"
_DEFINITIONS = "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
_LEAST_LIMIT = 2**20  # bytes of a text or blob; none is longer than the file
_ALL_ROWS = "SELECT topic_id, timestamp, CASE WHEN topic_id IN ({}) THEN data END FROM messages ORDER BY id"


class SqlitePart(Part):
    """A file of rosbag2. Raises FormatError if it is not one, or if its topics cannot be read."""

    def __init__(self, file: Path) -> None:
        super().__init__(file)
        self._damage: str | None = None  # not looked for yet: it takes as long as reading
        try:
            with closing(_connection(file)) as database:
                _refuse_others(database, file)
                rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
                counts, self.first_ns = _counted(database)
                definitions: dict[str, str] = {}
                with suppress(sqlite3.Error):  # before Iron there are none
                    definitions = dict(database.execute(_DEFINITIONS))
            self._names = {int(number): str(name) for number, name, _, _ in rows}
        except (sqlite3.Error, TypeError, ValueError) as error:
            raise FormatError(f"{file}: not a readable recording ({error})") from None
        self.topics = [
            Topic(str(name), str(kind), counts.get(number, 0), definitions.get(kind, ""), str(code))
            for number, name, kind, code in rows
        ]

    def messages(self, topics: Collection[str], losses: list[str], warnings: list[str]) -> Iterator[BagMessage]:
        """Messages in order of writing. What is lost adds to ``losses``."""
        name, known, read = self.file.name, len(losses), 0
        names = {number: topic for number, topic in self._names.items() if topic in topics}
        if _has_companion(self.file, "-journal"):
            losses.append(f"{name}: its recorder was stopped while it wrote; what it wrote last may be lost")
        with closing(_connection(self.file)) as database:
            marks = ", ".join("?" * len(names))
            try:
                # All rows: of a search for some, the last before the damage is lost, which may be all of /tf_static.
                for number, stamp, data in database.execute(_ALL_ROWS.format(marks), list(names)):
                    if number not in names:
                        continue
                    if isinstance(number, int) and isinstance(stamp, int) and isinstance(data, bytes):
                        read += 1
                        yield BagMessage(names[number], stamp, data)
                    else:
                        losses.append(f"{name}: a message without time or content was passed over")
            except sqlite3.Error as error:
                losses.append(f"{name}: cut off after {read} messages ({error})")
        if self._damage is None:
            self._damage = _damage(self.file)
        if self._damage and len(losses) == known:
            losses.append(f"{name}: damaged ({self._damage})")


def _refuse_others(database: sqlite3.Connection, path: Path) -> None:
    """Raise FormatError for other databases, and for computed columns: a few bytes may then produce gigabytes."""
    kinds = dict(database.execute("SELECT name, type FROM sqlite_master WHERE type IN ('table', 'view')"))
    if not kinds.get("topics") == kinds.get("messages") == "table":
        rtabmap = "a map of RTAB-Map: rtabmap-databaseViewer exports its graph as g2o"
        why = rtabmap if {"Node", "Link"} <= kinds.keys() else "no tables of rosbag2 in it"
        raise FormatError(f"{path}: not a readable recording: {why}")
    for table in ("topics", "messages", "message_definitions"):
        for _, name, *_, is_hidden in database.execute(f"PRAGMA table_xinfo({table})").fetchall():
            if is_hidden:
                raise FormatError(f"{path}: not a readable recording: the column {name} of {table} is computed")


def _counted(database: sqlite3.Connection) -> tuple[dict[int, int], int]:
    """Messages by topic, and the time of the first, up to the first damage."""
    counts, first_ns = dict[int, int](), 2**64
    with suppress(sqlite3.Error):
        for topic, stamp in database.execute("SELECT topic_id, timestamp FROM messages ORDER BY id"):
            if isinstance(topic, int) and isinstance(stamp, int):
                counts[topic] = counts.get(topic, 0) + 1
                first_ns = min(first_ns, stamp)
    return counts, first_ns if counts else 0


def _damage(path: Path) -> str:
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
    database.text_factory = lambda raw: raw.decode(errors="replace")
    if sys.version_info >= (3, 11):
        log = path.with_name(path.name + "-wal")
        size = path.stat().st_size + (log.stat().st_size if log.is_file() else 0)
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(MOST_BYTES, max(_LEAST_LIMIT, size)))
    database.execute("PRAGMA trusted_schema = OFF")
    database.execute("PRAGMA writable_schema = ON")  # else a file that is cut is not opened at all; it is read only
    return database


def _has_companion(path: Path, ending: str) -> bool:
    file = path.with_name(path.name + ending)
    return file.is_file() and file.stat().st_size > 0
