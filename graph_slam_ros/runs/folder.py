"""Run folders: which folder is a run, which run is the newest, and which files may be replaced.

A folder is a run if its ``run.json`` says so (``format``), which is written when the run starts. Only such a folder is
ever cleared, and only of the files of a run. A recording in it is read before it is removed. A run whose ``run.json``
is lost or damaged is recognised by its journal. It is read like others, and never cleared.
"""

import contextlib
import errno
import hashlib
import itertools
import json
import os
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.records import Channel, Schema

from graph_slam_ros import __version__
from graph_slam_ros.config import Config
from graph_slam_ros.errors import ConfigError, FormatError, GraphSlamError, similar_file
from graph_slam_ros.formats.durable import NEW, claimed, sync_folder, write_whole
from graph_slam_ros.formats.files import is_regular, opened, read_bytes, read_text
from graph_slam_ros.formats.parameters import read_parameters
from graph_slam_ros.recordings.mcap_records import begin, records
from graph_slam_ros.runs.journal import CHANGES, CONDENSED, INGEST, LEDGER, MAP, SCHEMAS, START, parts_of, read_ingest

SUMMARY, CONFIG = "run.json", "config.yaml"
GRAPH, VERTICES, COVARIANCES = "graph.g2o", "graph_vertices.csv", "covariances.csv"
PATH, PATH_ODOMETRY = "path.tum", "path_odometry.tum"  # at keyframes: estimate, and what odometry alone says
SIGHTINGS, ODOMETRY = "sightings.tum", "odometry.tum"  # the same at the stamps of sightings
LANDMARKS, PICTURE, REPORT = "landmarks.csv", "path.png", "report.html"
_PATHS = {PATH, PATH_ODOMETRY, SIGHTINGS, ODOMETRY, COVARIANCES}
_RESULTS = {SUMMARY, GRAPH, VERTICES, LEDGER, CHANGES, LANDMARKS, PICTURE, *_PATHS}
MARK = "graph_slam_ros run"
"""The ``format`` of the ``run.json`` of a run."""
BEGUN = json.dumps({"format": MARK, "version": __version__, "ended": False}).encode()
"""The ``run.json`` of a run until it is saved."""
_RECORDED = re.compile(r"(ingest|map|start|condensed|run)(_\d+)?\.mcap")
_UNFINISHED = re.compile(r"\.[0-9a-f]{8}" + re.escape(NEW))
_OF_RECORDINGS = re.compile(r"(\.(mcap|db3|bag|active|zstd|gz))+$")
_NO_FILE = (errno.ENOENT, errno.ENOTDIR)
_ENDS = 2**16
_MADE = "graph_slam replay BAG --out RUN makes a run of a recording, graph_slam optimize of a graph"
_NOT_A_FILE = "not a regular file"  # in place of a mark
_MOST_SEARCHED, _MOST_NAMED = 200, 3  # folders in one that is not a run
_TOPICS = {"/tf", "/pose", "/path", "/landmarks"}


class RunError(GraphSlamError):
    """A run folder that cannot be written or read."""


def is_run(folder: Path) -> bool:
    """Return whether a folder holds a run: its ``run.json`` says so, or that is lost, and it has a journal.

    Raises RunError where the disk fails to tell: nobody may take a run for another thing.
    """
    if not folder.is_dir():
        return False
    try:
        return _is_marked(folder) or (is_regular(folder / CONFIG) and any(map(_is_recorded, parts_of(folder)[:1])))
    except OSError:  # its journal cannot be read
        return False


def _is_marked(folder: Path) -> bool:
    return summary_of(folder).get("format") == MARK


def _is_recorded(file: Path) -> bool:
    """Return whether a file with the name of a run's recording is one, by its head and its first record."""
    name = _RECORDED.fullmatch(file.name)
    if name is None or not is_regular(file):
        return False
    head = begin("ros2" if name[1] == "run" else "")
    with opened(file) as stream:
        there = stream.read(len(head))
    if there != head:
        return head.startswith(there)  # torn as it began
    kind = Channel if name[1] == "run" else Schema
    first = next((r for r in records(file, [], follow=False) if isinstance(r, kind)), None)
    if isinstance(first, Channel):
        return first.topic in _TOPICS
    return first is None or first.name == SCHEMAS[name[1]]


