"""A map on the disk, as a whole: ``map.mcap``, the newest of a run, and ``start.mcap``, that which the run began in.

Each is an mcap file that is replaced as a whole. Its channels are

* ``map``, one message in JSON: the version of the format, and all that is no column of numbers;
* ``landmarks``, a message in JSON for each: its fields, and those of its sightings that do not tell which it is;
* columns of numbers, end to end, little endian, ``<i8`` or ``<f8``: of vertices (``kind``, ``initial``, ``values``,
  lasting ``vertex_ids``), of keyframes and of poses at which something was seen, of edges by type
  (``EDGE_SE2/measured``; lasting ``edge_ids``), of verdicts (``ledger/statistic``), of their changes.
"""

import io
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Message
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from graph_slam_ros.edge_tags import edge_of, tag_of
from graph_slam_ros.errors import FormatError, GraphSlamError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.vertices import GROUPS, R1, R2, R3, SE2, SE3
from graph_slam_ros.measurements.edits import applied_edit
from graph_slam_ros.measurements.types import Sighting, sighting_record
from graph_slam_ros.recordings.mcap_records import LIBRARY, records
from graph_slam_ros.runs.journal import MAP, SCHEMA, START
from graph_slam_ros.slam.frontend.corrections import read_totals
from graph_slam_ros.slam.frontend.gyro import SavedBias
from graph_slam_ros.slam.frontend.keyframes import Keyframe, SightingPose
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.landmarks.landmark import Landmark, LandmarkEdge
from graph_slam_ros.slam.lifelong.place import VisitScale, place_of
from graph_slam_ros.slam.lifelong.state import BoundedState
from graph_slam_ros.slam.noise.factors import factors_record, read_factors
from graph_slam_ros.slam.robust.ledger import Ledger, Reason, Verdict, VerdictChange
from graph_slam_ros.slam.snapshot import MapSnapshot

VERSION = 4
_KINDS = {kind.name: kind for kind in (SE2, SE3, R1, R2, R3)}
_AS_THEY_ARE = ("segments", "drives", "settings", "displacements", "processed", "drive")  # of a snapshot, in JSON
_OF_EDGES = ("id", "vertices", "measured", "sqrt_information", "label", "source", "weight")
_ROWS = {"id": "edge_row", "vertices": "vertex_rows"}  # as a table calls these: they are rows, not ids
_OF_VERDICTS = ("keyframe", "statistic", "threshold", "numbers", "verdict", "reason")
_OF_CHANGES = tuple(field.name for field in fields(VerdictChange))
_OF_LANDMARKS = tuple(field.name for field in fields(Landmark) if field.name not in ("seen", "stamps"))

Told = dict[str, Any]
Columns = dict[str, NDArray[Any]]


def write_map(file: Path, state: MapSnapshot) -> int:
    """Write a map, completely or not at all. Returns the number of bytes. Raises OSError."""
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.ZSTD)
    writer.start(profile="", library=LIBRARY)
    schema = writer.register_schema(SCHEMA, "", b"")
    stamp_ns = int(state.keyframes.stamps_ns[-1])

    def add(name: str, encoding: str, several: Iterator[bytes]) -> None:
        channel = writer.register_channel(name, encoding, schema)
        for sequence, data in enumerate(several):
            writer.add_message(channel, stamp_ns, data, stamp_ns, sequence)

    add("map", "json", iter([_as_json(_told(state))]))
    add("landmarks", "json", (_as_json(_landmark(state.graph, mark)) for mark in state.landmarks.values()))
    for name, numbers in _columns(state):
        encoding = "<f8" if numbers.dtype.kind == "f" else "<i8"
        add(name, encoding, iter([np.ascontiguousarray(numbers, dtype=encoding).tobytes()]))
    writer.finish()  # type: ignore[no-untyped-call]
    data = out.getvalue()
    write_whole(file, data)
    return len(data)


def read_map(folder: Path) -> MapSnapshot | None:
    """The newest map of a run folder, or None. Raises FormatError: it is of another version, damaged, or no map."""
    return _read(folder / MAP)


