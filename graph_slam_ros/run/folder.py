"""Which folder is a run, which of several is the newest, and what of a folder may be replaced."""

import contextlib
import json
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from graph_slam_ros.errors import ConfigError, FormatError, GraphSlamError
from graph_slam_ros.formats.durable import NEW, claimed, sync_folder
from graph_slam_ros.formats.journal import INGEST, MAP, parts_of, read_ingest
from graph_slam_ros.formats.parameters import read_parameters
from graph_slam_ros.run.ledger_file import CHANGES, LEDGER
from graph_slam_ros.run.map_log import grew
from graph_slam_ros.slam import Config

SUMMARY, CONFIG = "run.json", "config.yaml"
GRAPH, VERTICES, COVARIANCES = "graph.g2o", "graph_vertices.csv", "covariances.csv"
PATH, PATH_ODOMETRY = "path.tum", "path_odometry.tum"  # at keyframes: estimate, and what odometry alone says
SIGHTINGS, ODOMETRY = "sightings.tum", "odometry.tum"  # the same at the stamps of sightings
LANDMARKS, PICTURE = "landmarks.csv", "path.png"
_PATHS = {PATH, PATH_ODOMETRY, SIGHTINGS, ODOMETRY, COVARIANCES}
_RESULTS = {SUMMARY, GRAPH, VERTICES, LEDGER, CHANGES, LANDMARKS, PICTURE, *_PATHS}
_RECORDED = re.compile(r"(ingest|map|run)(_\d+)?\.mcap")


