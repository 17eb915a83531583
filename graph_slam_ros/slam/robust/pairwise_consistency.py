"""Pairwise consistency of loop closures between the same two stretches of the path, of sightings, and of fixes.

Odometry between near poses is good. So two such closures and the two short ways between their ends form a loop that
must close: pairwise consistency (Mangelson et al., "Pairwise consistent measurement set maximization", ICRA 2018,
eq. 3). So do two sightings of a landmark and the way between them. Only neighbours are compared, where odometry is
precise enough.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from graph_slam_ros.graph import SE2, EdgeType, Graph
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry, rigid_motions
from graph_slam_ros.graph.tables import EdgeRows, EdgeTable
from graph_slam_ros.graph.vertices import adjoints_of_inverses, code_of
from graph_slam_ros.typing import Array, Index

_NEAR = 5.0  # poses between the ends of neighbours
_STRETCHES = 100  # of fixes, that many before it at most are compared with one: time grows with the number of fixes


def consistent_groups(graph: Graph, values: Array, closures: Index, limits: Array) -> list[Index]:
    """Groups of closures, each of which agrees with a neighbour in its group. Others are left out.

    Parameters
    ----------
    values : stored numbers of all vertices, the poses by odometry alone
    limits : of each closure, what chi2 its loops may have
    """
    space = space_of(graph)
    table = graph.tables.get(space.relative_pose)
    if table is None:
        return []
    codes, rows = graph.places(closures)
    of_table = codes == table.code
    closures, limits, rows = closures[of_table], limits[of_table], rows[of_table]
    ends, measured = table.at(rows).vertices, table.at(rows).measured
    order, walked = _along_odometry(graph, table)
    on_path = (order[ends] >= 0).all(axis=1)
    closures, rows, ends = (each[on_path] for each in (closures, rows, ends))
    limits, measured = limits[on_path], measured[on_path]
    pairs = cKDTree(order[ends]).query_pairs(_NEAR, p=np.inf, output_type="ndarray") if len(ends) else ends
    if not len(pairs):
        return []
    a, b = pairs.T
    at = graph.begins(ends)[:, :, None] + np.arange(space.pose.size)
    path, group = values[at], space.group  # (n, 2, size)
    before = _columns(group.between, path[b, 0], path[a, 0])
    after = _columns(group.between, path[a, 1], path[b, 1])
    onwards = _columns(group.compose, measured[a], after)
    error = _columns(group.log, _columns(group.between, measured[b], _columns(group.compose, before, onwards)))

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
    space = space_of(graph)
    if (known := _on_path(graph, space, space.sightings["position"], sightings)) is None:
        return sightings[:0]
    order, walked, some, is_some = known
    sightings, limits = sightings[is_some], limits[is_some]
    poses, landmarks = some.vertices.T
    in_time = np.lexsort((order[poses], landmarks))
    follows = landmarks[in_time[1:]] == landmarks[in_time[:-1]]
    a, b = in_time[:-1][follows], in_time[1:][follows]
    if not len(a):
        return sightings[:0]
    group, path = space.group, values[graph.begins(poses)[:, None] + np.arange(space.pose.size)]
    motion = _columns(group.between, path[a], path[b])
    seen_before, size = _columns(group.act, _columns(group.inverse, motion), some.measured[a]), space.dimensions
    axes = adjoints_of_inverses(code_of(space.pose), motion)[:, :size, :size]

    noise = _covariances(some.sqrt_information)
    moves = rigid_motions(seen_before).reshape(len(a), size, -1)
    steps = walked[order[poses[b]]] - walked[order[poses[a]]]
    covariance = noise[b] + axes @ noise[a] @ axes.transpose(0, 2, 1)
    covariance += moves @ _walked(group, motion, steps) @ moves.transpose(0, 2, 1)
    error = some.measured[b] - seen_before
    agree = _squared_sigmas(error, covariance) <= np.minimum(limits[a], limits[b])
    return sightings[np.setdiff1d(np.union1d(a, b), np.union1d(a[agree], b[agree]))]


def jumps_and_back(graph: Graph, values: Array, fixes: Index, limits: Array) -> list[Index]:
    """Stretches of fixes of positions between two steps that odometry does not explain, the second of which leads back.

    Of all stretches without such a step, those are right that agree one with the next and have most fixes. ``values``
    and ``limits`` are as for ``contradicting_sightings``.
    """
    space = space_of(graph)
    if (known := _on_path(graph, space, space.fixes["position"], fixes)) is None:
        return []
    order, walked, some, is_some = known
    fixes, limits, n = fixes[is_some], limits[is_some], space.dimensions
    poses = some.vertices[:, 0]
    path = values[graph.begins(poses)[:, None] + np.arange(space.pose.size)]
    places = some.measured[:, :n], _columns(space.group.act, path, some.measured[:, n:])
    noise = np.trace(_covariances(some.sqrt_information), axis1=1, axis2=2)
    way = np.trace(walked[order[poses]][:, :n, :n], axis1=1, axis2=2)

    def agree(a: Index, b: Index) -> NDArray[np.bool_]:
        """Return whether fixes are as far apart as odometry says."""
        apart, driven = (np.linalg.norm(of[b] - of[a], axis=-1) for of in places)
        variance = (noise[a] + noise[b] + np.abs(way[b] - way[a])) / n
        return np.asarray((apart - driven) ** 2 <= np.minimum(limits[a], limits[b]) * variance)

    in_time = np.argsort(order[poses], kind="stable")
    runs = np.split(in_time, 1 + np.flatnonzero(~agree(in_time[:-1], in_time[1:])))
    firsts, lasts = (np.array([run[k] for run in runs]) for k in (0, -1))
    most, before = np.array([len(run) for run in runs]), np.full(len(runs), -1)
    for k in range(1, len(runs)):
        since = max(0, k - _STRETCHES)
        with_k = np.where(agree(lasts[since:k], firsts[k : k + 1]), most[since:k], 0)
        before[k] = since + np.argmax(with_k) if with_k.any() else -1
        most[k] += with_k.max()
    right = [int(np.argmax(most))]
    while before[right[-1]] >= 0:
        right.append(before[right[-1]])
    return [fixes[runs[k]] for k in range(right[-1], right[0]) if k not in right]


def space_of(graph: Graph) -> Geometry:
    """Return the plane if the graph has poses in it, else space."""
    return PLANAR if SE2 in graph.kinds else SPATIAL


def odometry_in_use(graph: Graph) -> Index:
    """Return one edge of odometry to each keyframe, in order: where several lead there, the newest with weight."""
    table = graph.tables.get(space_of(graph).relative_pose)
    if table is None:
        return np.empty(0, dtype=np.int64)
    code = graph.labels.index("odometry") if "odometry" in graph.labels else -1
    rows = np.flatnonzero(table.label.values == code)
    to, weight = table.at(rows).vertices[:, 1], table.weight.values[rows]
    rows = rows[np.lexsort((rows, weight > 0.0, to))]
    to = table.at(rows).vertices[:, 1]
    return table.at(rows[np.append(to[1:] != to[:-1], True)]).ids if len(rows) else rows


def _on_path(
    graph: Graph, space: Geometry, edge_type: EdgeType, edges: Index
) -> tuple[Index, Array, EdgeRows, NDArray[np.bool_]] | None:
    """Return ``_along_odometry``, the edges of a type that are from poses on it, and which of the given they are."""
    odometry, table = graph.tables.get(space.relative_pose), graph.tables.get(edge_type)
    if odometry is None or table is None:
        return None
    order, walked = _along_odometry(graph, odometry)
    codes, rows = graph.places(edges)
    is_some = codes == table.code
    is_some[is_some] = order[table.at(rows[is_some]).vertices[:, 0]] >= 0
    some = table.at(rows[is_some])
    return (order, walked, some, is_some) if is_some.any() else None


def _along_odometry(graph: Graph, table: EdgeTable) -> tuple[Index, Array]:
    """The place of each vertex along odometry, -1 if none; and for each place the noise of all steps before it."""
    _, rows = graph.places(odometry_in_use(graph))
    order = np.full(graph.vertex_ids.next, -1)
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
    space = PLANAR if motion.shape[1] == PLANAR.pose.size else SPATIAL
    adjoint = adjoints_of_inverses(code_of(space.pose), motion)
    return adjoint @ covariance @ adjoint.transpose(0, 2, 1)


def _covariances(sqrt_information: Array) -> Array:
    """The covariances (n, d, d) of measurements with these square roots of information."""
    inverse = np.linalg.inv(sqrt_information)
    return np.asarray(inverse @ inverse.transpose(0, 2, 1))


def _squared_sigmas(error: Array, covariance: Array) -> Array:
    """Errors (n, d) in sigmas, squared: chi2 of each."""
    return np.asarray(np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0]))


def _columns(function: Callable[..., tuple[Array, ...]], *rows: Array) -> Array:
    return np.stack(function(*(tuple(of.T) for of in rows)), axis=-1)