def read_start(folder: Path) -> MapSnapshot | None:
    """The map that a run began in; None if it began in none. Raises FormatError as ``read_map`` does."""
    state = _read(folder / START)
    if state is not None:
        state.continues = True
    return state


def _read(file: Path) -> MapSnapshot | None:
    name, losses = f"{file.parent.name}/{file.name}", list[str]()
    try:
        parts = _parts(file, losses)
        if parts is None:
            return None
        told = json.loads(parts.pop("map")[0])
        if told["version"] != VERSION:
            raise FormatError(f"its version is {told['version']}; this program knows version {VERSION}")
        marks = list(map(json.loads, parts.pop("landmarks", [])))
        state = _state(told, marks, {column: numbers for column, (numbers,) in parts.items()})
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, GraphSlamError) as error:
        raise FormatError(f"{name}: {losses[0] if losses else f'no map: {error}'}") from None
    if losses:
        raise FormatError(f"{name}: {losses[0]}")
    state.folder = file.parent
    return state


# -- the file ---------------------------------------------------------------------------------------------------------


def _as_json(content: Any) -> bytes:
    return json.dumps(content, separators=(",", ":"), allow_nan=False, default=lambda one: one.tolist()).encode()


def _parts(file: Path, losses: list[str]) -> dict[str, list[Any]] | None:
    """The messages of each channel, those of numbers as arrays; None where there is no file."""
    encodings, parts = dict[int, tuple[str, str]](), dict[str, list[Any]]()
    try:
        for record in records(file, losses, follow=False):
            if isinstance(record, Channel):
                encodings[record.id] = record.topic, record.message_encoding
            elif isinstance(record, Message):
                name, encoding = encodings[record.channel_id]
                data = record.data if encoding == "json" else np.frombuffer(record.data, dtype=encoding)
                parts.setdefault(name, []).append(data)
    except FileNotFoundError:
        return None
    return parts


# -- what is written --------------------------------------------------------------------------------------------------


def _told(state: MapSnapshot) -> Told:
    """All of a map but its columns and landmarks."""
    graph, bounded, vertex, edge = state.graph, state.bounded, state.graph.vertex_ids, state.graph.edge_ids
    return {
        "type": "map",
        "version": VERSION,
        "kinds": [kind.name for kind in graph.kinds],
        "tags": [tag_of(edge) for edge in graph.tables],
        "labels": graph.labels,
        "sources": graph.sources,
        "next": {"vertex": vertex.later, "edge": edge.later},
        "first": state.keyframes.first,
        "frozen": [vertex.first_from(state.frozen), edge.first_from(state.ledger.final)],
        "held": [vertex.first_from(state.held[0]), edge.first_from(state.held[1])],
        "datum": state.datum,
        "used": [state.used_ns],
        "noise": factors_record(state.noise_factors),
        "calibration": factors_record(state.calibration),
        "edits": [one.record for one in state.edits],
        "gyro": None if state.gyro_bias is None else astuple(state.gyro_bias),
        "condensed": None if bounded is None else _condensed(graph, bounded),
        **{name: getattr(state, name) for name in _AS_THEY_ARE},
    }


def _condensed(graph: Graph, state: BoundedState) -> Told:
    """The state of a condensed map that is not in its graph."""
    vertex, edge, places = graph.vertex_ids.row, graph.edge_ids.row, []
    for cell, several in state.places.items():
        for one in several:
            strikes = [(vertex(mark), count) for mark, count in one.strikes.items()]
            at = one.place.linearized_at.numbers.tolist()
            places.append([cell, edge(one.edge), one.place.visits, strikes, at])
    return {
        "places": places,
        "old": [(number, vertex(one.vertex), one.stamp_ns, one.T_odom_base) for number, one in state.old.items()],
        "left": [state.keyframes, state.sightings],
        "scale": astuple(state.scale),
        "accepted": [[first, dict(of)] for first, of in state.accepted.items()],
        "begins": list(state.begins.items()),
    }


