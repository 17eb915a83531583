"""Records a run while it goes on, and saves its results."""

import contextlib
import json
import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from typing import Any

from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.formats.parameters import parameters_text
from graph_slam_ros.measurements.types import to_record
from graph_slam_ros.messages import results
from graph_slam_ros.recordings.bag import BagWriter
from graph_slam_ros.runs.condensed_map import WholePath, carried, left_records
from graph_slam_ros.runs.folder import (
    CONFIG,
    MARK,
    SUMMARY,
    RunError,
    checksum,
    discard,
    recorded_files,
    room,
    summary_of,
)
from graph_slam_ros.runs.journal import (
    CONDENSED,
    CORRECTION,
    IN_A_MAP,
    INGEST,
    LEFT,
    MAP,
    START,
    PartedFile,
    RecordWriter,
)
from graph_slam_ros.runs.map_file import write_map
from graph_slam_ros.runs.tables import counted, result_texts, summarize
from graph_slam_ros.slam import Config, Counters, GraphSlam, MapView, Measurement, Update
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.typing import Numbers

_TAIL_S = 3.0  # CPU time since the newest map was written, which a restart spends again: until the next
_BYTES_PER_S = 3e8 / 3600  # of maps, at most: a larger one is written more rarely
_PATH_GROWTH = 1.1  # the whole path is recorded again when it has grown by a tenth: its total stays linear
_JUMPED_GROWTH, _JUMP_M = 1.01, 0.5  # or by a hundredth, when a solve has moved the robot so far
_TOGETHER = 256  # measurements that are written at once: one by one, as they come, each takes several times as long
_LOADS = ("keyframes", "cpu_s", "memory_mib", "backlog")
_MOST_SAMPLES = 200  # of the load: then every second one is dropped, and half as many are added
_PER_MIB = 2**20 if sys.platform == "darwin" else 2**10  # of the kernel's unit: bytes on macOS, KiB on Linux


