"""One update of the clique tree: what changed goes in, the steps of what it moves come out."""

import numpy as np

from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.numeric import back_substitute, eliminate
from graph_slam_ros.solver.ordering import key_of, move_tail
from graph_slam_ros.solver.symbolic import build, cliques_of, collect, mark, release, room_for, structure
from graph_slam_ros.solver.tree import (
    ACTIVE,
    AFFECTED,
    BLOCK,
    BLOCKS_TOP,
    CLIQUE,
    CLIQUES,
    COUNT,
    DOF,
    END,
    FLOPS,
    FREE,
    FRONT_DOF,
    FRONTS_TOP,
    FULL_DOF,
    KEY,
    KIND,
    LINK,
    LINK_EDGE,
    LINK_NEXT,
    LINKS,
    LOCAL,
    MEMBERS_TOP,
    NEXT,
    NOTHING,
    REGION,
    ROWS,
    STEP,
    TAIL_END,
    TAKEN,
    VALUE,
    Array,
    Index,
    Tree,
)

DONE, NO_ROOM, SINGULAR = range(3)


@kernel
def append_vertices(t: Tree, first: int, offset: Index, initial: Array, dof: Index, size: Index, kind: Index) -> None:
    """Write the records of new vertices, not yet unknowns, with their initial values."""
    step = 0 if first == 0 else t.vertex[first - 1, STEP] + t.vertex[first - 1, DOF]
    for k in range(len(offset)):
        v = first + k
        t.vertex[v, :] = NOTHING
        t.vertex[v, FREE] = 0
        t.vertex[v, DOF], t.vertex[v, KIND] = dof[k], kind[k]
        t.vertex[v, STEP], t.vertex[v, VALUE] = step, offset[k]
        for i in range(dof[k]):
            t.step[step + i] = 0.0
        for i in range(size[k]):
            x = initial[offset[k] + i]
            t.value[offset[k] + i] = x
            t.estimate[offset[k] + i] = x
        step += dof[k]


@kernel
def append_edges(t: Tree, ids: Index, ends: Index, rows: int) -> None:
    """Write the records of edges, in the structure, and link them to their vertices."""
    for k in range(len(ids)):
        e = ids[k]
        width = 0
        t.edge[e, COUNT], t.edge[e, ROWS] = ends.shape[1], rows
        for s in range(ends.shape[1]):
            v = ends[k, s]
            t.edge[e, END + s] = v
            width += t.vertex[v, DOF]
            link = t.state[LINKS]
            t.state[LINKS] += 1
            t.link[link, LINK_EDGE], t.link[link, LINK_NEXT] = e, t.vertex[v, LINK]
            t.vertex[v, LINK] = link
        t.edge[e, BLOCK] = t.state[BLOCKS_TOP]
        t.state[BLOCKS_TOP] += rows * (width + 1)
        t.edge[e, ACTIVE] = 1
        t.edge[e, TAKEN] = 0


@kernel
def enter_tail(t: Tree, vertices: Index) -> None:
    """Make vertices unknowns, the newest."""
    for v in vertices:
        t.vertex[v, FREE] = 1
        t.vertex[v, REGION] = t.vertex[v, NEXT] = NOTHING
        t.vertex[v, KEY] = key_of(-1, 0, v)
        t.tail[t.state[TAIL_END]] = v
        t.state[TAIL_END] += 1


@kernel
def ends_of(t: Tree, edges: Index) -> Index:
    """The vertices of edges; some more than once."""
    out = np.empty(3 * len(edges), np.int64)
    count = 0
    for e in edges:
        for s in range(t.edge[e, COUNT]):
            out[count] = t.edge[e, END + s]
            count += 1
    return out[:count]


@kernel
def restructure(
    t: Tree, touched: Index, new: Index, tail: int, damping: float, tolerance: float
) -> tuple[int, int, Index]:
    """Put changes of the structure into the tree and solve.

    Parameters
    ----------
    touched : vertices whose edges changed; new : vertices that are not in it yet
    tail : how many of the newest vertices stay last in the order

    Returns
    -------
    what became of it; with SINGULAR the vertex without a pivot; the vertices that moved. With NO_ROOM nothing has
    changed, ``state`` says how long the pools must be, and the vertices are those to touch when it is tried again.
    """
    touched = move_tail(t, tail, touched)
    marked = mark(t, touched)
    order, orphans = collect(t, marked, new)
    start, later = structure(t, order, orphans)
    group, last, size = cliques_of(t, order, start, later)
    cliques, members, numbers = room_for(t, size)
    if (
        t.state[CLIQUES] + cliques > len(t.clique)
        or t.state[MEMBERS_TOP] + members > len(t.members)
        or t.state[FRONTS_TOP] + numbers > len(t.fronts)
    ):
        return NO_ROOM, NOTHING, touched
    created = build(t, order, start, later, group, last, size, orphans)
    release(t, marked)
    t.state[AFFECTED] += len(order)
    return _renumber(t, created, damping, tolerance)


@kernel
def renumber(t: Tree, touched: Index, damping: float, tolerance: float) -> tuple[int, int, Index]:
    """Put changes of numbers alone into the tree and solve; returns as ``restructure``."""
    return _renumber(t, mark(t, touched), damping, tolerance)


@kernel
def _renumber(t: Tree, cliques: Index, damping: float, tolerance: float) -> tuple[int, int, Index]:
    for c in cliques:
        t.state[FLOPS] += t.clique[c, FULL_DOF] ** 2 * t.clique[c, FRONT_DOF]
    failed = eliminate(t, cliques, damping)
    if failed != NOTHING:
        return SINGULAR, failed, cliques[:0]
    return DONE, NOTHING, back_substitute(t, cliques, tolerance)


@kernel
def relinearize(t: Tree, moved: Index, threshold: float) -> Index:
    """Move the linearisation points of vertices whose step is above the threshold; returns all edges on them."""
    edges = np.empty(64, np.int64)
    count = 0
    for v in moved:
        step = t.step[t.vertex[v, STEP] : t.vertex[v, STEP] + t.vertex[v, DOF]]
        largest = 0.0
        for d in step:
            largest = max(largest, abs(d))
        if largest <= threshold:
            continue
        settle(t, v)
        a = t.vertex[v, LINK]
        while a != NOTHING:
            e = t.link[a, LINK_EDGE]
            a = t.link[a, LINK_NEXT]
            if t.edge[e, ACTIVE] == 1 and t.edge[e, TAKEN] == 0:
                t.edge[e, TAKEN] = 1
                if count == len(edges):
                    edges = np.concatenate((edges, np.empty(count, np.int64)))
                edges[count] = e
                count += 1
    for e in edges[:count]:
        t.edge[e, TAKEN] = 0
    return np.sort(edges[:count])


@kernel
def settle(t: Tree, v: int) -> None:
    """The estimate becomes the linearisation point."""
    x, d = t.vertex[v, VALUE], t.vertex[v, STEP]
    for i in range(t.vertex[v, DOF]):
        t.step[d + i] = 0.0
    for i in range(t.vertex[v, DOF] + (1 if t.vertex[v, KIND] == 2 else 0)):
        t.value[x + i] = t.estimate[x + i]