def check_run(folder: Path) -> None:
    """Raise RunError where a folder is not a run."""
    if is_run(folder):
        return
    if not os.path.lexists(folder):
        raise RunError(f"{folder}: not a run's folder: there is nothing of that name{similar_file(folder)}")
    if is_recording(folder):
        what = "a recording" if folder.is_dir() else "a file"
        raise RunError(f"{folder}: not a run's folder, but {what}: {_MADE}")
    runs = list[str]()
    with contextlib.suppress(OSError):  # then none is named
        inside = itertools.islice(sorted(folder.iterdir()), _MOST_SEARCHED)
        runs = [str(one) for one in inside if one.is_dir() and is_run(one)][:_MOST_NAMED]
    raise RunError(f"{folder}: not a run's folder" + (f"; in it there are runs: {', '.join(runs)}" if runs else ""))


def is_cut_off(folder: Path) -> bool:
    """Return whether the newest run, in place or moved away, has contents and never ended."""
    earlier = earlier_runs(folder)
    newest = folder if _holds_something(folder) else earlier[max(earlier)] if earlier else folder
    if not _holds_something(newest):
        return False
    return not summary_of(newest).get("ended")


def incomplete_runs(folder: Path) -> list[Path]:
    """Earlier runs that ended before all accepted measurements were processed, the newest first."""
    return [run for _, run in sorted(earlier_runs(folder).items(), reverse=True) if is_incomplete(run)]


def is_incomplete(folder: Path) -> bool:
    """Return whether a run ended before all accepted measurements were processed: its results are incomplete."""
    return summary_of(folder).get("is_incomplete") is True


def was_saved_whole(folder: Path) -> bool:
    """Return whether the map of a run includes all of its journal, by its summary."""
    return summary_of(folder).get("unprocessed") == 0 and not _went_on(folder)


def _holds_something(folder: Path) -> bool:
    if not is_run(folder) or summary_of(folder).get("keyframes"):
        return is_run(folder)
    try:
        has_map = any(os.path.lexists(folder / name) for name in (MAP, START))
        return has_map or next(read_ingest(folder, []), None) is not None
    except (FormatError, OSError):  # who knows
        return True


def summary_of(folder: Path) -> dict[str, Any]:
    """The summary; empty where there is none, or no JSON in it. Raises RunError where it is there and unreadable."""
    try:
        recorded = json.loads(read_text(folder / SUMMARY))
    except OSError as error:
        if error.errno not in _NO_FILE:
            raise RunError(f"{folder / SUMMARY}: {error.strerror}") from None
        return {}
    except (ValueError, RecursionError):
        return {}
    return recorded if isinstance(recorded, dict) else {}


def recording_of(folder: Path) -> str:
    """The name of the recording that a run was replayed from; empty if it was a live run, or is unknown."""
    name = summary_of(folder).get("recording", "")
    return name if isinstance(name, str) else ""


def is_recording(path: Path) -> bool:
    """Return whether a path is that of a recording by its form: a file, or a folder of rosbag2."""
    return path.is_file() or (path / "metadata.yaml").exists()


def run_config(folder: Path) -> Config:
    """The configuration a run was made with. Raises ConfigError naming the file."""
    if not os.path.lexists(folder / CONFIG):
        made = f"; {_MADE}" * is_recording(folder)
        raise ConfigError(f"{folder}: not a run: no {CONFIG} in it{made or similar_file(folder)}")
    values = read_parameters(folder / CONFIG, follow=False)
    try:
        return Config.of_saved_run(values)
    except GraphSlamError as error:
        raise ConfigError(f"{folder / CONFIG}: {error}") from None


def changed_since(folder: Path) -> list[str]:
    """Files that differ from those of ``run.json``: from an interrupted save, exchanged, or edited."""
    out = list(dict.fromkeys([*_not_as_saved(folder, "files"), *_not_as_saved(folder, "recorded")]))
    if _went_on(folder) or is_incomplete(folder):
        out.append("the run went on after its results were saved: graph_slam recover has those of its end")
    return out


def missing(folder: Path) -> list[str]:
    """The recordings that are missing, or others than when the run was saved."""
    return list(_not_as_saved(folder, "recorded"))


def _went_on(folder: Path) -> bool:
    """Return whether more was accepted after a run was saved: in parts that its summary does not know."""
    known = _marks(folder, "recorded")
    parts = [file.name for name in (INGEST, CONDENSED) for file in parts_of(folder, name)]
    return bool(known) and not known.keys() >= set(parts)


