"""The run folder: everything a run leaves behind, written the same way by the node and by replay.

``graph.g2o`` and ``graph_vertices.csv`` (stamp and name of each vertex), ``ledger.csv`` and ``ledger_changes.csv``
(each edge, what is believed of it, and how that came: ``ledger_file``), ``path.tum``, ``covariances.csv``,
``sightings.tum``, ``odometry.tum``, ``landmarks.csv``, ``run.mcap``, ``ingest.mcap`` (the journal), ``map.mcap`` (the
map as it grew: ``map_log``), ``config.yaml``, ``run.json``.

Covariances are written as their upper triangle, row by row. Those of ``covariances.csv``, of each pose of ``path.tum``,
are in the pose's tangent space, with (x, y, theta) or (x, y, z, rotation vector) along and about the axes of the robot;
those of ``landmarks.csv`` are in the axes of map. What is not known is nan; what a point does not have is empty.
"""

import contextlib
import itertools
import json
import re
import time
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from graph_slam_ros import __version__
from graph_slam_ros.errors import ConfigError, GraphSlamError
from graph_slam_ros.formats.durable import NEW, AppendedFile, replaced, sync_folder
from graph_slam_ros.formats.g2o_writer import g2o_text
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.formats.ingest import INGEST, MEASUREMENT, Parts, close_all, part_name, parts_of, read_ingest
from graph_slam_ros.formats.parameters import parameters_text, read_parameters
from graph_slam_ros.formats.tum import tum_text
from graph_slam_ros.ledger_file import CHANGES, LEDGER, changes_text, ledger_text
from graph_slam_ros.map_log import GROWTH, MAP, Growth, grew, has_map, read_map, state_of
from graph_slam_ros.ros import results
from graph_slam_ros.ros.bag import BagWriter
from graph_slam_ros.slam import Config, Control, GraphSlam, Measurement, Update
from graph_slam_ros.slam.map_state import MapState
from graph_slam_ros.slam.measurements import from_record, to_record
from graph_slam_ros.solver.leverage import leverage

SUMMARY, COVARIANCES, _CONFIG = "run.json", "covariances.csv", "config.yaml"
GRAPH, VERTICES = "graph.g2o", "graph_vertices.csv"
Name = TypeVar("Name")
_RECORDED = re.compile(r"(ingest|map|run)(_\d+)?\.mcap")

_RESULTS = {
    SUMMARY,
    GRAPH,
    VERTICES,
    LEDGER,
    CHANGES,
    "path.tum",
    COVARIANCES,
    "sightings.tum",
    "odometry.tum",
    "landmarks.csv",
    "path.png",
}
_TANGENT = {3: ("x", "y", "theta"), 6: ("x", "y", "z", "rx", "ry", "rz")}
_POSE = {3: "x,y,theta", 6: "x,y,z,qx,qy,qz,qw"}
_PATH_GROWTH = 1.1  # the whole path is recorded again when it has grown by a tenth: its total stays linear
_TOGETHER = 256  # measurements that are written at once: one by one, as they come, each takes several times as long