def _landmark(graph: Graph, mark: Landmark) -> Told:
    seen, vertex = [], graph.vertex_ids.row
    for one in mark.seen:
        at = one.where
        where = [at.keyframe, vertex(at.vertex), at.stamp_ns, at.T_keyframe_base, at.covariance.tolist()]
        seen.append([graph.edge_ids.row(one.edge), one.topic, sighting_record(one.sighting), *where])
    told = {name: getattr(mark, name) for name in _OF_LANDMARKS} | {"vertex": vertex(mark.vertex)}
    return told | ({"seen": seen} if seen else {})


def _columns(state: MapSnapshot) -> Iterator[tuple[str, NDArray[Any]]]:
    graph, ledger = state.graph, state.ledger
    yield from (("kind", graph.kind.values), ("initial", graph.initial.values), ("values", state.values))
    yield from (("vertex_ids", graph.vertex_ids.early), ("edge_ids", graph.edge_ids.early))
    yield "keyframes/id", graph.vertex_ids.rows(state.keyframes.ids)
    yield "sightings/id", state.sighting_poses.ids
    for name, poses in (("keyframes", state.keyframes), ("sightings", state.sighting_poses)):
        yield from ((f"{name}/stamp_ns", poses.stamps_ns), (f"{name}/pose", poses.poses))
    for edge, table in graph.tables.items():
        yield from ((f"{tag_of(edge)}/{name}", getattr(table, _ROWS.get(name, name)).values) for name in _OF_EDGES)
    yield from ((f"ledger/{name}", getattr(ledger, name).values) for name in _OF_VERDICTS)
    yield "ledger/residual", ledger.residuals.values
    for name in _OF_CHANGES:
        kind = np.float64 if name in ("statistic", "threshold") else np.int64
        numbers: NDArray[Any] = np.array([getattr(one, name) for one in ledger.history], dtype=kind)
        yield f"history/{name}", ledger.ids.rows(numbers) if name == "edge" else numbers


# -- what is read -----------------------------------------------------------------------------------------------------


def _state(told: Told, marks: Sequence[Told], columns: Columns) -> MapSnapshot:
    graph = _graph(told, columns)
    (frozen, final), held, vertex, edge = told["frozen"], told["held"], graph.vertex_ids.of, graph.edge_ids.of
    first, gyro, condensed = told["first"], told["gyro"], told["condensed"]
    size = next((kind.size for kind in graph.kinds if kind in GROUPS), 3)
    columns["keyframes/id"] = graph.vertex_ids.of_all(columns["keyframes/id"])
    return MapSnapshot(
        graph=graph,
        ledger=_ledger(graph, columns, final),
        values=columns["values"].copy(),
        keyframes=_poses(StampedPoses(Keyframe, size, first), "keyframes", columns),
        sighting_poses=_poses(StampedPoses(SightingPose, size), "sightings", columns),
        landmarks={mark["name"]: _read_landmark(graph, mark) for mark in marks},
        frozen=frozen and vertex(frozen),
        held=(held[0] and vertex(held[0]), held[1] and edge(held[1])),
        datum=tuple(told["datum"]),
        used_ns=told["used"][0],
        noise_factors=read_factors(told["noise"]),
        edits=list(map(applied_edit, told["edits"])),
        calibration=read_totals(told["calibration"]),
        gyro_bias=None if gyro is None else SavedBias(gyro[0], tuple(gyro[1]), tuple(gyro[2]), gyro[3]),
        bounded=None if condensed is None else _bounded(graph, condensed),
        **{name: told[name] for name in _AS_THEY_ARE},
    )


def _graph(told: Told, columns: Columns) -> Graph:
    graph, codes, initial = Graph(), columns["kind"], columns["initial"]
    kinds, begin = [_KINDS[name] for name in told["kinds"]], 0
    for some in np.split(codes, np.flatnonzero(np.diff(codes)) + 1):
        if len(some):
            kind, end = kinds[some[0]], begin + len(some) * kinds[some[0]].size
            graph.add_vertices(kind, initial[begin:end].reshape(len(some), kind.size))
            begin = end
    graph.labels[:], graph.sources[:] = told["labels"], told["sources"]
    for tag in told["tags"]:
        _add_edges(graph, tag, columns)
    for table in graph.tables.values():
        graph.table_of_edge.values[table.edge_row.values] = table.code
        graph.row_of_edge.values[table.edge_row.values] = np.arange(len(table))
    for name, of in (("vertex", graph.vertex_ids), ("edge", graph.edge_ids)):
        of.put(columns[f"{name}_ids"].copy(), told["next"][name])
    return graph