def _marks(folder: Path, kind: str) -> dict[str, Any]:
    """The marks of files in the summary of a run, by name; none where it was not saved."""
    marks = summary_of(folder).get(kind)
    return marks if isinstance(marks, dict) else {}


def _not_as_saved(folder: Path, kind: str) -> Iterator[str]:
    """The files whose checksum differs from the summary's, and those that are missing or unreadable."""
    if not summary_of(folder) and os.path.lexists(folder / SUMMARY):
        yield f"{SUMMARY} is not the summary of a run: whether its files belong together is not known"
    replaced = {MAP} if _went_on(folder) else set[str]()
    for name, mark in sorted(_marks(folder, kind).items()):
        if name in replaced:
            continue
        if name in _RESULTS or name == CONFIG or _RECORDED.fullmatch(name):  # no path out of the folder
            try:
                if mark != (ends_of(folder / name) if kind == "recorded" else checksum(read_bytes(folder / name))):
                    yield f"{name} is not the one that {SUMMARY} was saved with"
            except FileNotFoundError:
                yield f"{name} is missing, with which {SUMMARY} was saved"
            except OSError as error:
                yield f"{name} cannot be read: {error.strerror}"


def recorded_files(folder: Path) -> dict[str, str]:
    """Return what tells the recordings and the configuration of a run from those of another. Raises OSError.

    Somebody may have removed the configuration meanwhile, or put a link there: results are saved all the same.
    """
    parts = [file for name in (INGEST, CONDENSED) for file in parts_of(folder, name)]
    others = [file for name in (START, MAP, CONFIG) if os.path.lexists(file := folder / name)]
    return {file.name: ends_of(file) if is_regular(file) else _NOT_A_FILE for file in (*parts, *others)}


def ends_of(file: Path) -> str:
    """Size and CRC-32 of the first and the last 64 KiB: it takes no longer for a long recording. Raises OSError."""
    with opened(file) as stream:
        size = os.fstat(stream.fileno()).st_size
        first = stream.read(_ENDS)
        stream.seek(max(0, size - _ENDS))
        return f"{size}-{checksum(first + stream.read(_ENDS))}"


def checksum(data: bytes) -> str:
    """CRC-32."""
    return f"{zlib.crc32(data):08x}"


def suggested_out(source: Path) -> Path:
    """A free name here for the run of a recording (``drive_run``), or for the replay of a run (``drive_run_again``)."""
    name = _OF_RECORDINGS.sub("", source.resolve().name)
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._-") or "recording"
    name += "_again" if is_run(source) else "_run"
    free = (Path(f"{name}_{k}" if k > 1 else name) for k in itertools.count(1))
    return next(path for path in free if not os.path.lexists(path))


def check_room(folder: Path, source: Path | None = None, *, force: bool = False) -> None:
    """Refuse a folder that contains anything but a run that may be replaced, or the source that is about to be read.

    With ``force`` a run that holds something may be replaced, too. Raises RunError; nothing was touched.
    """
    try:
        if source is not None and folder.resolve() in (source.resolve(), source.resolve().parent):
            raise RunError(f"{folder}: cannot be read from and written to at once")
        if not folder.exists():
            return
        with claimed(folder):
            pass
        if _is_marked(folder):
            _, foreign = _contents(folder)
            if foreign:
                raise RunError(f"{foreign[0]}: not written by this run, and so never removed: choose another folder")
            if not force and _holds_something(folder):
                raise RunError(f"{folder}: holds a run already: choose another folder, or --force replaces it")
        elif not all(map(_is_unfinished, folder.iterdir())):
            raise RunError(f"{folder}: not empty and not an earlier run; nothing was written")
    except OSError as error:
        raise RunError(f"{folder}: {error.strerror}") from None


def keep_earlier(folder: Path, most: int, loaded: Path | None = None) -> Path | None:
    """Move an earlier run away, to ``folder-1`` or the next number. A limited number of them is kept.

    Returns where it is now; None if there is none to keep. An empty run is not kept. A run that never ended is always
    kept, and so is ``loaded``, whose map is gone on in. Of older ones the files of the run are removed, and nothing
    else.
    """
    most = max(most, is_cut_off(folder) or is_incomplete(folder))
    if not _holds_something(folder) or not most:
        return None
    earlier = earlier_runs(folder)
    target = folder.with_name(f"{folder.name}-{max(_numbered(folder), default=0) + 1}")
    try:
        with claimed(folder):
            folder.rename(target)
        for number in sorted(earlier)[: max(0, len(earlier) + 1 - most)]:
            if earlier[number] != loaded and _is_marked(earlier[number]):
                remove(earlier[number])
    except OSError as error:
        raise RunError(f"{folder}: cannot be moved to {target.name}: {error.strerror}") from None
    return target


