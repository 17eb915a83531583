"""A map made again of its records, which ``map_journal`` describes: many at once, as one by one is slow."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from graph_slam_ros.edge_tags import edge_of
from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.vertices import R1, R2, R3, SE2, SE3
from graph_slam_ros.measurements.edits import applied_edit
from graph_slam_ros.measurements.types import Sighting
from graph_slam_ros.runs.condensed_map import read_condensed
from graph_slam_ros.runs.map_faults import is_index
from graph_slam_ros.slam.calibration.recalibration import Recalibration, read_totals
from graph_slam_ros.slam.frontend.gyro import SavedBias
from graph_slam_ros.slam.frontend.keyframes import Keyframe, SightingPose
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.frontend.noise_factors import Rescaling, read_factors
from graph_slam_ros.slam.landmarks.landmark import Landmark, LandmarkEdge
from graph_slam_ros.slam.robust.ledger import Ledger, Reason, Verdict
from graph_slam_ros.slam.snapshot import MapSnapshot

Growth = Mapping[str, Any]

AT_ONCE = 500
"""Records that are read at once."""
_ALONE = frozenset(("rescaled", "recalibrated", "frozen", "held", "condensed"))  # they are of all that was there before
_KINDS = {kind.name: kind for kind in (SE2, SE3, R1, R2, R3)}
_VERDICTS = {verdict.name.lower(): verdict for verdict in Verdict}
_REASONS = {reason.name.lower(): reason for reason in Reason}
_AS_ENTERED = (Verdict.ACCEPTED, Reason.NONE), (Verdict.NOT_EVALUATED, Reason.NONE)


class Growing:
    """A map, and records ``growth`` that are not yet in it.

    Parameters
    ----------
    at_once : as many are added to it at once
    """

    def __init__(self, at_once: int = AT_ONCE) -> None:
        self.state = MapSnapshot()
        self._at_once, self._records = at_once, list[Growth]()

    def append(self, record: Growth) -> None:
        """Append a record."""
        is_alone = not _ALONE.isdisjoint(record)
        if is_alone:
            self.finish()
        self._records.append(record)
        if is_alone or len(self._records) >= self._at_once:
            self.finish()

    def estimate(self, values: Sequence[float]) -> None:
        """Set the values of all vertices so far."""
        self.finish()
        array = np.array(values, dtype=float)
        self.state.values[: len(array)] = array

    def finish(self) -> MapSnapshot:
        """Add all records to the map, and return it."""
        if self._records:
            grow(self.state, self._records)
        self._records = []
        return self.state


def grow(state: MapSnapshot, records: Sequence[Growth]) -> None:
    """Append records ``growth``, in order. Those that change what was there before are alone."""
    graph, ledger = state.graph, state.ledger

    def of_all(name: str) -> list[Any]:
        return [one for record in records for one in record.get(name, ())]

    for one in of_all("rescaled"):
        Rescaling.from_record(one).apply(graph)
    for one in of_all("recalibrated"):
        Recalibration.from_record(one).apply(graph)
    for name, several in groupby(of_all("vertices"), key=lambda vertex: vertex[0]):
        graph.add_vertices(_KINDS[name], [values for _, values in several])
    state.values = np.concatenate((state.values, graph.initial.values[len(state.values) :]))
    _add_edges(graph, of_all("edges"))
    _judge(ledger, of_all("judged"))
    for edge, keyframe, verdict, reason, statistic, threshold in of_all("changes"):
        ledger.note(edge, keyframe, *_verdict(verdict, reason), float(statistic), float(threshold))
    for one in (record["condensed"] for record in records if "condensed" in record):
        state.first_keyframe, state.bounded = read_condensed(graph, one)
    state.keyframes += [Keyframe(vertex, stamp, tuple(pose)) for vertex, stamp, pose in of_all("keyframes")]
    state.segments += of_all("segments")
    state.drives += of_all("drives")
    state.sighting_poses += [SightingPose(k, stamp, tuple(pose)) for k, stamp, pose in of_all("sightings")]
    state.edits += map(applied_edit, of_all("edits"))
    for record in records:
        _know(state, record)
        _set(state, record)


def _set(state: MapSnapshot, record: Growth) -> None:
    """Replace what a record has a new state of."""
    state.calibration |= read_totals(record.get("calibration", ()))
    if "noise" in record:
        state.noise_factors = read_factors(record["noise"])
    state.datum = tuple(record.get("datum", state.datum))
    if "gyro" in record:
        name, bias, variance, stamp_ns = record["gyro"]
        state.gyro_bias = SavedBias(name, tuple(bias), tuple(variance), stamp_ns)
    state.settings.update(record.get("settings", {}))
    state.displacements = record.get("displacements", state.displacements)
    state.processed = _count(record.get("processed"))
    state.used_ns, state.source = record.get("used", (None, ""))
    for name in ("frozen", "held"):
        vertices, edges = record.get(name, (0, 0))
        if not (is_index(vertices, state.graph.vertex_count + 1) and is_index(edges, len(state.ledger) + 1)):
            raise ValueError(f"{name} {record[name]}: more than there is")
    if "frozen" in record:
        state.frozen, edges = record["frozen"]
        state.ledger.finish(edges)
    state.held = tuple(record.get("held", state.held))


def apply_verdicts(state: MapSnapshot) -> None:
    """Apply verdicts: a rejected edge has weight zero; an edge that moved to another landmark is withdrawn."""
    out = np.flatnonzero(np.isin(state.ledger.verdict.values, (Verdict.PENDING, Verdict.REJECTED)))
    state.graph.set_weights(out, 0.0)
    for mark in state.landmarks.values():
        mark.seen = [one for one in mark.seen if not state.ledger.is_withdrawn(one.edge)]
        mark.stamps = {one.where.stamp_ns for one in mark.seen}


def _add_edges(graph: Graph, edges: Sequence[Any]) -> None:
    """Add edges; those of one type at once. Their ids are in the order that is given."""
    first, by_tag = graph.edge_count, dict[str, list[int]]()
    codes = np.zeros((2, len(edges)), dtype=np.int64)
    for k, (tag, _, _, _, label, source) in enumerate(edges):
        by_tag.setdefault(tag, []).append(k)
        codes[:, k] = _code(graph.labels, label), _code(graph.sources, source)
    added = []
    for tag, places in by_tag.items():
        edge, at = edge_of(tag), np.array(places)
        _, vertices, measured, roots, label, source = zip(*(edges[k] for k in places), strict=True)
        noise = Gaussian(np.array(roots, dtype=float).reshape(-1, edge.residual_size, edge.residual_size))
        graph.add_edges(edge, vertices, measured, noise, label[0], source[0])
        table = graph.tables[edge]
        rows = np.arange(len(table) - len(at), len(table))
        table.label.values[rows], table.source.values[rows] = codes[:, at]
        table.id.values[rows] = first + at
        added.append((table.code, rows, first + at))
    for code, rows, ids in added:
        graph.table_of_edge.values[ids], graph.row_of_edge.values[ids] = code, rows


def _code(names: list[str], name: str) -> int:
    if name not in names:
        names.append(name)
    return names.index(name)


def _count(value: Any) -> int | None:
    if value is not None and not is_index(value, 2**63):
        raise ValueError(f"processed {value!r} is no count")
    return value


def _judge(ledger: Ledger, judged: Sequence[Any]) -> None:
    if not judged:
        return
    keyframes, statistics, thresholds, numbers, residuals, *named = zip(*judged, strict=True)
    verdicts = [_verdict(*names) for names in zip(*named, strict=True)]
    is_judged = np.array([verdict is not Verdict.NOT_EVALUATED for verdict, _ in verdicts])
    flat = np.array([number for residual in residuals for number in residual])
    limits = np.array(list(map(float, thresholds)))
    ids = ledger.enter(
        np.array(keyframes), np.array(list(map(float, statistics))), np.array(numbers), limits, flat, is_judged
    )
    for edge, one in zip(ids.tolist(), verdicts, strict=True):
        if one not in _AS_ENTERED:
            ledger.put(edge, *one)


def _verdict(verdict: str, reason: str) -> tuple[Verdict, Reason]:
    return _VERDICTS[verdict], _REASONS[reason]


def _know(state: MapSnapshot, record: Growth) -> None:
    renamed: dict[int, Landmark] = {}
    for name, fields in record.get("landmarks", {}).items():
        before = state.landmarks.get(name)
        if before is not None and (fields is None or fields[0] != before.vertex):  # it was given up: another comes last
            renamed[before.vertex] = state.landmarks.pop(name)
        if fields is not None:
            before = state.landmarks.get(name) or renamed.get(fields[0])
            now = state.landmarks[name] = Landmark(name, *fields)
            now.seen = before.seen if before is not None else []
    by_vertex = {mark.vertex: mark for mark in state.landmarks.values()} if record.get("seen") else {}
    for edge, topic, sighting, keyframe, vertex, stamp, pose, covariance in record.get("seen", ()):
        lists = {name: tuple(value) for name, value in sighting.items() if isinstance(value, list)}
        where = PoseAtStamp(keyframe, vertex, stamp, tuple(pose), np.array(covariance))
        mark = by_vertex[state.graph.edge(edge).vertices[1]]
        mark.seen.append(LandmarkEdge(edge, topic, Sighting(**sighting | lists), where))
