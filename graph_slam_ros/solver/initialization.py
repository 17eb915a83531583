"""Initial values from the edges alone, for graphs without values or with a bad start.

* ``tree``: poses composed along a breadth-first spanning tree of the relative poses.
* ``online``: pose after pose, in order of time: each is predicted from the estimate so far, and the incremental solver
  corrects the graph before the next closure arrives; so it often reaches the optimum where batch solvers, from any
  start, do not.
* ``chordal``: rotations from a linear least-squares problem in their matrices, brought back to rotations, then
  positions from a second one. L. Carlone, R. Tron, K. Daniilidis, F. Dellaert, "Initialization techniques for 3D SLAM:
  a survey on rotation estimation and its use in pose graph optimization", ICRA 2015.

Point landmarks are placed by their first sighting. Edges of weight 0 do not count.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import (
    GROUPS,
    INVERSE_RELATIVE_POSE,
    POINT_SEEN_FROM,
    RELATIVE_POSE,
    RELATIVE_POSE_3D,
    SE2,
    SE3,
    Edge,
    EdgeType,
    Graph,
    VertexKind,
)
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.solver.solver import Solver
from graph_slam_ros.typing import Array, Index

OnPose: TypeAlias = Callable[[int, int], None]

INITS = ("file", "tree", "chordal", "online")

_RELATIVE = {SE2: [RELATIVE_POSE, INVERSE_RELATIVE_POSE], SE3: [RELATIVE_POSE_3D]}


def initial_values(
    graph: Graph, method: str, root: int, in_time: Sequence[int] | None = None, on_pose: OnPose = lambda *_: None
) -> Array:
    """Return the stored numbers of all vertices, as ``Graph.initial``.

    Parameters
    ----------
    method : ``file`` (as they are), ``tree``, ``chordal`` or ``online``
    root : the pose that keeps its value
    in_time : all vertices in order of time, for ``online``; without, in order of id
    on_pose : called by ``online`` before each pose, with its number and how many there are; it may raise

    Raises
    ------
    GraphSlamError
        The relative poses do not join all poses to the root.
    """
    if method not in INITS:
        raise GraphSlamError(f"init {method!r}: choose {', '.join(INITS)}")
    values = graph.initial.values.copy()
    if method == "file":
        return values
    kind = graph.kind_of(root)
    if kind not in GROUPS:
        raise GraphSlamError(f"init {method}: vertex {root} is {kind.name}, not a pose")
    every = graph.vertex_ids.since()
    poses = every[graph.kind_codes(every) == graph.kinds.index(kind)]
    if method == "online":
        of_kind = set(poses.tolist())
        others = [v for v in (every.tolist() if in_time is None else in_time) if v in of_kind and v != root]
        return _replayed_values(graph, values, [root, *others], _RELATIVE[kind], POINT_SEEN_FROM[kind], on_pose)
    ends, measured = _relative_edges(graph, kind)
    _along_tree(graph, values, kind, root, poses, ends, measured)
    if method == "chordal" and len(poses) > 1:
        _chordal(graph, values, kind, root, poses, ends, measured)
    _place_landmarks(graph, values, kind)
    return values


def _relative_edges(graph: Graph, kind: VertexKind) -> tuple[Index, Array]:
    """Return vertices and measurements of the weighted relative poses, in order of id."""
    tables = [(graph.tables[edge], _weighted(graph.tables[edge])) for edge in _RELATIVE[kind] if edge in graph.tables]
    if not tables:
        return np.empty((0, 2), dtype=np.int64), np.empty((0, kind.size))
    found = [table.at(rows) for table, rows in tables]
    ends, measured, ids = (
        np.concatenate([getattr(of, name) for of in found]) for name in ("vertices", "measured", "ids")
    )
    order = np.argsort(ids)
    return ends[order], measured[order]


def _weighted(table: EdgeTable) -> Index:
    """Return the rows with a weight."""
    return np.flatnonzero(table.weight.values)


def _slots(graph: Graph, vertices: Index, size: int) -> Index:
    return graph.begins(vertices)[:, None] + np.arange(size)


def _along_tree(
    graph: Graph, values: Array, kind: VertexKind, root: int, poses: Index, ends: Index, measured: Array
) -> None:
    """Compose poses breadth first: each is as few relative poses from the root as possible."""
    group = GROUPS[kind]
    neighbours: dict[int, list[tuple[int, int, bool]]] = {}
    for row, (i, j) in enumerate(ends.tolist()):
        neighbours.setdefault(i, []).append((j, row, True))
        neighbours.setdefault(j, []).append((i, row, False))
    placed = {root: tuple(values[_slots(graph, np.array([root]), kind.size)[0]].tolist())}
    queue = deque([root])
    while queue:
        at = queue.popleft()
        for other, row, forward in neighbours.get(at, ()):
            if other not in placed:
                step = tuple(measured[row].tolist())
                placed[other] = group.compose(placed[at], step if forward else group.inverse(step))
                queue.append(other)
    missing = [v for v in poses.tolist() if v not in placed]
    if missing:
        where = f"vertex {missing[0]} and {len(missing) - 1} more"
        raise GraphSlamError(f"no relative poses lead from vertex {root} to {where}")
    ids = np.array(list(placed))
    values[_slots(graph, ids, kind.size)] = np.array([placed[v] for v in ids.tolist()])


def _chordal(
    graph: Graph, values: Array, kind: VertexKind, root: int, poses: Index, ends: Index, measured: Array
) -> None:
    position = np.full(graph.vertex_ids.next, -1, dtype=np.int64)
    position[poses] = np.arange(len(poses))
    i, j = position[ends].T
    fixed = int(position[root])
    axes = 2 if kind is SE2 else 3
    measured_rotations = _matrices(kind, measured)
    held = _matrices(kind, values[_slots(graph, np.array([root]), kind.size)])[0]
    # R_j = R_i Z, transposed: the rows of R_j' are Z' times those of R_i'
    relaxed = _linear(
        i, j, np.swapaxes(measured_rotations, 1, 2), np.zeros((len(i), axes, axes)), fixed, held.T, len(poses)
    )
    u, _, vt = np.linalg.svd(np.swapaxes(relaxed, 1, 2))
    sign = np.ones((len(poses), axes))
    sign[:, -1] = np.linalg.det(u @ vt)
    rotations = (u * sign[:, None, :]) @ vt
    offset = rotations[i] @ measured[:, :axes, None]
    here = values[_slots(graph, np.array([root]), axes)].T
    one = np.broadcast_to(np.eye(axes), (len(i), axes, axes))
    positions = _linear(i, j, one, offset, fixed, here, len(poses))[:, :, 0]
    turns = (
        Rotation.from_matrix(rotations).as_quat() if axes == 3 else np.arctan2(rotations[:, 1, :1], rotations[:, 0, :1])
    )
    values[_slots(graph, poses, kind.size)] = np.hstack([positions, turns])


def _linear(i: Index, j: Index, a: Array, b: Array, fixed: int, value: Array, count: int) -> Array:
    """Unknown matrices X of least ``sum |X_j - A X_i - B|^2`` with ``X_fixed = value``; (count, d, columns)."""
    d = a.shape[1]
    free = np.full(count, -1, dtype=np.int64)
    free[np.arange(count) != fixed] = np.arange(count - 1)
    rows = d * np.arange(len(i))[:, None] + np.arange(d)
    right = b.reshape(len(i) * d, -1).copy()
    entries: list[tuple[Array, Index, Index]] = []
    for ends, block in ((j, np.broadcast_to(np.eye(d), a.shape)), (i, -a)):
        known = ends == fixed
        right[rows[known].ravel()] -= (block[known] @ value).reshape(-1, right.shape[1])
        r, c = np.broadcast_arrays(rows[~known][:, :, None], d * free[ends[~known]][:, None, None] + np.arange(d))
        entries.append((block[~known].ravel(), r.ravel(), c.ravel()))
    data, r, c = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    system = coo_array((data, (r, c)), shape=(len(i) * d, (count - 1) * d)).tocsc()
    solved = splu((system.T @ system).tocsc(), permc_spec="MMD_AT_PLUS_A").solve(system.T @ right)
    out = np.empty((count, d, right.shape[1]))
    out[fixed] = value
    out[free >= 0] = solved.reshape(count - 1, d, -1)
    return out


def _place_landmarks(graph: Graph, values: Array, kind: VertexKind) -> None:
    table = graph.tables.get(POINT_SEEN_FROM[kind])
    if table is None:
        return
    rows = _weighted(table)
    vertices, first = np.unique(table.vertices[rows, 1], return_index=True)
    first = rows[first]
    poses = values[_slots(graph, table.vertices[first, 0], kind.size)]
    points = GROUPS[kind].act(tuple(poses.T), tuple(table.measured.values[first].T))
    values[_slots(graph, vertices, len(points))] = np.stack(points, axis=-1)


def _matrices(kind: VertexKind, values: Array) -> Array:
    """Rotation matrices (n, d, d) of poses (n, size)."""
    return GROUPS[kind].to_matrix(tuple(values.T))[:, :-1, :-1]


def _replayed_values(
    graph: Graph, values: Array, poses: Sequence[int], relative: Sequence[EdgeType], sighting: EdgeType, on_pose: OnPose
) -> Array:
    """Return the stored numbers of all vertices after an incremental solution along some poses, in order of time.

    The first pose keeps its value, and so does what is not reached. Edges of other types than these are left to what
    comes after. A GraphSlamError for a pose that no relative pose joins to an earlier one.
    """
    group, solver = GROUPS[graph.kind_of(poses[0])], Solver(graph)
    solver.start_at(values)
    rank = np.full(graph.vertex_ids.next, -1, dtype=np.int64)
    rank[list(poses)] = np.arange(len(poses))
    arriving: list[list[int]] = [[] for _ in poses]
    for table in [graph.tables[edge] for edge in (*relative, sighting) if edge in graph.tables]:
        rows = _weighted(table)
        newest = rank[table.vertices[rows]].max(axis=1)
        for edge_id, k in zip(table.ids[rows].tolist(), newest.tolist(), strict=True):
            arriving[k].append(edge_id)
    known: set[int] = set()
    for k, pose in enumerate(poses):
        on_pose(k, len(poses))
        new, edges = [pose], [graph.edge(edge_id) for edge_id in sorted(arriving[k])]
        if known:
            motions = [edge for edge in edges if edge.type is not sighting]
            solver.place(pose, _predicted(solver, group, pose, motions, rank))
        here = tuple(solver.estimate([pose])[0].tolist())
        for edge in edges:
            point = edge.vertices[1]
            if edge.type is sighting and point not in known and point not in new:
                solver.place(point, np.array(group.act(here, tuple(edge.measured.tolist()))))
                new.append(point)
        solver.add(new, [edge.id for edge in edges])
        if not known:
            solver.hold(pose)
        known.update(new)
        solver.update()
    out = values.copy()
    for vertex in sorted(known):
        out[graph.vertex(vertex).stored] = solver.estimate([vertex])[0]
    return out


def _predicted(solver: Solver, group: Any, pose: int, motions: Sequence[Edge], rank: Index) -> Array:
    """Predict a pose from the latest earlier pose that an edge joins it to."""
    best, value = -1, None
    for edge in motions:
        i, j = edge.vertices
        other, step = (i if j == pose else j), tuple(edge.measured.tolist())
        if rank[other] > best:
            best = int(rank[other])
            from_other = tuple(solver.estimate([other])[0].tolist())
            value = group.compose(from_other, step if j == pose else group.inverse(step))
    if value is None:
        raise GraphSlamError(f"init online: no relative pose joins vertex {pose} to an earlier one")
    return np.array(value)