def earlier_runs(folder: Path) -> dict[int, Path]:
    """Earlier runs next to a run folder, by number."""
    out: dict[int, Path] = {}
    for number, run in _numbered(folder).items():
        with contextlib.suppress(RunError):  # it stays as it is
            if is_run(run):
                out[number] = run
    return out


def is_name_of_earlier(folder: Path, name: str) -> bool:
    """Return whether an earlier run of a folder could have that name, and so be removed as the oldest of these."""
    return _earlier_name(folder).fullmatch(name) is not None


def _earlier_name(folder: Path) -> re.Pattern[str]:
    return re.compile(re.escape(folder.name) + r"-([1-9]\d*)")


def _numbered(folder: Path) -> dict[int, Path]:
    """The folders whose name is that of an earlier run, by number."""
    named = _earlier_name(folder)
    there = folder.parent.iterdir() if folder.parent.is_dir() else ()
    return {int(match[1]): run for run in there if (match := named.fullmatch(run.name))}


@contextlib.contextmanager
def room(folder: Path, *, force: bool = False) -> Iterator[None]:
    """Make a folder for a run, and have it for oneself; a run in it is replaced, if that is allowed.

    From here on its ``run.json`` says that it is a run. Raises RunError where something else is there, or where
    somebody else records there.
    """
    check_room(folder, force=force)
    with contextlib.ExitStack() as held:
        try:
            if not folder.exists():
                folder.mkdir(parents=True, exist_ok=True)
                sync_folder(folder.parent)
            held.enter_context(claimed(folder))
            write_whole(folder / SUMMARY, BEGUN)
            _clear(folder)
        except KeyboardInterrupt:
            discard(folder)
            raise
        except OSError as error:
            raise RunError(f"{folder}: {error.strerror}") from None
        yield


def discard(folder: Path) -> None:
    """Remove a run that has begun and was not saved yet. A saved one stays."""
    with contextlib.suppress(OSError):
        if read_bytes(folder / SUMMARY) == BEGUN:
            remove(folder)
        else:
            folder.rmdir()  # if it was made and nothing more


def remove(folder: Path) -> None:
    """Remove the files of a run, and the folder if nothing else is in it. Raises OSError."""
    _clear(folder)
    (folder / SUMMARY).unlink()
    with contextlib.suppress(OSError):  # somebody has put more into it
        folder.rmdir()


def _clear(folder: Path) -> None:
    """Remove the files of a run except its mark, so that a folder that was half cleared can be cleared again."""
    for file in _contents(folder)[0]:
        file.unlink()


def page_mark(page: bytes, out: Path, run: Path) -> bytes:
    """The last line of a page on a run, which tells it from a page that was changed, and from one on another run."""
    place = os.path.relpath(run.resolve(), out.parent.resolve())  # of a folder that was moved with its page, the same
    return b"<!-- graph_slam report %s -->\n" % hashlib.sha256(page + os.fsencode(place)).hexdigest().encode()


def is_own_page(file: Path, run: Path) -> bool:
    """Return whether a file is a page on that run as ``report`` wrote it. Raises OSError."""
    page, size = read_bytes(file) if is_regular(file) else b"", len(page_mark(b"", file, run))
    return page[-size:] == page_mark(page[:-size], file, run)


def _contents(folder: Path) -> tuple[list[Path], list[Path]]:
    """The files that a run has made, without its mark, and others that have such a name."""
    ours, foreign = list[Path](), list[Path]()
    for file in sorted(folder.iterdir(), reverse=True):
        if _RECORDED.fullmatch(file.name):
            (ours if _is_recorded(file) else foreign).append(file)
        elif file.name in _RESULTS or file.name == CONFIG:
            (ours if is_regular(file) else foreign).append(file)
        elif _is_unfinished(file) or (file.name == REPORT and is_own_page(file, folder)):
            ours.append(file)
    return [file for file in ours if file.name != SUMMARY], foreign


def _is_unfinished(file: Path) -> bool:
    """Return whether a file was left by a process that was killed while it wrote."""
    return _UNFINISHED.fullmatch(file.name) is not None and is_regular(file)