class RunRecorder:
    """Records a run while it goes on, and saves its results.

    What was accepted is in the journal once ``flush`` has returned. A full disk loses nothing: what could not be
    written is written when there is room. Now and then the whole map is written, in the background; a restart goes on
    from there with the rest of the journal. One thread accepts measurements (``accept``), and another one processes
    them and makes all other calls. Both may call ``leave``.

    Parameters
    ----------
    folder : made if it is not there; anything in it is refused but a run that holds nothing
    force : a run that holds something is replaced, too
    sync_s : so often at most the disk is asked to take the journal, in a thread of its own; 0: at the end
    start, accepted : the map that the run goes on in, and the measurements that it has accepted before this journal
    """

    def __init__(
        self,
        folder: Path | str,
        config: Config,
        sync_s: float = 0.0,
        start: MapSnapshot | None = None,
        *,
        force: bool = False,
        accepted: int = 0,
    ) -> None:
        self.folder = Path(folder)
        self._sync_s, self._due_s = sync_s, 0.0
        # for a flush, a sync and a map at once: the flush may wait for somebody who waits for the sync
        self._disk = ThreadPoolExecutor(3, "journal")
        self._writing = threading.RLock()
        self._is_ended = False
        self._flushing: Future[None] | None = None
        self.accepted = accepted  # measurements, written or not
        self._syncing: Future[None] | None = None
        self._journal = PartedFile(self.folder, INGEST, RecordWriter)
        self._left = PartedFile(self.folder, CONDENSED, lambda file: RecordWriter(file, LEFT))
        self._results = PartedFile(self.folder, "run", BagWriter)
        self._accepted: deque[Measurement] = deque()  # and not written yet
        self._noted: list[dict[str, Any]] = []  # the newest correction, until the next flush
        self._before = accepted
        self._mapping: Future[None] | None = None
        self._map_due_s = 0.0
        self._map_cpu_s = -math.inf if accepted else time.process_time()  # what waits now is in no journal
        self._path_recorded = 0  # keyframes
        self._load = ResourceLog()
        self._room = ExitStack()
        self._room.enter_context(room(self.folder, force=force))
        try:
            self._journal.present().write([IN_A_MAP] if start is not None else [])
            self._journal.flush()
            if start is not None:
                self._begin_in(start, config)
            _put(self.folder, CONFIG, parameters_text(config.as_mapping()))
        except (KeyboardInterrupt, FormatError):
            self.discard()
            raise
        except OSError as error:
            self.abandon()
            raise RunError(f"{self.folder}: {error.strerror}") from None

    def _begin_in(self, start: MapSnapshot, config: Config) -> None:
        """Write the map that the run goes on in, and take over what has left it."""
        if start.bounded is not None and start.folder is not None:
            self._left.present().write(carried(start.folder, config.space, start.bounded))
            self._left.flush()
        if not self.accepted:  # a new drive begins
            start = replace(start, used_ns=None, drive={})
        write_map(self.folder / START, replace(start, processed=0, settings={}))

    def accept(self, measurement: Measurement) -> None:
        """Add a measurement to the journal. It is kept in memory until ``flush`` or ``flush_in_background``."""
        self._accepted.append(measurement)
        self.accepted += 1

    def note_correction(self, T_map_odom: Numbers, source: str) -> None:
        """Note the present correction of an odometry for the next start: the next flush writes it."""
        self._noted = [{"type": CORRECTION, "T_map_odom": T_map_odom, "source": source}]

    def flush_in_background(self) -> None:
        """Write accepted measurements in a thread, because the thread that processes them may be busy for long."""
        if self._accepted and not self._is_ended and (self._flushing is None or self._flushing.done()):
            with contextlib.suppress(RuntimeError):  # the recording has just been ended
                self._flushing = self._disk.submit(self._flush_journal)

    def _flush_journal(self) -> None:
        with contextlib.suppress(OSError), self._writing:  # it waits, and the next flush raises that again
            if not self._is_ended:
                self._fill_journal()
                self._journal.flush()
                if self._syncing is None or (self._syncing.done() and not self._syncing.exception()):
                    self._syncing = self._sync_if_due()

    def sink(self, measurement: Measurement) -> None:
        """Append to the journal: the sink of ``GraphSlam``. Raises OSError as ``flush`` does."""
        self.accept(measurement)
        if len(self._accepted) >= _TOGETHER or (self._sync_s and time.monotonic() >= self._due_s):
            self.flush()

    def flush(self) -> None:
        """Write accepted measurements and their results to disk, before any result is published.

        Raises OSError: it is kept, and written by the next call that can; or the disk did not take what was flushed
        before.
        """
        with self._writing:
            if self._is_ended:
                return
            self._fill_journal()
            self._journal.flush()
            self._left.flush()
            if self._mapping is not None and self._mapping.done():
                written, self._mapping = self._mapping, None
                written.result()
            if self._syncing is None or self._syncing.done():
                synced, self._syncing = self._syncing, self._sync_if_due()
                if synced is not None:
                    synced.result()

    def _fill_journal(self) -> None:
        if records := [to_record(self._accepted.popleft()) for _ in range(len(self._accepted))] + self._noted:
            self._noted = []
            self._journal.present().write(records)

    @property
    def unwritten(self) -> int:
        """The number of bytes of the journal that are not on the disk."""
        return self._journal.unwritten + self._left.unwritten

    def _sync_if_due(self) -> Future[None] | None:
        """Start to sync in the background, because the disk may be slow."""
        now = time.monotonic()
        if not self._sync_s or now < self._due_s:
            return None
        self._due_s = now + self._sync_s
        return self._disk.submit(self._sync)

    def join_sync(self) -> None:
        """Wait until the disk has synced. Raises OSError once if it failed."""
        asked, self._syncing = self._syncing, None
        if asked is not None:
            asked.result()

    def _sync(self) -> None:
        self._journal.sync()
        self._left.sync()

    def record(self, slam: GraphSlam, update: Update) -> None:
        """Append what an update changed: pose and TF, and the path, the landmarks and the map when that is due."""
        view = slam.view
        if not update or not view.keyframes:
            return
        self._load.add(len(view.keyframes), max(0, self.accepted - slam.processed))
        with self._writing:
            if self._is_ended:
                return
            if update.condensed is not None:
                self._left.present().write(list(left_records(update.condensed)))
            stamp = view.keyframes[-1].stamp_ns
            self._write("/tf", results.TF, stamp, results.map_to_odom(view, stamp))
            self._write("/tf", results.TF, stamp, results.odom_to_base(view))
            self._write("/pose", results.POSE, stamp, results.pose(view))
            growth = _JUMPED_GROWTH if view.correction.distance_m > _JUMP_M else _PATH_GROWTH
            if len(view.keyframes) >= self._path_recorded * growth:
                self._path_recorded = len(view.keyframes)
                self._record_map(view)
            is_due = time.process_time() >= self._map_cpu_s + _TAIL_S and time.monotonic() >= self._map_due_s
            if is_due and update.keyframes and self._mapping is None:  # between keyframes odometry would be lost
                self.flush()  # a map is never ahead of what it came of
                self._map_cpu_s, state = time.process_time(), self._snapshot(slam)
                self._mapping = self._disk.submit(self._write_map, state)

    def _snapshot(self, slam: GraphSlam) -> MapSnapshot:
        return replace(slam.view.snapshot(), processed=max(0, slam.processed - self._before))

    def _write_map(self, state: MapSnapshot) -> None:
        """Write the whole map; the next one waits until the disk has had time for it."""
        self._sync()
        begin_s = time.monotonic()
        self._map_due_s = begin_s + write_map(self.folder / MAP, state) / _BYTES_PER_S

    def _join_map(self) -> None:
        """Wait for a map that is being written. If it cannot be, the journal has all of it."""
        if self._mapping is not None:
            wait([self._mapping])
        self._mapping = None

    def save(self, slam: GraphSlam, summary: dict[str, Any] | None = None) -> Path:
        """Write all results. Recording may go on, in new parts. Returns the folder; raises RunError if it refuses."""
        try:
            with self._writing:
                self._refuse_if_ended()
                if slam.view.keyframes:
                    self._record_map(slam.view)
                self._end_parts()
                if slam.view.keyframes:
                    self._write_map(self._snapshot(slam))
                parts: dict[str, Any] = {"recorded": recorded_files(self.folder)}
            parts |= {"unprocessed": max(0, self.accepted - slam.processed), "load": self._load.as_dict()}
            save_results(self.folder, slam, (summary or summarize(slam)) | parts, self._refuse_if_ended)
        except OSError as error:
            raise RunError(f"{self.folder}: {error.strerror}") from None
        return self.folder

    def _refuse_if_ended(self) -> None:
        if self._is_ended:
            raise RunError(f"{self.folder}: its recording has been ended")

    def leave(self, processed: int, keyframes: int, counters: Counters) -> int:
        """End the recording before everything was processed, and note that in the summary. Returns how many are left.

        What was saved until now stays; ``complete`` makes the results of the whole. Raises OSError.
        """
        unprocessed = max(0, self.accepted - processed)
        with self._writing:
            if self._is_ended:
                return 0
            self._end_parts()
            now = {"ended": True, "keyframes": keyframes, "unprocessed": unprocessed, "load": self._load.as_dict()}
            now["is_incomplete"] = bool(unprocessed or keyframes)
            now["recorded"] = recorded_files(self.folder)
            contents = summary_of(self.folder) | now | counted(counters)
            _put(self.folder, SUMMARY, json.dumps(contents, indent=2) + "\n")
            self._end()
            self._room.close()
        return unprocessed

    def close(self) -> None:
        """End the recording, and release the folder. Raises OSError; the next ``flush`` or ``close`` tries again."""
        with self._writing:
            self._end_parts()
            self._end()
            self._room.close()

    def abandon(self) -> None:
        """End the recording as it is on the disk. What is in memory is lost."""
        with self._writing, self._room:
            self._abandon()

    def discard(self) -> None:
        """End the recording, and remove its files if it was never saved."""
        with self._writing, self._room:
            self._abandon()
            discard(self.folder)

    def _abandon(self) -> None:
        self._end()
        self._join_map()
        for parts in (self._journal, self._left, self._results):
            parts.abandon()

    def _end(self) -> None:
        self._is_ended = True
        self._disk.shutdown(wait=False)

    def _end_parts(self) -> None:
        """End the present parts, and begin the next ones with the next record."""
        self._fill_journal()
        failed = self._syncing.exception() if self._syncing is not None else None
        self._syncing = None
        self._join_map()
        for parts in (self._journal, self._left, self._results):
            parts.end()
        if failed is not None:
            raise failed

    def _record_map(self, view: MapView) -> None:
        stamp = view.keyframes[-1].stamp_ns
        self._write("/path", results.PATH, stamp, results.path(view))
        self._write("/landmarks", results.LANDMARKS, stamp, results.landmarks(view))

    def _write(self, topic: str, type_name: str, stamp_ns: int, cdr: bytes) -> None:
        self._results.present().write(topic, type_name, stamp_ns, cdr)


