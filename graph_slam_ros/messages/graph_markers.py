"""The graph as markers: which edges are drawn, from where to where, and how well each fits."""

from collections.abc import Callable

import numpy as np

from graph_slam_ros.graph import POINT_PRIOR, R2, R3, SE2, SE3, EdgeType
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.graph.tables import EdgeRows
from graph_slam_ros.messages.markers import GraphView, Lines
from graph_slam_ros.slam import MapView
from graph_slam_ros.typing import Array, Index

Ends = tuple[Array, Array]

_COORDINATES = {SE2: 2, SE3: 3, R2: 2, R3: 3}


def graph_view(view: MapView, most: int) -> GraphView:
    """Draw at most so many keyframes, landmarks and edges of the graph at its estimate.

    An edge is a line between its vertices. An edge of a position alone is a line from there to the point of the robot.
    An edge without a position is not drawn.
    """
    graph, at = view.graph, _positions(view)
    drawn = {table: ends for table in graph.tables.values() if (ends := _drawn(view.space, table.type))}
    ids = np.concatenate([table.ids for table in drawn] or [np.empty(0, dtype=np.int64)])
    chi2, numbers = view.solver.chi2_of(ids)
    misfit = np.zeros(graph.edge_ids.next)
    misfit[ids] = chi2 / numbers
    shown = np.zeros(graph.edge_ids.next, dtype=bool)
    shown[_worst_and_some(ids, misfit[ids], most)] = True

    parts = [(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0, dtype=np.int64))]
    for table, ends in drawn.items():
        some = table.at(np.flatnonzero(shown[table.ids]))
        label = np.where(some.weight == 0.0, len(graph.labels), some.label)
        parts.append((*ends(view, at, some), misfit[some.ids], label))
    start, end, fit, labels = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    which = {name: labels == code for code, name in enumerate((*graph.labels, ""))}
    lines = {name: Lines(start[of], end[of], fit[of]) for name, of in which.items()}
    keyframes = view.keyframes.ids[thinned(len(view.keyframes.ids), most)]
    landmarks = np.array([mark.vertex for mark in view.landmarks.values()], dtype=np.int64)
    landmarks = landmarks[thinned(len(landmarks), most)]
    return GraphView(at[keyframes], at[landmarks], lines, rejected=lines.pop(""))


def thinned(count: int, most: int) -> Index:
    """Indices to show of ``count`` if at most ``most`` (two or more; 0: all) are allowed, with first and last.

    It takes every second, every fourth, and so on. While the count grows the choice stays the same until it is too
    large; then it is halved.
    """
    stride = 1
    while most and -(-(count - 1) // stride) + 1 > max(most, 2):
        stride *= 2
    kept = np.arange(0, count, stride)
    return kept if count == 0 or kept[-1] == count - 1 else np.append(kept, count - 1)


def _worst_and_some(ids: Index, misfit: Array, most: int) -> Index:
    """Select ids of edges with a misfit (n,), no more than ``most``, in order of their ids (n,).

    Half of them are the worst edges. The others are all edges whose id is divisible by a power of two.
    """
    if len(ids) <= most:
        return ids
    half = most // 2
    order = np.argpartition(-misfit, half)
    worst, others = ids[order[:half]], ids[order[half:]]
    stride = 1
    while len(others) > most - half:
        stride *= 2
        others = others[others % stride == 0]
    return np.sort(np.concatenate((worst, others)))


def _positions(view: MapView) -> Array:
    """Positions of all vertices that have one, each at its id, (n, 3)."""
    graph, out, every = view.graph, np.zeros((view.graph.vertex_ids.next, 3)), view.graph.vertex_ids.since()
    for code, kind in enumerate(graph.kinds):
        if n := _COORDINATES.get(kind, 0):
            ids = every[graph.kind_codes(every) == code]
            out[ids, :n] = view.solver.estimate(ids)[:, :n]
    return out


# -- the ends of the lines of some rows of a table ---------------------------------------------------------------------


def _drawn(space: Geometry, kind: EdgeType) -> Callable[[MapView, Array, EdgeRows], Ends] | None:
    if len(kind.accepts) > 1:
        return _between if all(slot[0] in _COORDINATES for slot in kind.accepts[:2]) else None
    return {
        space.pose_prior: _of_place,
        POINT_PRIOR[space.point]: _of_place,
        space.fixes["position"]: _of_antenna,
        space.coordinate_prior: _of_coordinate,
    }.get(kind)


def _between(view: MapView, at: Array, some: EdgeRows) -> Ends:
    ends = some.vertices
    return at[ends[:, 0]], at[ends[:, 1]]


def _of_place(view: MapView, at: Array, some: EdgeRows) -> Ends:
    n = view.space.dimensions
    return _in_space(some.measured[:, :n]), at[some.vertices[:, 0]]


def _of_antenna(view: MapView, at: Array, some: EdgeRows) -> Ends:
    n = view.space.dimensions
    return _in_space(some.measured[:, :n]), _in_space(_antenna(view, some))


def _of_coordinate(view: MapView, at: Array, some: EdgeRows) -> Ends:
    """A line from the nearest point with the measured coordinate."""
    n, measured, antenna = view.space.dimensions, some.measured, _antenna(view, some)
    along = measured[:, :n]
    residual = np.einsum("ij,ij->i", along, antenna) - measured[:, n]
    return _in_space(antenna - residual[:, None] * along), _in_space(antenna)


def _antenna(view: MapView, some: EdgeRows) -> Array:
    poses = view.solver.estimate(some.vertices[:, 0]).reshape(-1, view.space.pose.size)
    lever = some.measured[:, -view.space.dimensions :]
    return np.stack(view.space.group.act(tuple(poses.T), tuple(lever.T)), axis=-1)


def _in_space(points: Array) -> Array:
    return np.concatenate((points, np.zeros((len(points), 3 - points.shape[1]))), axis=1)
