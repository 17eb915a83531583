"""Pairwise consistency of loop closures that join the same two stretches of the path.

Odometry between near poses is good. So two such closures and the two short ways between their ends form a loop that
must close: pairwise consistency (Mangelson et al., "Pairwise consistent measurement set maximization", ICRA 2018,
eq. 3). Only neighbours are compared, where odometry is precise enough.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from graph_slam_ros.graph import GROUPS, RELATIVE_POSE, RELATIVE_POSE_3D, SE2, SE3, Graph
from graph_slam_ros.graph.retraction import adjoints_of_inverses, code_of
from graph_slam_ros.graph.tables import EdgeTable
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

    noise = np.linalg.inv(table.at(rows).sqrt_information)
    noise = noise @ noise.transpose(0, 2, 1)
    steps = np.abs(walked[order[ends[a]]] - walked[order[ends[b]]])
    covariance = noise[b] + _propagated(after, noise[a])
    covariance += _propagated(onwards, _walked(group, before, steps[:, 0]))
    covariance += _walked(group, after, steps[:, 1])
    distance = np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    agree = distance <= np.minimum(limits[a], limits[b])
    joined = coo_array((np.ones(np.count_nonzero(agree)), (a[agree], b[agree])), shape=(len(ends), len(ends)))
    _, group_of = connected_components(joined, directed=False)
    some = np.unique(pairs[agree])
    return [closures[some[group_of[some] == one]] for one in np.unique(group_of[some])]


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
    inverse = np.linalg.inv(table.at(rows).sqrt_information)
    steps = inverse @ inverse.transpose(0, 2, 1)
    return order, np.concatenate((np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)))


def _walked(group: Any, motion: Array, noise: Array) -> Array:
    """Covariance of the steps of a motion, as if all errors were made half way, with the average effect of turns."""
    half = _columns(group.exp, 0.5 * _columns(group.log, motion))
    return _propagated(half, noise)


def _propagated(motion: Array, covariance: Array) -> Array:
    """The covariance, in right tangent coordinates, after a further motion."""
    adjoint = adjoints_of_inverses(code_of(SE2 if motion.shape[1] == SE2.size else SE3), motion)
    return adjoint @ covariance @ adjoint.transpose(0, 2, 1)


def _compose(group: Any, a: Array, b: Array) -> Array:
    return np.stack(group.compose(tuple(a.T), tuple(b.T)), axis=-1)


def _between(group: Any, a: Array, b: Array) -> Array:
    return np.stack(group.between(tuple(a.T), tuple(b.T)), axis=-1)


def _columns(function: Callable[[tuple[Array, ...]], tuple[Array, ...]], rows: Array) -> Array:
    return np.stack(function(tuple(rows.T)), axis=-1)
