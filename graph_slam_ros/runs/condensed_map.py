"""What has left a map when visits were condensed, in ``condensed.mcap``; and the whole path, with those keyframes.

It has a record ``left`` each time: the number of its first keyframe, how many poses had left before, and the rows of
``slam.lifelong.state.record_type`` in base64. ``left_edges`` has the table of the edges. A map may know of fewer than
are there, if its run was killed: the others do not count.
"""

import base64
import csv
import io
from collections.abc import Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.errors import FormatError
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.runs.journal import CONDENSED, read_records
from graph_slam_ros.slam import MapView
from graph_slam_ros.slam.bounded_map import Condensation, CondensedEdge
from graph_slam_ros.slam.lifelong.state import BoundedState, Left, Records, record_type
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index

Record = dict[str, Any]


def left_records(done: Condensation) -> Iterator[Record]:
    """Yield the records of what has left a map."""
    left = done.left
    rows = {"keyframes": _text(left.keyframes), "sightings": _text(left.sightings)}
    yield {"type": "left", "first": done.first, "sightings_before": done.sightings_before, **rows}
    if done.edges:
        yield {"type": "left_edges", "first": done.first, "table": rows_text(done.edges, CondensedEdge, has_head=False)}


def carried(folder: Path, space: Geometry, state: BoundedState) -> list[Record]:
    """Return the records of what has left a map, which a run that goes on in it has, too.

    Raises FormatError: some of those that the map knows of are missing.
    """
    known = [record for record in read_records(folder, CONDENSED, []) if record["first"] < state.keyframes]
    left = _joined(space, known)
    if (len(left.keyframes), len(left.sightings)) != (state.keyframes, state.sightings):
        raise FormatError(
            f"{folder}: {CONDENSED}.mcap has {len(left.keyframes)} keyframes, and {state.keyframes} have left the map: "
            f"the others are lost; graph_slam replay {folder} --out NEW makes the map anew"
        )
    return known


def _joined(space: Geometry, known: list[Record]) -> Left:
    kind, left = record_type(space), [record for record in known if record["type"] == "left"]
    return Left.joined(space, [Left(_rows(one["keyframes"], kind), _rows(one["sightings"], kind)) for one in left])


def read_left_edges(folder: Path) -> Iterator[dict[str, str]]:
    """Yield the rows of the edges that have left the map of a run, by column."""
    columns = [field.name for field in fields(CondensedEdge)]
    for record in read_records(folder, CONDENSED, [], "left_edges"):
        yield from csv.DictReader(io.StringIO(record["table"]), columns)


def _text(rows: Records) -> str:
    return base64.b64encode(rows.tobytes()).decode()


def _rows(text: str, kind: np.dtype[np.void]) -> Records:
    return np.frombuffer(base64.b64decode(text), dtype=kind)


def rows_text(rows: Iterable[Any], kind: type[Any], *, has_head: bool = True) -> str:
    """Return dataclasses of a kind as the rows of a table of edges."""
    out, names = io.StringIO(), [field.name for field in fields(kind)]
    writer = csv.writer(out, lineterminator="\n")
    writer.writerows([names] if has_head else [])
    writer.writerows([_word(getattr(row, name)) for name in names] for row in rows)
    return out.getvalue()


def _word(value: Any) -> str:
    if isinstance(value, Verdict | Reason):
        return value.name.lower()
    return " ".join(map(repr, value)) if isinstance(value, tuple) else str(value)


class WholePath:
    """All keyframes of a pipeline, with those ``left`` behind as they were condensed, in order of time.

    Attributes
    ----------
    left : what has left its map
    stamps_ns : (n,) of the keyframes
    odometry : (n, size) their poses by odometry alone, ``T_odom_base``
    """

    def __init__(self, view: MapView, left: Left) -> None:
        self._view, self.left = view, left
        removed, keyframes = left.keyframes, view.keyframes
        self.stamps_ns: Index = np.concatenate((removed["stamp_ns"], keyframes.stamps_ns))
        self.odometry: Array = np.concatenate((removed["T_odom"], keyframes.poses.reshape(-1, view.space.pose.size)))

    @classmethod
    def of(cls, view: MapView, folder: Path) -> "WholePath":
        """Return that of a pipeline whose run folder has what was condensed. Raises FormatError where that is lost."""
        known = [] if view.bounded is None else carried(folder, view.space, view.bounded)
        return cls(view, _joined(view.space, known))

    def poses(self, solver: Solver | None = None) -> Array:
        """Return the poses ``T_map_base``, (n, size); of another solution of the graph if given."""
        view, solver = self._view, solver or self._view.solver
        path = solver.estimate(view.keyframes.ids).reshape(-1, view.space.pose.size)
        if view.bounded is None:
            return path
        old = [one.vertex for one in view.bounded.old.values()]
        vertices = np.sort(np.array([*old, *view.keyframes.ids.tolist()], dtype=np.int64))
        return np.concatenate((self.left.path(view.space, vertices, solver.estimate(vertices)), path))
