"""Pairwise consistency of loop closures that join the same two stretches of the path, and of sightings of a landmark.

Odometry between near poses is good. So two such closures and the two short ways between their ends form a loop that
must close: pairwise consistency (Mangelson et al., "Pairwise consistent measurement set maximization", ICRA 2018,
eq. 3). So do two sightings of a landmark and the way between them. Only neighbours are compared, where odometry is
precise enough.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from graph_slam_ros.graph import GROUPS, POINT_SEEN_FROM, RELATIVE_POSE, RELATIVE_POSE_3D, SE2, SE3, Graph
from graph_slam_ros.graph.geometry import rigid_motions
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.graph.vertices import adjoints_of_inverses, code_of
from graph_slam_ros.typing import Array, Index

_NEAR = 5.0  # poses between the ends of neighbours


def consistent_groups(graph: Graph, values: Array, closures: Index, limits: Array) -> list[Index]:
    """Groups of closures, each of which agrees with a neighbour in its group. Others are left out.

    Parameters
    ----------
    values : stored numbers of all vertices, the poses by odometry alone
    limits : of each closure, what chi2 its loops may have
    """
    kind, edge_type = (SE2, RELATIVE_POSE) if SE2 in graph.kinds else (SE3, RELATIVE_POSE_3D)
    table = graph.tables.get(edge_type)
    if table is None:
        return []
    of_table = graph.table_of_edge.values[closures] == table.code
    closures, limits = closures[of_table], limits[of_table]
    rows = graph.row_of_edge.values[closures]
    ends, measured = table.at(rows).vertices, table.at(rows).measured
    order, walked = _along_odometry(graph, table)
    on_path = (order[ends] >= 0).all(axis=1)
    closures, rows, ends = (each[on_path] for each in (closures, rows, ends))
    limits, measured = limits[on_path], measured[on_path]
    pairs = cKDTree(order[ends]).query_pairs(_NEAR, p=np.inf, output_type="ndarray") if len(ends) else ends
    if not len(pairs):
        return []
    a, b = pairs.T
    at = graph.offset.values[ends][:, :, None] + np.arange(kind.size)
    path = values[at]  # (n, 2, size)
    group = GROUPS[kind]
    before = _between(group, path[b, 0], path[a, 0])
    after = _between(group, path[a, 1], path[b, 1])
    onwards = _compose(group, measured[a], after)
    error = _columns(group.log, _between(group, measured[b], _compose(group, before, onwards)))

    noise = _covariances(table.at(rows).sqrt_information)
    steps = np.abs(walked[order[ends[a]]] - walked[order[ends[b]]])
    covariance = noise[b] + _propagated(after, noise[a])
    covariance += _propagated(onwards, _walked(group, before, steps[:, 0]))
    covariance += _walked(group, after, steps[:, 1])
    agree = _squared_sigmas(error, covariance) <= np.minimum(limits[a], limits[b])
    joined = coo_array((np.ones(np.count_nonzero(agree)), (a[agree], b[agree])), shape=(len(ends), len(ends)))
    _, group_of = connected_components(joined, directed=False)
    some = np.unique(pairs[agree])
    return [closures[some[group_of[some] == one]] for one in np.unique(group_of[some])]


def contradicting_sightings(graph: Graph, values: Array, sightings: Index, limits: Array) -> Index:
    """Return sightings of points that agree neither with the one before nor with the one after of the same landmark.

    Sightings of a landmark that is seen only once, and what is no position of a point, contradict nothing.

    Parameters
    ----------
    values : stored numbers of all vertices, the poses by odometry alone
    limits : of each sighting, what chi2 it may have
    """
    kind, edge_type = (SE2, RELATIVE_POSE) if SE2 in graph.kinds else (SE3, RELATIVE_POSE_3D)
    odometry, table = graph.tables.get(edge_type), graph.tables.get(POINT_SEEN_FROM[kind])
    if odometry is None or table is None:
        return sightings[:0]
    order, walked = _along_odometry(graph, odometry)
    is_of_table = graph.table_of_edge.values[sightings] == table.code
    sightings, limits = sightings[is_of_table], limits[is_of_table]
    some = table.at(graph.row_of_edge.values[sightings])
    poses, landmarks = some.vertices.T
    in_time = np.lexsort((order[poses], landmarks))
    in_time = in_time[order[poses[in_time]] >= 0]
    follows = landmarks[in_time[1:]] == landmarks[in_time[:-1]]
    a, b = in_time[:-1][follows], in_time[1:][follows]
    if not len(a):
        return sightings[:0]
    group, path = GROUPS[kind], values[graph.offset.values[poses][:, None] + np.arange(kind.size)]
    motion = _between(group, path[a], path[b])
    back, size = group.inverse(tuple(motion.T)), some.measured.shape[1]
    seen_before = np.stack(group.act(back, tuple(some.measured[a].T)), axis=-1)
    axes = adjoints_of_inverses(code_of(kind), motion)[:, :size, :size]

    noise = _covariances(some.sqrt_information)
    moves = rigid_motions(seen_before).reshape(len(a), size, -1)
    steps = walked[order[poses[b]]] - walked[order[poses[a]]]
    covariance = noise[b] + axes @ noise[a] @ axes.transpose(0, 2, 1)
    covariance += moves @ _walked(group, motion, steps) @ moves.transpose(0, 2, 1)
    error = some.measured[b] - seen_before
    agree = _squared_sigmas(error, covariance) <= np.minimum(limits[a], limits[b])
    return sightings[np.setdiff1d(np.union1d(a, b), np.union1d(a[agree], b[agree]))]


def odometry_in_use(graph: Graph) -> Index:
    """Return one edge of odometry to each keyframe, in order: where several lead there, the newest with weight."""
    table = graph.tables.get(RELATIVE_POSE if SE2 in graph.kinds else RELATIVE_POSE_3D)
    if table is None:
        return np.empty(0, dtype=np.int64)
    code = graph.labels.index("odometry") if "odometry" in graph.labels else -1
    rows = np.flatnonzero(table.label.values == code)
    to, weight = table.vertices.values[rows, 1], table.weight.values[rows]
    rows = rows[np.lexsort((rows, weight > 0.0, to))]
    to = table.vertices.values[rows, 1]
    return table.id.values[rows[np.append(to[1:] != to[:-1], True)]] if len(rows) else rows


def _along_odometry(graph: Graph, table: EdgeTable) -> tuple[Index, Array]:
    """The place of each vertex along odometry, -1 if none; and for each place the noise of all steps before it."""
    rows = graph.row_of_edge.values[odometry_in_use(graph)]
    order = np.full(graph.vertex_count, -1)
    vertices = table.at(rows).vertices
    order[vertices[:, 0]] = np.arange(len(rows))
    order[vertices[:, 1]] = np.arange(1, len(rows) + 1)
    steps = _covariances(table.at(rows).sqrt_information)
    return order, np.concatenate((np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)))


def _walked(group: Any, motion: Array, noise: Array) -> Array:
    """Covariance of the steps of a motion, as if all errors were made half way, with the average effect of turns."""
    half = _columns(group.exp, 0.5 * _columns(group.log, motion))
    return _propagated(half, noise)


def _propagated(motion: Array, covariance: Array) -> Array:
    """The covariance, in right tangent coordinates, after a further motion."""
    adjoint = adjoints_of_inverses(code_of(SE2 if motion.shape[1] == SE2.size else SE3), motion)
    return adjoint @ covariance @ adjoint.transpose(0, 2, 1)


def _covariances(sqrt_information: Array) -> Array:
    """The covariances (n, d, d) of measurements with these square roots of information."""
    inverse = np.linalg.inv(sqrt_information)
    return np.asarray(inverse @ inverse.transpose(0, 2, 1))


def _squared_sigmas(error: Array, covariance: Array) -> Array:
    """Errors (n, d) in sigmas, squared: chi2 of each."""
    return np.asarray(np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0]))


def _compose(group: Any, a: Array, b: Array) -> Array:
    return np.stack(group.compose(tuple(a.T), tuple(b.T)), axis=-1)


def _between(group: Any, a: Array, b: Array) -> Array:
    return np.stack(group.between(tuple(a.T), tuple(b.T)), axis=-1)


def _columns(function: Callable[[tuple[Array, ...]], tuple[Array, ...]], rows: Array) -> Array:
    return np.stack(function(tuple(rows.T)), axis=-1)