def _add_edges(graph: Graph, tag: str, columns: Columns) -> None:
    """Add the edges of a type."""
    edge, of = edge_of(tag), {name: columns[f"{tag}/{name}"] for name in _OF_EDGES}
    count, m = len(of["id"]), edge.residual_size
    if not count:
        return
    vertices = of["vertices"].reshape(count, len(edge.accepts))
    measured, roots = of["measured"].reshape(count, -1), of["sqrt_information"].reshape(count, m, m)
    graph.add_edges(edge, vertices, measured, Gaussian(roots), graph.labels[0], graph.sources[0])
    for name in ("id", "label", "source", "weight"):
        getattr(graph.tables[edge], _ROWS.get(name, name)).values[:] = of[name]


def _poses(out: StampedPoses[Any], name: str, columns: Columns) -> StampedPoses[Any]:
    out.extend(columns[f"{name}/id"], columns[f"{name}/stamp_ns"], columns[f"{name}/pose"])
    return out


def _ledger(graph: Graph, columns: Columns, final: int) -> Ledger:
    ledger, of = Ledger(), {name: columns[f"ledger/{name}"] for name in _OF_VERDICTS}
    residual = columns["ledger/residual"]
    is_judged = of["verdict"] != Verdict.NOT_EVALUATED
    ledger.enter(of["keyframe"], of["statistic"], of["numbers"], of["threshold"], residual, is_judged)
    ledger.verdict.values[:], ledger.reason.values[:] = of["verdict"], of["reason"]
    ledger.ids.put(graph.edge_ids.early, graph.edge_ids.later)
    changes = (columns[f"history/{name}"].tolist() for name in _OF_CHANGES)
    ledger.history = [
        VerdictChange(graph.edge_ids.of(edge), keyframe, Verdict(verdict), Reason(reason), statistic, threshold)
        for edge, keyframe, verdict, reason, statistic, threshold in zip(*changes, strict=True)
    ]
    ledger.finish(final and graph.edge_ids.of(final))
    return ledger


def _read_landmark(graph: Graph, told: Told) -> Landmark:
    mark = Landmark(**{name: told[name] for name in _OF_LANDMARKS} | {"vertex": graph.vertex_ids.of(told["vertex"])})
    for edge, topic, sighting, keyframe, vertex, stamp_ns, pose, covariance in told.get("seen", ()):
        lists = {name: tuple(value) for name, value in sighting.items() if isinstance(value, list)}
        where = PoseAtStamp(keyframe, graph.vertex_ids.of(vertex), stamp_ns, tuple(pose), np.array(covariance))
        mark.seen.append(LandmarkEdge(graph.edge_ids.of(edge), topic, Sighting(**sighting | lists), where))
    mark.stamps = {one.where.stamp_ns for one in mark.seen}
    return mark


def _bounded(graph: Graph, told: Told) -> BoundedState:
    keyframes, sightings = told["left"]
    state = BoundedState(keyframes=keyframes, sightings=sightings, scale=VisitScale(*told["scale"]))
    state.accepted |= {first: Counter(of) for first, of in told["accepted"]}
    state.begins |= dict(told["begins"])
    of = graph.vertex_ids.of
    for cell, number, visits, strikes, at in told["places"]:
        edge, where = graph.edge(graph.edge_ids.of(number)), np.array(at, dtype=np.float64)
        place = place_of(edge, where, visits, {of(mark): count for mark, count in strikes})
        state.places.setdefault(tuple(cell), []).append(place)
    state.old |= {number: Keyframe(of(vertex), stamp, tuple(pose)) for number, vertex, stamp, pose in told["old"]}
    return state