class RunError(GraphSlamError):
    """A run folder that cannot be written or read."""


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run: an ingest sequence and the configuration it was taken with."""
    return folder.is_dir() and (folder / _CONFIG).is_file() and bool(parts_of(folder))


def is_cut_off(folder: Path) -> bool:
    """Whether the newest run, there or moved out of its way, holds something and was never ended."""
    earlier = earlier_runs(folder)
    newest = folder if _holds_something(folder) else earlier[max(earlier)] if earlier else folder
    if not _holds_something(newest):
        return False
    try:
        return not json.loads((newest / SUMMARY).read_text(encoding="utf-8"))["ended"]
    except (OSError, ValueError, LookupError, TypeError):
        return True


def _holds_something(folder: Path) -> bool:
    return is_run(folder) and (next(read_ingest(folder, []), None) is not None or grew(folder))


def map_of(folder: Path, losses: list[str]) -> MapState:
    """The map of a run: as it was written down, or where it was not, by repeating the drive.

    Raises
    ------
    RunError, FormatError
        There is none, or it cannot be read.
    """
    state = (read_map(folder, losses) if has_map(folder) else None) or _repeated(folder, losses)
    if not state.keyframes:
        raise RunError(f"{folder.name}: no keyframe, so there is no map")
    return state


def _repeated(folder: Path, losses: list[str]) -> MapState:
    slam = GraphSlam(run_config(folder), start=read_map(folder, losses, start_only=True))
    for record in read_ingest(folder, losses):
        slam.process(from_record(record))
    slam.process(Control("end"))
    return state_of(slam)


def taken_up(folder: Path, losses: list[str]) -> GraphSlam:
    """The map of a run, solved; as ``map_of``."""
    return GraphSlam(run_config(folder), start=map_of(folder, losses))


def settled(folder: Path, losses: list[str]) -> GraphSlam:
    """The same with all of it judged. Raises GraphSlamError, too, where it cannot be solved."""
    slam = taken_up(folder, losses)
    slam.process(Control("optimize"))
    if not slam.is_solved:
        raise RunError(f"{folder}: its map cannot be solved: {slam.failing}")
    return slam


def save_map(folder: Path, config: Config, state: MapState, losses: Sequence[str]) -> dict[str, Any]:
    """Write a run that begins in a map, which is then the run's, and does nothing but solve it; returns its summary."""
    recorder = RunRecorder(folder, config, start=state)
    try:
        slam = GraphSlam(config, recorder.sink, start=state)
        recorder.record(slam, slam.process(Control("optimize")))
        summary = summarize(slam) | {"losses": list(dict.fromkeys(losses))}
        recorder.save(slam, summary)
    finally:
        recorder.close()
    return summary


def freeze(folder: Path, out: Path) -> dict[str, Any]:
    """Write a run that begins in the map of another, all of which then stays as it is; returns its summary."""
    check_room(out, folder)
    losses: list[str] = []
    state = state_of(settled(folder, losses))
    state.freeze()
    return save_map(out, run_config(folder), state, losses)


def run_config(folder: Path) -> Config:
    """The configuration a run was made with. Raises ConfigError naming the file."""
    values = read_parameters(folder / _CONFIG)
    try:
        return Config.from_mapping(values)
    except GraphSlamError as error:
        raise ConfigError(f"{folder / _CONFIG}: {error}") from None


def check_room(folder: Path, source: Path | None = None) -> None:
    """Refuse a folder that holds anything but an earlier run, or the source that is about to be read.

    Raises
    ------
    RunError
        Nothing was touched.
    """
    try:
        if source is not None and folder.resolve() in (source.resolve(), source.resolve().parent):
            raise RunError(f"{folder}: cannot be read from and written to at once")
        if folder.exists() and not is_run(folder) and not all(map(_is_of_a_start, folder.iterdir())):
            raise RunError(f"{folder}: not empty and not an earlier run; nothing was written")
    except OSError as error:
        raise RunError(f"{folder}: {error.strerror}") from None


def keep_earlier(folder: Path, most: int) -> None:
    """Move an earlier run out of the way: to ``folder-1``, or one more than the last; so many of them are kept.

    One that holds nothing is not kept; one that was never ended is in any case. Of older ones the files that a run has
    are removed, and nothing else.
    """
    most = max(most, is_cut_off(folder))
    if not _holds_something(folder) or not most:
        return
    earlier = earlier_runs(folder)
    try:
        folder.rename(folder.with_name(f"{folder.name}-{max(earlier, default=0) + 1}"))
        for number in sorted(earlier)[: max(0, len(earlier) + 1 - most)]:
            _clear(earlier[number])
            with contextlib.suppress(OSError):  # somebody has put more into it
                earlier[number].rmdir()
    except OSError as error:
        raise RunError(f"{folder}: {error.strerror}") from None


