"""The graph as markers: which edges are drawn, from where to where, and how well each fits."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.graph import POINT_PRIOR, R2, R3, SE2, SE3, EdgeType
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.graph.tables import EdgeRows
from graph_slam_ros.messages.markers import Lines
from graph_slam_ros.messages.path_thinning import thinned, worst_and_some
from graph_slam_ros.slam import GraphSlam
from graph_slam_ros.typing import Array

Ends = tuple[Array, Array]

_COORDINATES = {SE2: 2, SE3: 3, R2: 2, R3: 3}


@dataclass(frozen=True, slots=True)
class GraphView:
    """The lines and points that represent a graph.

    Attributes
    ----------
    poses, landmarks : (n, 3)
    classes : lines of edges by label
    rejected : those of edges that are out: their weight is 0
    """

    poses: Array
    landmarks: Array
    classes: dict[str, Lines]
    rejected: Lines


def graph_view(slam: GraphSlam, most: int) -> GraphView:
    """Draw at most so many keyframes, landmarks and edges of the graph at its estimate.

    An edge is a line between its vertices. An edge of a position alone is a line from there to the point of the robot.
    An edge without a position is not drawn.
    """
    graph, at = slam.graph, _positions(slam)
    drawn = {table: ends for table in graph.tables.values() if (ends := _drawn(slam.space, table.type))}
    ids = np.concatenate([table.id.values for table in drawn] or [np.empty(0, dtype=np.int64)])
    chi2, numbers = slam.solver.chi2_of(ids)
    misfit = np.zeros(graph.edge_count)
    misfit[ids] = chi2 / numbers
    shown = np.zeros(graph.edge_count, dtype=bool)
    shown[worst_and_some(ids, misfit[ids], most)] = True

    lines: dict[str, list[Lines]] = {label: [] for label in (*graph.labels, "")}
    for table, ends in drawn.items():
        rows = np.flatnonzero(shown[table.id.values])
        some = table.at(rows)
        start, end = ends(slam, at, some)
        label = np.where(some.weight == 0.0, len(graph.labels), some.label)
        for code, name in enumerate(lines):
            of = label == code
            if of.any():
                lines[name].append(Lines(start[of], end[of], misfit[some.ids[of]]))
    joined = {name: _joined(parts) for name, parts in lines.items()}
    keyframes = slam.keyframes.ids[thinned(len(slam.keyframes.ids), most)]
    landmarks = np.array([mark.vertex for mark in slam.landmarks.values()], dtype=np.int64)
    landmarks = landmarks[thinned(len(landmarks), most)]
    return GraphView(at[keyframes], at[landmarks], joined, rejected=joined.pop(""))


def _joined(parts: list[Lines]) -> Lines:
    none = Lines(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    parts = parts or [none]
    return Lines(
        np.concatenate([part.start for part in parts]),
        np.concatenate([part.end for part in parts]),
        np.concatenate([part.misfit for part in parts]),
    )


def _positions(slam: GraphSlam) -> Array:
    """Positions of all vertices that have one, (n, 3)."""
    graph, out = slam.graph, np.zeros((slam.graph.vertex_count, 3))
    for code, kind in enumerate(graph.kinds):
        if n := _COORDINATES.get(kind, 0):
            ids = np.flatnonzero(graph.kind.values == code)
            out[ids, :n] = slam.solver.estimate(ids)[:, :n]
    return out


# -- the ends of the lines of some rows of a table ---------------------------------------------------------------------


def _drawn(space: Geometry, kind: EdgeType) -> Callable[[GraphSlam, Array, EdgeRows], Ends] | None:
    if len(kind.accepts) > 1:
        return _between if all(slot[0] in _COORDINATES for slot in kind.accepts[:2]) else None
    return {
        space.pose_prior: _of_place,
        POINT_PRIOR[space.point]: _of_place,
        space.fixes["position"]: _of_antenna,
        space.coordinate_prior: _of_coordinate,
    }.get(kind)


def _between(slam: GraphSlam, at: Array, some: EdgeRows) -> Ends:
    ends = some.vertices
    return at[ends[:, 0]], at[ends[:, 1]]


def _of_place(slam: GraphSlam, at: Array, some: EdgeRows) -> Ends:
    n = slam.space.dimensions
    return _in_space(some.measured[:, :n]), at[some.vertices[:, 0]]


def _of_antenna(slam: GraphSlam, at: Array, some: EdgeRows) -> Ends:
    n = slam.space.dimensions
    return _in_space(some.measured[:, :n]), _in_space(_antenna(slam, some))


def _of_coordinate(slam: GraphSlam, at: Array, some: EdgeRows) -> Ends:
    """A line from the nearest point with the measured coordinate."""
    n, measured, antenna = slam.space.dimensions, some.measured, _antenna(slam, some)
    along = measured[:, :n]
    residual = np.einsum("ij,ij->i", along, antenna) - measured[:, n]
    return _in_space(antenna - residual[:, None] * along), _in_space(antenna)


def _antenna(slam: GraphSlam, some: EdgeRows) -> Array:
    """The measured position of the antenna, (n, 2) or (n, 3), at the end of the row."""
    poses = slam.solver.estimate(some.vertices[:, 0]).reshape(-1, slam.space.pose.size)
    lever = some.measured[:, -slam.space.dimensions :]
    return np.stack(slam.space.group.act(tuple(poses.T), tuple(lever.T)), axis=-1)


def _in_space(points: Array) -> Array:
    return np.concatenate((points, np.zeros((len(points), 3 - points.shape[1]))), axis=1)
