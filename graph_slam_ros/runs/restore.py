"""A run after its end: repeated from its journal, or continued in its map."""

import os
import time
from collections.abc import Callable, Iterable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from graph_slam_ros.errors import ConfigError, FormatError
from graph_slam_ros.formats.durable import claimed
from graph_slam_ros.runs.folder import (
    SUMMARY,
    RunError,
    check_room,
    discard,
    missing,
    recording_of,
    run_config,
    summary_of,
    was_saved_whole,
)
from graph_slam_ros.runs.journal import IN_A_MAP, INGEST, START, read_measurements, read_records
from graph_slam_ros.runs.map_file import read_map, read_start
from graph_slam_ros.runs.recorder import RunRecorder, save_results
from graph_slam_ros.runs.tables import counters_of, summarize
from graph_slam_ros.slam import Config, Control, Counters, GraphSlam, MapView, Measurement
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.warmup import warmup

Summary = dict[str, Any]
_NOTHING_LEAVES = {"map.condense": False}  # what left while a map is made again would be in no file
_OF_RECORDING = ("recording", "recorded", "unprocessed", "load", "check", "plan")
"""Keys of a summary that a repeated computation does not change."""

Stopwatch = Callable[[], dict[str, float]]


def map_of(folder: Path, losses: list[str], counters: Counters | None = None) -> MapSnapshot:
    """The map of a run: the newest that was written, with the rest of its journal; or by repeating the drive.

    What the run has counted, by its summary and by what is processed here, is added to ``counters``. Raises RunError
    or FormatError: there is no map, or it cannot be read.
    """
    space = run_config(folder).space
    warmup(dimensions=space.dimensions)
    losses += missing(folder)
    counters, before = Counters() if counters is None else counters, summary_of(folder)
    try:
        counters.update(counters_of(before))
    except ValueError as error:
        losses.append(f"{folder / SUMMARY}: what it had counted: {error}")
    try:
        state = read_map(folder)
    except FormatError as error:
        losses.append(f"{error}: the drive is repeated from its journal")
        state = None
    if state is None:
        state = _repeated(folder, losses, counters)
    elif not was_saved_whole(folder):  # measurements were accepted and not processed
        state.continues = True
        state = _driven(folder, state, losses, counters)
    if not state.keyframes:
        raise RunError(f"{folder}: no keyframe, so there is no map")
    if state.graph.kind_of(int(state.keyframes.ids[0])) is not space.pose:
        raise RunError(f"{folder}: its map is not in {space.dimensions} dimensions, as its configuration says")
    return state


def config_of(folder: Path, state: MapSnapshot) -> Config:
    """The configuration of a run at the time of its map, with the changes during the run."""
    try:
        return run_config(folder).changed(state.settings)
    except ConfigError as error:
        raise RunError(f"{folder}: changed on the way: {error}") from None


def _repeated(folder: Path, losses: list[str], counters: Counters) -> MapSnapshot:
    """The map by repeating the drive from its journal, in the map that it began in."""
    again, start = Counters(), read_start(folder)
    if start is None and next(read_records(folder, INGEST, []), None) == IN_A_MAP:
        raise RunError(
            f"{folder}: it began in a map, and {START}, which has that, is not there, as in runs of earlier releases: "
            f"graph_slam replay {folder} --out NEW drives it without"
        )
    state = _driven(folder, start or MapSnapshot(), losses, again)
    counters.raise_to(again)
    return state


def _driven(folder: Path, state: MapSnapshot, losses: list[str], counters: Counters) -> MapSnapshot:
    """The map with the rest of the journal, if there is more."""
    rest = read_measurements(folder, losses, state.processed, state.used_ns)
    first = next(rest, None)
    if first is None:
        return state
    settings = dict(state.settings)
    slam = GraphSlam(config_of(folder, state).changed(_NOTHING_LEAVES), start=state)
    for measurement in chain([first], rest, [Control("end")]):
        slam.process(measurement)
    counters.update(slam.counters)
    out = slam.view.snapshot(folder)
    out.settings = settings | out.settings
    return out


def of_all(folder: Path) -> str:
    """Return how a map of all keyframes is made of a run whose visits are condensed."""
    return f"graph_slam replay {folder} --out WHOLE --set map.condense=false makes a map with all of them"


def restored(folder: Path, losses: list[str], counters: Counters | None = None, *, whole: bool = False) -> GraphSlam:
    """The map of a run; see ``map_of``. Losses name its folder.

    The ``whole`` map has all keyframes: where visits were condensed, the drive is repeated from its journal. Raises
    RunError, too, where that drive began in a map with condensed visits.
    """
    lost = len(losses)
    state = map_of(folder, losses, counters)
    if state.bounded is not None and whole:
        state = _repeated(folder, losses, Counters())
        if state.bounded is not None:
            raise RunError(f"{folder}: it began in a map with condensed visits, and this needs all keyframes")
    losses[lost:] = [f"{folder}: {loss}" for loss in losses[lost:]]
    # what is asked of a map is asked of all of it
    return GraphSlam(config_of(folder, state).changed({"map.localize": False} | _NOTHING_LEAVES), start=state)