def earlier_runs(folder: Path) -> dict[int, Path]:
    """Earlier runs beside a run folder, by number."""
    named = re.compile(re.escape(folder.name) + r"-([1-9]\d*)")
    there = folder.parent.iterdir() if folder.parent.is_dir() else ()
    found = {int(match[1]): run for run in there if (match := named.fullmatch(run.name))}
    return {number: run for number, run in found.items() if is_run(run)}


class RunRecorder:
    """Records a run while it goes on, and saves its results.

    What was accepted is in the journal once ``flush`` has returned. A disk that is full loses nothing: what could not
    be written is written when there is room.

    Parameters
    ----------
    folder : made if it is not there; an earlier run in it is replaced, other contents are refused
    sync_s : so often at most the disk is asked to take the journal, in a thread of its own; 0: at the end
    start : the map that the run goes on in
    """

    def __init__(self, folder: Path | str, config: Config, sync_s: float = 0.0, start: MapState | None = None) -> None:
        self.folder = Path(folder)
        self._sync_s, self._due_s = sync_s, 0.0
        self._disk = ThreadPoolExecutor(1, "journal") if sync_s else None
        self._syncing: Future[None] | None = None
        self._journal = Parts(self.folder, INGEST, MEASUREMENT)
        self._map = Parts(self.folder, MAP, GROWTH)
        self._accepted: list[Measurement] = []  # and not written yet
        self._growth = Growth(start)
        self._grown = self._growth.first
        self._bag: BagWriter | None = None
        self._bags = 0
        self._ended_bags: list[AppendedFile] = []
        self._next_path_at = 1.0
        _make_room(self.folder)
        self._journal.begin()  # from the start: it makes the folder a run
        try:
            self._journal.flush()
            self._put(_CONFIG, parameters_text(config.as_mapping()))
        except OSError as error:
            self._journal.abandon()
            raise RunError(f"{self.folder}: {error.strerror}") from None

    def sink(self, measurement: Measurement) -> None:
        """Append to the journal: the sink of ``GraphSlam``. Raises OSError as ``flush`` does."""
        self._accepted.append(measurement)
        if len(self._accepted) >= _TOGETHER or (self._sync_s and time.monotonic() >= self._due_s):
            self.flush()

    def flush(self) -> None:
        """Bring to the disk what was accepted and what came of it: before any of that is told to anybody.

        Raises
        ------
        OSError
            It is kept, and written by the next call that can; or the disk did not take what was flushed before.
        """
        self._fill()
        self._journal.flush()
        self._map.flush()  # last: it is never ahead of what it came of
        self._sync_if_due()

    def _fill(self) -> None:
        accepted, self._accepted = self._accepted, []
        self._journal.write([to_record(measurement) for measurement in accepted])
        grown, self._grown = self._grown, []
        self._map.write(grown)

    @property
    def unwritten(self) -> int:
        """Bytes of the journal that wait for room on the disk."""
        return self._journal.waiting + self._map.waiting

    def _sync_if_due(self) -> None:
        """The disk may take long: nobody waits for it, but the next that would ask it again."""
        now = time.monotonic()
        if self._disk is None or now < self._due_s or (self._syncing is not None and not self._syncing.done()):
            return
        before, self._syncing = self._syncing, self._disk.submit(self._sync)
        self._due_s = now + self._sync_s
        if before is not None:
            before.result()

    def _sync(self) -> None:
        self._journal.sync()
        self._map.sync()

    def record(self, slam: GraphSlam, update: Update) -> None:
        """Append what an update changed: the map, pose and TF, and the path and the landmarks when they have grown."""
        if not update or not slam.keyframes:
            return
        self._grown += self._growth.of(slam)
        stamp = slam.keyframes[-1].stamp_ns
        self._write("/tf", results.TF, stamp, results.map_to_odom(slam, stamp))
        self._write("/tf", results.TF, stamp, results.odom_to_base(slam))
        self._write("/pose", results.POSE, stamp, results.pose(slam))
        if len(slam.keyframes) >= self._next_path_at:
            self._next_path_at = len(slam.keyframes) * _PATH_GROWTH
            self._record_map(slam)

    def save(self, slam: GraphSlam, summary: dict[str, Any] | None = None) -> Path:
        """Write all results; recording may go on, in new parts of ``ingest`` and ``run``. Returns the folder.

        Raises
        ------
        RunError
            The folder cannot be written.
        """
        try:
            if slam.keyframes:
                self._record_map(slam)
            self.close()
            self._save_results(slam, summary or {})
        except OSError as error:
            raise RunError(f"{self.folder}: {error.strerror}") from None
        return self.folder

    def _save_results(self, slam: GraphSlam, summary: dict[str, Any]) -> None:
        """All that can be computed first, then file by file; the summary, the last, tells which belong together."""
        stamps = slam.sighting_poses.stamps_ns.tolist()
        ids, vertices = numbered(slam)
        texts = {
            GRAPH: g2o_text(G2oFile(slam.graph, ids), slam.solver.estimate),
            VERTICES: vertices,
            LEDGER: ledger_text(slam, ids),
            CHANGES: changes_text(slam),
            "path.tum": tum_text(slam.keyframes.stamps_ns.tolist(), slam.trajectory()),
            COVARIANCES: _covariance_table(slam),
            "sightings.tum": tum_text(stamps, slam.sighting_trajectory()),
            "odometry.tum": tum_text(stamps, slam.sighting_odometry()),
            "landmarks.csv": _landmark_table(slam),
        }
        files = {name: self._put(name, text) for name, text in texts.items()}
        told = summarize(slam) | summary | {"leverage": leverage(slam.solver) if slam.is_solved else {}, "files": files}
        self._put(SUMMARY, json.dumps(told, indent=2) + "\n")

    def _put(self, name: str, text: str) -> str:
        """Write a file whole or not at all; returns its CRC-32."""
        data = text.encode()
        with replaced(self.folder / name) as new:
            new.write_bytes(data)
        return f"{zlib.crc32(data):08x}"

    def close(self) -> None:
        """End the present part of the recording.

        Raises
        ------
        OSError
            What the disk did not take is kept: the next ``flush`` or ``close`` tries again.
        """
        self._fill()
        failed = self._syncing.exception() if self._syncing is not None else None
        self._syncing = None
        if self._disk is not None:  # its thread ends; another comes with the next sync
            self._disk.shutdown(wait=False)
            self._disk = ThreadPoolExecutor(1, "journal")
        if self._bag is not None:
            self._ended_bags.append(self._bag.end())
            self._bag, self._bags = None, self._bags + 1
        self._journal.end()
        self._map.end()
        close_all(self._ended_bags)
        if failed is not None:
            raise failed

    def _record_map(self, slam: GraphSlam) -> None:
        stamp = slam.keyframes[-1].stamp_ns
        self._write("/path", results.PATH, stamp, results.path(slam))
        self._write("/landmarks", results.LANDMARKS, stamp, results.landmarks(slam))

    def _write(self, topic: str, type_name: str, stamp_ns: int, cdr: bytes) -> None:
        if self._bag is None:
            self._bag = BagWriter(self.folder / part_name("run", self._bags))
        self._bag.write(topic, type_name, stamp_ns, cdr)