class RunError(GraphSlamError):
    """A run folder that cannot be written or read."""


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run: an ingest sequence and the configuration it was taken with."""
    return folder.is_dir() and (folder / CONFIG).is_file() and bool(parts_of(folder))


def is_cut_off(folder: Path) -> bool:
    """Whether the newest run, there or moved out of its way, holds something and was never ended."""
    earlier = earlier_runs(folder)
    newest = folder if _holds_something(folder) else earlier[max(earlier)] if earlier else folder
    if not _holds_something(newest):
        return False
    return not summary_of(newest).get("ended")


def incomplete_runs(folder: Path) -> list[Path]:
    """Earlier runs that were ended before all that they had accepted was processed, the newest first."""
    earlier = earlier_runs(folder)
    return [earlier[number] for number in sorted(earlier, reverse=True) if is_incomplete(earlier[number])]


def is_incomplete(folder: Path) -> bool:
    """Whether a run was ended before all that it had accepted was processed, and its results are still to be made."""
    return summary_of(folder).get("is_incomplete") is True


def was_saved_whole(folder: Path) -> bool:
    """Whether the map of a run has all of its journal, by its summary."""
    parts = list(_parts(folder))
    return summary_of(folder).get("unprocessed") == 0 and bool(parts) and all(then == now for _, then, now in parts)


def _holds_something(folder: Path) -> bool:
    if not is_run(folder) or summary_of(folder).get("keyframes"):
        return is_run(folder)
    try:
        return next(read_ingest(folder, []), None) is not None or grew(folder)
    except FormatError:  # who knows
        return True


def summary_of(folder: Path) -> dict[str, Any]:
    """The summary; nothing where it cannot be read."""
    try:
        told = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return told if isinstance(told, dict) else {}


def recording_of(folder: Path) -> str:
    """The name of the recording that a run was replayed from; empty where it was a live run, or is not known."""
    name = summary_of(folder).get("recording", "")
    return name if isinstance(name, str) else ""


def run_config(folder: Path) -> Config:
    """The configuration a run was made with. Raises ConfigError naming the file."""
    if not (folder / CONFIG).is_file():
        raise ConfigError(f"{folder}: not a run: no {CONFIG} in it")
    values = read_parameters(folder / CONFIG)
    try:
        return Config.from_mapping(values)
    except GraphSlamError as error:
        raise ConfigError(f"{folder / CONFIG}: {error}") from None


def changed_since(folder: Path) -> list[str]:
    """Results that are not those that ``run.json`` was written with: of a save that was cut off, or edited since."""
    try:
        files = summary_of(folder)["files"]
        there = [name for name in sorted(_RESULTS & set(files)) if (folder / name).exists()]
        changed = [name for name in there if checksum((folder / name).read_bytes()) != files[name]]
    except (OSError, LookupError, TypeError):
        return []
    out = [f"{name} is not the one that {SUMMARY} was saved with" for name in changed]
    if any(now > then for _, then, now in _parts(folder)) or is_incomplete(folder):
        out.append("the run went on after its results were saved: graph_slam recover has those of its end")
    return out


def missing(folder: Path) -> list[str]:
    """Of its recordings, those that have fewer parts than when the run was saved."""
    return [f"{name}: {then} parts when it was saved, {now} now" for name, then, now in _parts(folder) if now < then]


def _parts(folder: Path) -> Iterator[tuple[str, int, int]]:
    """Of each recording of a run that was saved: how many parts it had then and has now."""
    parts = summary_of(folder).get("parts")
    told: dict[str, Any] = parts if isinstance(parts, dict) else {}
    for name in (INGEST, MAP):
        if isinstance(then := told.get(name), int):
            yield name, then, len(parts_of(folder, name))


def checksum(data: bytes) -> str:
    """CRC-32."""
    return f"{zlib.crc32(data):08x}"


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
        if folder.exists():
            with claimed(folder):
                pass
    except OSError as error:
        raise RunError(f"{folder}: {error.strerror}") from None


def keep_earlier(folder: Path, most: int, loaded: Path | None = None) -> None:
    """Move an earlier run out of the way: to ``folder-1``, or one more than the last; so many of them are kept.

    One that holds nothing is not kept; one that was never ended is in any case. Of older ones the files that a run has
    are removed, and nothing else.

    Parameters
    ----------
    loaded : the run whose map is gone on in, or is to be: it stays
    """
    most = max(most, is_cut_off(folder) or is_incomplete(folder))
    if not _holds_something(folder) or not most:
        return
    earlier = earlier_runs(folder)
    target = folder.with_name(f"{folder.name}-{max(_numbered(folder), default=0) + 1}")
    try:
        with claimed(folder):
            folder.rename(target)
        for number in sorted(earlier)[: max(0, len(earlier) + 1 - most)]:
            if earlier[number] != loaded:
                _clear(earlier[number])
                with contextlib.suppress(OSError):  # somebody has put more into it
                    earlier[number].rmdir()
    except OSError as error:
        raise RunError(f"{folder}: cannot be moved to {target.name}: {error.strerror}") from None


def earlier_runs(folder: Path) -> dict[int, Path]:
    """Earlier runs beside a run folder, by number."""
    return {number: run for number, run in _numbered(folder).items() if is_run(run)}


def _numbered(folder: Path) -> dict[int, Path]:
    """Whatever is called as an earlier run is."""
    named = re.compile(re.escape(folder.name) + r"-([1-9]\d*)")
    there = folder.parent.iterdir() if folder.parent.is_dir() else ()
    return {int(match[1]): run for run in there if (match := named.fullmatch(run.name))}


def _is_of_a_start(file: Path) -> bool:
    """What a run that was stopped as it began may have left, before its folder can be told for a run."""
    return file.name.removesuffix(NEW) == CONFIG or _RECORDED.fullmatch(file.name) is not None


@contextlib.contextmanager
def room(folder: Path) -> Iterator[None]:
    """Make a folder for a run, and have it for oneself; an earlier run in it is removed.

    Raises
    ------
    RunError
        Something else is there, or somebody else records there.
    """
    check_room(folder)
    with contextlib.ExitStack() as held:
        try:
            if not folder.exists():
                folder.mkdir(parents=True, exist_ok=True)
                sync_folder(folder.parent)
            held.enter_context(claimed(folder))
            _clear(folder)
        except OSError as error:
            raise RunError(f"{folder}: {error.strerror}") from None
        yield


def _clear(folder: Path) -> None:
    """What makes it a run goes last: who is stopped half-way leaves a folder that may be cleared again."""
    there = sorted(folder.iterdir(), reverse=True)
    results = [file for file in there if file.name.removesuffix(NEW) in _RESULTS]
    for file in results + [file for file in there if _is_of_a_start(file)]:
        file.unlink()