def config_to_go_on(slam: GraphSlam, folder: Path) -> Config:
    """The configuration of a run that goes on in a map that was restored from a folder: it condenses as that did."""
    return slam.view.config.changed({"map.condense": run_config(folder).changed(slam.settings).map.condense})


def restored_and_solved(
    folder: Path, losses: list[str], counters: Counters | None = None, *, whole: bool = False
) -> GraphSlam:
    """The same with all edges judged. Raises GraphSlamError also if it cannot be solved."""
    slam = restored(folder, losses, counters, whole=whole)
    slam.process(Control("optimize"))
    if not slam.view.is_solved:
        raise RunError(f"{folder}: its map cannot be solved: {slam.view.failing}")
    return slam


def record_run(
    folder: Path,
    config: Config,
    measurements: Iterable[Measurement],
    losses: Sequence[str],
    start: MapSnapshot | None = None,
    *,
    border: Callable[[], Counters] = Counters,
    earlier: Counters | None = None,
    took: Stopwatch | None = None,
    recording: str = "",
    more: Callable[[], Summary] = dict,
    force: bool = False,
) -> tuple[GraphSlam, Summary]:
    """Run the pipeline over measurements and save it all; returns the pipeline and the summary.

    Parameters
    ----------
    losses : what could not be read, as known when the last measurement was
    start : the map to go on in
    border : returns the counters of what was refused before it came here, when all is processed
    earlier : counters of the run whose results these are, up to ``start``
    took : the time since whatever is told as its beginning
    recording : the name of the file or folder that the measurements are from
    more : returns what else is in the summary, when all is processed
    force : a run in the folder may be replaced

    After a KeyboardInterrupt nothing of it is left, nor after an error before the first measurement is accepted.
    """
    took = took or stopwatch()
    recorder: RunRecorder | None = None
    try:
        recorder = RunRecorder(folder, config, start=start, force=force)
        slam = GraphSlam(config, recorder.sink, start=start)
        for measurement in measurements:
            recorder.record(slam, slam.process(measurement))
        slam.counters.update(border())
        summary = summarize(slam, earlier) | took() | {"losses": list(dict.fromkeys(losses))}
        summary |= ({"recording": recording} if recording else {}) | more()
        recorder.save(slam, summary)
    except BaseException as error:
        if recorder is not None and recorder.accepted and not isinstance(error, KeyboardInterrupt):
            recorder.close()
        elif recorder is not None:  # the first that was read was refused
            recorder.discard()
        raise
    recorder.close()
    return slam, summary


def stopwatch() -> Stopwatch:
    """Return a stopwatch that starts now."""
    start_s, cpu_s = time.perf_counter(), time.process_time()
    return lambda: {"time_s": time.perf_counter() - start_s, "cpu_s": time.process_time() - cpu_s}


def recover(folder: Path, out: Path, *, force: bool = False) -> Summary:
    """Write the results of a run that never ended, from its map. The drive is not repeated."""
    took = stopwatch()
    check_room(out, folder, force=force)
    losses, counters = list[str](), Counters()
    state = map_of(folder, losses, counters)
    options: dict[str, Any] = {"earlier": counters, "took": took, "recording": recording_of(folder)}
    return record_run(out, config_of(folder, state), (), losses, state, force=force, **options)[1]


def complete(folder: Path) -> Summary:
    """Write the results of all measurements of a run into its folder. Its recordings stay as they are.

    Raises RunError: somebody else has the folder, or its map cannot be solved.
    """
    took, losses = stopwatch(), list[str]()
    try:
        with claimed(folder):
            before, counters = summary_of(folder), Counters()
            slam = restored_and_solved(folder, losses, counters)
            kept = {key: before[key] for key in _OF_RECORDING if key in before}
            summary = kept | summarize(slam, counters) | took()
            summary |= {"losses": losses, "ended": True, "is_incomplete": False}
            save_results(folder, slam, summary)
    except OSError as error:
        raise RunError(f"{error.filename or folder}: {error.strerror}") from None
    return summary


def save_copy(view: MapView, out: Path, folder: Path) -> None:
    """Write the map of a pipeline, whose own run is saved in ``folder``, as another run. The pipeline goes on as it is.

    Raises RunError, and writes nothing: something of that name is there, or there is no map that is solved.
    """
    if os.path.lexists(out):
        raise RunError(f"{out.name}: is there already, and nothing is replaced: choose another name")
    if not view.keyframes:
        raise RunError(f"{out.name}: not written: there is no keyframe, so there is no map")
    if not view.is_solved:
        raise RunError(f"{out.name}: not written: the map cannot be solved: {view.failing}")
    try:
        record_run(out, view.config, (), [], view.snapshot(folder))
    except Exception:
        discard(out)
        raise


def freeze(folder: Path, out: Path, *, force: bool = False) -> Summary:
    """Write a run that begins in the map of another run. That map then never changes."""
    took = stopwatch()
    check_room(out, folder, force=force)
    losses: list[str] = []
    slam = restored_and_solved(folder, losses)
    state = slam.view.snapshot(folder)
    state.freeze()
    config = config_to_go_on(slam, folder)
    return record_run(out, config, [Control("optimize")], losses, state, took=took, force=force)[1]