def summarize(slam: GraphSlam) -> dict[str, Any]:
    """What happened, in numbers."""
    last = slam.report
    return {
        "version": __version__,
        "keyframes": len(slam.keyframes),
        "landmarks": len(slam.landmarks),
        "waiting": slam.waiting,
        "segments": len(slam.segments),
        "sightings": sum(landmark.sightings for landmark in slam.landmarks.values()),
        "edges": slam.graph.edge_count,
        "solves": slam.solves,
        "chi2": last.chi2_final if last else 0.0,
        "cost": last.cost_final if last else 0.0,
        "ended": True,
        "converged": last.converged if last else True,
        "stop": last.stop if last else "nothing_to_do",
        "classes": {name: asdict(share) for name, share in (last.classes if last else {}).items()},
        "rivals": [asdict(rival) for rival in slam.backend.rivals],
        "span_s": (slam.keyframes[-1].stamp_ns - slam.keyframes[0].stamp_ns) * 1e-9 if slam.keyframes else 0.0,
        "counters": slam.counters.as_dict(),
    }


def numbered(slam: GraphSlam) -> tuple[list[int], str]:
    """The number of each vertex, and the table of them.

    Poses are numbered from 0 in order of time, landmarks after them: other tools read odometry from that. What is
    neither is an offset that the ranges of a sensor share.
    """
    names: list[tuple[int, str, int | str, str]] = []
    for k, keyframe in enumerate(slam.keyframes):
        names.append((keyframe.vertex, "keyframe", keyframe.stamp_ns, str(k)))
    for name, landmark in slam.landmarks.items():
        names.append((landmark.vertex, "landmark", "", name))
    named = {vertex for vertex, *_ in names}
    names += [(vertex, "offset", "", "") for vertex in range(slam.graph.vertex_count) if vertex not in named]
    ids = [0] * slam.graph.vertex_count
    rows = ["id,vertex,stamp_ns,name"]
    for file_id, (vertex, what, stamp, name) in enumerate(names):
        ids[vertex] = file_id
        rows.append(f"{file_id},{what},{stamp},{_csv(name)}")
    return ids, "\n".join(rows) + "\n"


