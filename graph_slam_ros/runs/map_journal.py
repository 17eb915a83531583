"""The map as it grew, in ``map.mcap``: from it a map is taken up again without the drive being repeated.

JSON records in mcap, as in the journal. The first is ``map`` with the version of the format. Each update adds a
``growth``: what there is since the one before,

* ``vertices``: kind and initial values; ``edges``: tag (as in g2o), vertices, what was measured, square root of the
  information by rows, class, input. Both are numbered in order from 0;
* ``judged``: of each edge, in order, keyframe at which it was judged first, statistic, threshold, numbers measured,
  residual then, verdict, reason; ``changes``: edge, keyframe, verdict, reason, statistic, threshold;
* ``keyframes``: vertex, stamp, ``T_odom_base``; ``segments``: keyframes at which odometry began; ``drives``:
  the first keyframe of each drive; ``sightings``: keyframe, stamp, ``T_keyframe_base``;
* ``landmarks``: by name, vertex, whether without identity, whether tentative, number of sightings, first and last
  stamp, and where it has a class or size these two and how many sightings have a size, or null where it was given up;
  ``seen``: of those without identity, each sighting and its edge;
* ``datum``: latitude, longitude and height that fixes are from; ``settings``: parameters that were changed on the way;
  ``displacements``: all alarms by then, of all drives, as in ``run.json``;
* ``processed``: records of the ingest sequence that all of it came of; ``used``: stamp and input of the last odometry
  that was used by then;
* ``noise``: factors of the configured sigmas that the edges have from now on, ``[class, input, part, factor]`` each;
  ``rescaled``: changes of edges of earlier records, in order: first edge, the first that is not among them, and the
  factors of the groups that changed, before and after, as in ``noise``;
* ``gyro``: its input, the bias about each axis and the variance of that, stamp of the newest odometry by then;
* ``calibration``: odometry's factors as found, ``[input, name, value]`` each; ``recalibrated``: edges of earlier
  records as they are by these: edge type, rows of its table, numbers measured, square roots of the information;
* ``condensed``: first in a map from which visits were condensed, see ``condensed_map.py``;
* ``frozen``: so many vertices, the first, stay where they are, and verdicts on so many edges as they are; ``held``: the
  same while ``map.localize`` is true, zeros when it ends; ``edits``: ``AppliedEdit.record`` of each edit by hand.

Now and then an ``estimate`` tells all values, end to end. A run that goes on in another's map has that first, as one
``growth`` and one ``estimate``, up to a record ``start``. After visits were condensed, ``anew`` ends all before it, in
a part of its own that takes the place of all parts before: a ``growth`` of the whole map follows. Where a run was
killed before it did, it is read instead of these.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple
from functools import cache
from pathlib import Path
from typing import Any

from graph_slam_ros.edge_tags import tag_of
from graph_slam_ros.errors import FormatError, GraphSlamError
from graph_slam_ros.graph import Graph
from graph_slam_ros.measurements.types import sighting_record
from graph_slam_ros.runs.condensed_map import condensed_record
from graph_slam_ros.runs.journal import ANEW, MAP, parts_of, read_records
from graph_slam_ros.runs.map_faults import fault_of
from graph_slam_ros.runs.map_growth import AT_ONCE, Growing, apply_verdicts, grow
from graph_slam_ros.slam import GraphSlam
from graph_slam_ros.slam.calibration.recalibration import Totals, totals_record
from graph_slam_ros.slam.frontend.gyro import SavedBias
from graph_slam_ros.slam.frontend.noise_factors import Key, factors_record
from graph_slam_ros.slam.landmarks.landmark import Landmark, LandmarkEdge
from graph_slam_ros.slam.robust.ledger import Ledger, Reason, Verdict
from graph_slam_ros.slam.snapshot import MapSnapshot

GROWTH = "graph_slam_ros.Map"
VERSION = 3
_FIRST = 1  # of a map from which nothing was condensed, which every program reads
_MORE = 1.1  # an estimate is written when there are so many times the keyframes: in total it stays linear
_JUMP_M = 0.5  # or when a solve moved the newest that far, and there are a hundredth more

Record = dict[str, Any]


class MapGrowth:
    """The growth of a map since it was last recorded.

    Parameters
    ----------
    start : the map that the run goes on in
    """

    def __init__(self, start: MapSnapshot | GraphSlam | None = None, before: int = 0) -> None:
        self._displacements: list[dict[str, Any]] = []
        self._begin()
        self.first: list[Record] = [{"type": "map", "version": _FIRST}]
        if start is not None:
            known = {"displacements": start.displacements} if start.displacements else {}
            self._displacements = start.displacements
            values = start.values if isinstance(start, MapSnapshot) else start.solver.values
            self.first += [self.since(start) | known, _estimate(values), {"type": "start"}]
        self._before = before  # records of another journal

    def _begin(self) -> None:
        self._vertices = self._edges = self._judged = self._changes = 0
        self._keyframes = self._segments = self._sightings = self._landmarks = 0
        self._edits = self._frozen = self._drives = self._rescaled = 0
        self._noise: dict[Key, float] = {}
        self._calibration: Totals = {}
        self._recalibrated = 0
        self._held = (0, 0)
        self._datum: tuple[float, ...] = ()
        self._gyro: SavedBias | None = None
        self._settings: dict[str, Any] = {}
        self._displacements = []
        self._estimated = 0  # keyframes at the last estimate

    def of(self, slam: GraphSlam, *, is_anew: bool = False) -> Iterator[Record]:
        """The growth since the last call, and from time to time the whole estimate.

        Parameters
        ----------
        is_anew : whether a part of the map has left it, so that all ids are others
        """
        if is_anew:
            self._begin()
            yield from ({"type": "map", "version": VERSION}, {"type": ANEW})
        changed: Record = {"settings": dict(slam.settings)} if slam.settings != self._settings else {}
        self._settings = dict(slam.settings)
        if (alarms := slam.displacements) != self._displacements:
            changed["displacements"] = self._displacements = alarms
        used = {"used": [slam.newest_odometry_ns, slam.odometry_source]} if slam.odometry_source else {}
        yield self.since(slam) | changed | {"processed": max(0, slam.processed - self._before)} | used
        count = len(slam.keyframes)
        has_jumped = slam.correction.distance_m > _JUMP_M and count > 1.01 * self._estimated
        if has_jumped or count >= _MORE * self._estimated + 1:
            self._estimated = count
            yield _estimate(slam.solver.values)

    def since(self, a: GraphSlam | MapSnapshot) -> Record:
        """The growth since the last call."""
        graph, first_edge = a.graph, self._edges
        out: Record = {"type": "growth"}
        out["vertices"] = [_vertex(graph, v) for v in range(self._vertices, graph.vertex_count)]
        out["edges"] = [_edge(graph, edge) for edge in range(first_edge, graph.edge_count)]
        out["judged"] = _judgements(a.ledger, self._judged)
        out["changes"] = [
            [c.edge, c.keyframe, *_named(c.verdict, c.reason), _as_json(c.statistic), _as_json(c.threshold)]
            for c in a.ledger.history[self._changes :]
        ]
        if not self._keyframes and a.bounded is not None:
            out["condensed"] = condensed_record(graph, a.first_keyframe, a.bounded)
        keyframes = a.newer_keyframes(self._keyframes)
        out["keyframes"] = [[k.vertex, k.stamp_ns, k.T_odom_base] for k in keyframes]
        out["segments"] = a.segments[self._segments :]
        out["drives"] = a.drives[self._drives :]
        poses = [a.sighting_poses[k] for k in range(self._sightings, len(a.sighting_poses))]
        out["sightings"] = [[p.keyframe, p.stamp_ns, p.T_keyframe_base] for p in poses]
        landmarks = a.touched_landmarks(self._landmarks)
        out["landmarks"] = {name: mark and _landmark(mark) for name, mark in landmarks.items()}
        out["seen"] = [_seen(one) for mark in landmarks.values() if mark for one in _newer(mark.seen, first_edge)]
        if a.frozen > self._frozen:
            out["frozen"] = [a.frozen, a.frozen_edges]
        if a.held != self._held:
            out["held"] = self._held = a.held
        if a.noise_factors != self._noise:
            out["noise"] = factors_record(a.noise_factors)
            self._noise = dict(a.noise_factors)
        changes = a.noise_changes[self._rescaled :] if first_edge else ()
        out["rescaled"] = [one.as_record() for one in changes]
        self._rescaled = len(a.noise_changes)
        if a.calibration != self._calibration:
            out["calibration"], self._calibration = totals_record(a.calibration), dict(a.calibration)
        changed = a.recalibrations[self._recalibrated :] if first_edge else ()
        out["recalibrated"] = [one.present(graph).as_record() for one in changed]  # rescaled since, perhaps
        self._recalibrated = len(a.recalibrations)
        out["edits"] = [one.record for one in a.edits[self._edits :]]
        if a.datum != self._datum:
            out["datum"] = self._datum = a.datum
        if a.gyro_bias is not None and a.gyro_bias != self._gyro:
            out["gyro"], self._gyro = list(astuple(a.gyro_bias)), a.gyro_bias
        if keyframes:
            out["stamp_ns"] = keyframes[-1].stamp_ns
        self._vertices, self._edges, self._judged = graph.vertex_count, graph.edge_count, len(a.ledger)
        self._changes, self._keyframes, self._segments = len(a.ledger.history), a.keyframe_count, len(a.segments)
        self._sightings, self._frozen = len(a.sighting_poses), a.frozen
        self._drives, self._edits, self._landmarks = len(a.drives), len(a.edits), a.landmark_changes
        return {name: part for name, part in out.items() if part}


def has_map(folder: Path) -> bool:
    """Return whether a run folder has a map."""
    return bool(parts_of(folder, MAP))


def grew(folder: Path) -> bool:
    """Return whether there is any growth."""
    return any(record.get("type") == "growth" for record in read_records(folder, MAP, []))


def read_map(folder: Path, losses: list[str], *, start_only: bool = False) -> MapSnapshot | None:
    """The map of a run folder, as far as it can be read; None if there is none.

    Parameters
    ----------
    start_only : that which the run began with

    Raises
    ------
    FormatError
        It is of a later version, or no map.
    """
    try:
        return _read(folder, losses, AT_ONCE, start_only=start_only)
    except FormatError:
        return _read(folder, [], 1, start_only=start_only)  # it names the record


def _read(folder: Path, losses: list[str], at_once: int, *, start_only: bool) -> MapSnapshot | None:
    growing, has_start = Growing(at_once), False
    count, file = 0, f"{folder.name}/{MAP}.mcap"
    try:
        for count, record in enumerate(read_records(folder, MAP, losses)):  # noqa: B007, named below
            match record["type"]:
                case "map" if record["version"] > VERSION:
                    raise FormatError(f"its version is {record['version']}; this program knows up to {VERSION}")
                case "growth":
                    growing.append(record)
                case "estimate":
                    growing.estimate(record["values"])
                case kind if kind == ANEW:
                    growing = Growing(at_once)
                case "start":
                    has_start = True
                    growing.finish().processed = 0
            if start_only and has_start:
                break
        state = growing.finish()
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, GraphSlamError) as error:
        raise FormatError(f"{file}: record {count}: {error}") from None
    if (start_only and not has_start) or not state.keyframes:
        return None
    if fault := fault_of(state):
        raise FormatError(f"{file}: {fault}")
    apply_verdicts(state)
    state.folder = folder
    return state


def state_of(slam: GraphSlam, folder: Path | None = None) -> MapSnapshot:
    """A copy of the map of a pipeline.

    Parameters
    ----------
    folder : that has what was condensed
    """
    state = MapSnapshot(folder=folder)
    extend(state, MapGrowth().since(slam))
    state.values, state.settings, state.displacements = slam.solver.values, dict(slam.settings), slam.displacements
    state.used_ns, state.source = slam.newest_odometry_ns, slam.odometry_source
    return state


def extend(state: MapSnapshot, record: Mapping[str, Any]) -> None:
    """Append a ``growth`` to the map."""
    grow(state, [record])
    apply_verdicts(state)


# -- what is written --------------------------------------------------------------------------------------------------


def _estimate(values: Any) -> Record:
    return {"type": "estimate", "values": values.tolist()}


def _vertex(graph: Graph, vertex: int) -> list[Any]:
    one = graph.vertex(vertex)
    return [one.kind.name, one.initial.tolist()]


def _edge(graph: Graph, edge: int) -> list[Any]:
    one = graph.edge(edge)
    measured, root = one.measured.tolist(), one.sqrt_information.ravel().tolist()
    return [tag_of(one.type), list(one.vertices), measured, root, one.label, one.source]


def _judgements(ledger: Ledger, first: int) -> list[list[Any]]:
    """The verdicts from an edge on, as JSON."""
    columns = ledger.keyframe, ledger.statistic, ledger.threshold, ledger.numbers, ledger.verdict, ledger.reason
    rows = zip(*(column.values[first:].tolist() for column in columns), strict=True)
    return [
        [keyframe, _as_json(statistic), _as_json(threshold), numbers, ledger.residual(edge).tolist(), *_words(*codes)]
        for edge, (keyframe, statistic, threshold, numbers, *codes) in enumerate(rows, first)
    ]


@cache
def _words(verdict: int, reason: int) -> tuple[str, str]:
    return _named(Verdict(verdict), Reason(reason))


def _named(verdict: Verdict, reason: Reason) -> tuple[str, str]:
    return verdict.name.lower(), reason.name.lower()


def _as_json(number: float) -> float | str:
    """Replace infinity, which JSON does not have."""
    return number if math.isfinite(number) else repr(number)


def _landmark(mark: Landmark) -> list[Any]:
    stamps = mark.first_seen_ns, mark.last_seen_ns
    has_features = bool(mark.sort or mark.sized)
    features = [mark.sort, mark.size, mark.sized] * has_features
    return [mark.vertex, mark.is_unnamed, mark.is_tentative, mark.sightings, *stamps, *features]


def _newer(seen: Sequence[LandmarkEdge], first_edge: int) -> Iterable[LandmarkEdge]:
    """The sightings of new edges, which are at the end."""
    count = next((k for k, one in enumerate(reversed(seen)) if one.edge < first_edge), len(seen))
    return seen[len(seen) - count :]


def _seen(one: LandmarkEdge) -> list[Any]:
    where = one.where
    at = [where.keyframe, where.vertex, where.stamp_ns, where.T_keyframe_base, where.covariance.tolist()]
    return [one.edge, one.topic, sighting_record(one.sighting), *at]