class ResourceLog:
    """CPU time, memory and backlog at updates, in samples evenly spaced over the run, whatever its length.

    The memory is the most that was resident until then. The backlog of a sample is the largest since the sample
    before: measurements accepted and not processed.
    """

    def __init__(self) -> None:
        self._begun = time.process_time()
        self._every, self._next, self._backlog = 1, 0, 0
        self._rows: list[tuple[int, float, float, int]] = []

    def add(self, keyframes: int, backlog: int) -> None:
        """Add an update, after which there are so many keyframes."""
        self._backlog = max(self._backlog, backlog)
        self._next -= 1
        if self._next > 0:
            return
        memory_mib = round(getrusage(RUSAGE_SELF).ru_maxrss / _PER_MIB, 1)
        self._rows.append((keyframes, round(time.process_time() - self._begun, 3), memory_mib, self._backlog))
        if len(self._rows) >= _MOST_SAMPLES:
            self._every *= 2
            kept = self._rows[1::2]
            before = self._rows[::2]
            self._rows = [(*k[:3], max(k[3], b[3])) for k, b in zip(kept, before, strict=True)]
        self._next, self._backlog = self._every, 0

    def as_dict(self) -> dict[str, list[Any]]:
        """A column each for keyframes, CPU seconds since the begin, MiB and backlog; nothing without an update."""
        return {name: [row[k] for row in self._rows] for k, name in enumerate(_LOADS)} if self._rows else {}


def save_results(
    folder: Path, slam: GraphSlam, summary: dict[str, Any], check: Callable[[], None] = lambda: None
) -> None:
    """Compute everything, then write file after file. The summary is last; it says which files belong together.

    Parameters
    ----------
    check : called before each file; where it raises, no more is written
    """

    def put(name: str, text: str) -> str:
        check()
        return _put(folder, name, text)

    texts = result_texts(slam.view, WholePath.of(slam.view, folder))
    files = {name: put(name, text) for name, text in texts.items()}
    put(SUMMARY, json.dumps({"format": MARK} | summary | {"files": files}, indent=2) + "\n")


def _put(folder: Path, name: str, text: str) -> str:
    """Write a file completely or not at all. Returns its CRC-32."""
    data = text.encode()
    write_whole(folder / name, data)
    return checksum(data)