def _covariance_table(slam: GraphSlam) -> str:
    dof = slam.config.space.dof
    rows = [f"stamp_ns,{','.join(f'tangent_{a}{b}' for a, b in _upper(_TANGENT[dof]))}"]
    for stamp_ns, covariance in zip(slam.keyframes.stamps_ns, slam.keyframe_covariances(), strict=True):
        rows.append(f"{stamp_ns},{','.join(map(repr, covariance[np.triu_indices(dof)].tolist()))}")
    return "\n".join(rows) + "\n"


def _landmark_table(slam: GraphSlam) -> str:
    space = slam.config.space
    rows = [f"id,kind,{_POSE[space.dof]},sightings,{','.join(f'cov_{a}{b}' for a, b in _upper(_TANGENT[space.dof]))}"]
    for name, value, covariance in results.landmark_estimates(slam):
        kind = "pose" if len(value) == space.pose.size else "point"
        at = [*map(repr, value), *[""] * (space.pose.size - len(value))]
        spread = [f"{covariance[i, j]:.9e}" if j < len(covariance) else "" for i, j in _upper(range(space.dof))]
        rows.append(",".join([_csv(name), kind, *at, str(slam.landmarks[name].sightings), *spread]))
    return "\n".join(rows) + "\n"


def _upper(names: Sequence[Name]) -> Iterator[tuple[Name, Name]]:
    """Pairs of the upper triangle of a matrix, row by row."""
    return itertools.combinations_with_replacement(names, 2)


def _csv(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\n\r') else text


def _is_of_a_start(file: Path) -> bool:
    """What a run that was stopped as it began may have left, before its folder can be told for a run."""
    return file.name.removesuffix(NEW) == _CONFIG or _RECORDED.fullmatch(file.name) is not None


def _make_room(folder: Path) -> None:
    check_room(folder)
    try:
        if not folder.exists():
            folder.mkdir(parents=True)
            sync_folder(folder.parent)
        _clear(folder)
    except OSError as error:
        raise RunError(f"{folder}: {error.strerror}") from None


def _clear(folder: Path) -> None:
    """What makes it a run goes last: who is stopped half-way leaves a folder that may be cleared again."""
    there = sorted(folder.iterdir(), reverse=True)
    results = [file for file in there if file.name.removesuffix(NEW) in _RESULTS]
    for file in results + [file for file in there if _is_of_a_start(file)]:
        file.unlink()
