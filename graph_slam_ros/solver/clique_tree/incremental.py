"""One update of the clique tree: from changes of the graph to the steps of the vertices that they move."""

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.clique_tree.indices import in_order, joined, lengthened
from graph_slam_ros.solver.clique_tree.numeric import accept_steps, clear_block, eliminate
from graph_slam_ros.solver.clique_tree.ordering import ends_of, key_of, neighbourhood
from graph_slam_ros.solver.clique_tree.pointers import tree_of
from graph_slam_ros.solver.clique_tree.storage import (
    ACTIVE,
    BLOCK,
    BLOCKS_TOP,
    CHANGED,
    CLIQUE,
    CLIQUES,
    COUNT,
    DEFERRED_COUNT,
    DOF,
    FLOPS,
    FREE,
    FREE_CLIQUE,
    FREE_REGION,
    FRONT_DOF,
    FRONTS_TOP,
    FULL_DOF,
    IN_DEFERRED,
    KEY,
    KIND,
    LINK,
    LINK_EDGE,
    LINK_END,
    LINK_NEXT,
    LINKED,
    LINKS,
    LIVE,
    LIVE_MADE,
    LOCAL,
    MARK,
    MARKED,
    MEMBERS_TOP,
    NEXT,
    NOTED,
    NOTHING,
    OWNER,
    R_COUNT,
    R_DEPTH,
    R_MADE,
    REGION,
    REGIONS,
    STEP,
    TAIL_END,
    TAIL_FIRST,
    VALUE,
    WIDTH,
    ZERO,
    Tree,
)
from graph_slam_ros.solver.clique_tree.substitution import find_changed, is_large, substitute
from graph_slam_ros.solver.clique_tree.symbolic import mark
from graph_slam_ros.typing import Array, Index

MUCH = 0.2  # of the threshold above which a vertex is linearised anew: changes below are not followed for that
FEW = 64  # new vertices whose anchorage is looked for; more are said to be loose, which is then looked into


@kernel
def append_vertices(pointers: Index, first: int, offset: Index, initial: Array, shapes: Index) -> None:
    """Append the records of new vertices with their initial values. They are not unknowns yet."""
    t = tree_of(pointers)
    vertex, t_step, value, estimate = t.vertex, t.step, t.value, t.estimate
    step = 0 if first == 0 else vertex[first - 1, STEP] + vertex[first - 1, DOF]
    for k in range(len(offset)):
        v = first + k
        vertex[v, :] = NOTHING
        vertex[v, FREE] = vertex[v, CHANGED] = vertex[v, NOTED] = 0
        dof, size, kind = shapes[k]
        vertex[v, DOF], vertex[v, KIND] = dof, kind
        vertex[v, STEP], vertex[v, VALUE] = step, offset[k]
        for i in range(dof):
            t_step[step + i] = 0.0
        for i in range(size):
            x = initial[offset[k] + i]
            value[offset[k] + i] = x
            estimate[offset[k] + i] = x
        step += dof


@kernel
def unfit(
    pointers: Index,
    new: Index,
    inside: NDArray[np.bool_],
    count: int,
    edges: Index,
    edge_inside: NDArray[np.bool_],
    edge_count: int,
) -> tuple[int, int, bool]:
    """Return the indices of a new vertex and of an edge that cannot be added, or NOTHING (``_unfit``).

    Then, where both are NOTHING, whether one of the vertices is in the order of the tree still.
    """
    bad, bad_edge, there = _unfit(new, inside, count), _unfit(edges, edge_inside, edge_count), False
    if bad == NOTHING and bad_edge == NOTHING:
        vertex = tree_of(pointers).vertex
        for v in new:
            there = there or vertex[v, KEY] != NOTHING
    return bad, bad_edge, there


@kernel
def _unfit(ids: Index, inside: NDArray[np.bool_], count: int) -> int:
    """Return the index in ``ids`` of an id that is too large, already in the problem or repeated; or NOTHING."""
    found, marked = NOTHING, 0
    for k in range(len(ids)):
        if ids[k] < 0 or ids[k] >= count or inside[ids[k]]:
            found = k
            break
        inside[ids[k]] = True
        marked += 1
    for k in range(marked):
        inside[ids[k]] = False
    return found


@kernel
def outside(rows: Index, ends: Index, weight: Array, inside: NDArray[np.bool_], new: Index) -> int:
    """Return a vertex that weighted edges need and that is neither in the problem nor new; or NOTHING."""
    found = NOTHING
    for v in new:
        inside[v] = True
    for row in rows:
        for s in range(ends.shape[1]):
            if found == NOTHING and weight[row] != 0.0 and not inside[ends[row, s]]:
                found = ends[row, s]
    for v in new:
        inside[v] = False
    return found


@kernel
def append_edges(pointers: Index, rows: Index, all_ids: Index, all_ends: Index) -> None:
    """Append the records of edges, and link them to their vertices. They are not in the structure yet."""
    t = tree_of(pointers)
    vertex, edge, t_link, state, blocks = t.vertex, t.edge, t.link, t.state, t.blocks
    for row in rows:
        e = all_ids[row]
        if edge[e, COUNT] > 0:  # by a call that was interrupted
            continue
        width = 0
        edge[e, COUNT], edge[e, LINKED] = all_ends.shape[1], state[LINKS]
        for s in range(all_ends.shape[1]):
            v = all_ends[row, s]
            width += vertex[v, DOF]
            link = state[LINKS]
            state[LINKS] += 1
            t_link[link, LINK_EDGE], t_link[link, LINK_END], t_link[link, LINK_NEXT] = e, v, vertex[v, LINK]
            vertex[v, LINK] = link
        edge[e, BLOCK] = state[BLOCKS_TOP]
        state[BLOCKS_TOP] += width * (width + 1)
        edge[e, WIDTH], edge[e, ACTIVE], edge[e, OWNER], edge[e, MARKED] = width, 0, NOTHING, 0
        blocks[edge[e, BLOCK] : state[BLOCKS_TOP]] = 0.0


@kernel
def enter(t: Tree, vertices: Index, edges: Index) -> None:
    """Make vertices the newest unknowns, and put edges into the structure; their blocks are not computed yet."""
    vertex, tail, state = t.vertex, t.tail, t.state
    for v in vertices:
        vertex[v, FREE] = 1
        vertex[v, REGION] = vertex[v, NEXT] = vertex[v, CLIQUE] = NOTHING
        vertex[v, KEY] = key_of(-1, 0, v)
        if state[TAIL_END] == len(tail):  # what is before the first is not needed any more
            first, kept = state[TAIL_FIRST], state[TAIL_END] - state[TAIL_FIRST]
            for k in range(kept):
                tail[k] = tail[first + k]
            state[TAIL_FIRST], state[TAIL_END] = 0, kept
        tail[state[TAIL_END]] = v
        state[TAIL_END] += 1
    for e in edges:
        t.edge[e, ACTIVE] = 1


@kernel
def enter_newest(pointers: Index, vertices: Index, edges: Index) -> None:
    """Call ``enter`` for the tree of some pointers."""
    enter(tree_of(pointers), vertices, edges)


@kernel
def leave(t: Tree, vertices: Index, edges: Index) -> Index:
    """Remove vertices and edges again; return the vertices whose cliques must be rebuilt."""
    deactivate(t, edges)
    touched = neighbourhood(t, vertices)
    for v in vertices:
        t.vertex[v, FREE] = 0
    return touched


@kernel
def deactivate(t: Tree, edges: Index) -> None:
    """Remove edges from the structure and from the diagonal of H."""
    vertex, edge, link, blocks, diagonal = t.vertex, t.edge, t.link, t.blocks, t.diagonal
    for e in edges:
        edge[e, ACTIVE], edge[e, OWNER] = 0, NOTHING
        clear_block(vertex, edge, link, e, blocks, diagonal)


@kernel
def reset(t: Tree, unknowns: Index) -> None:
    """Forget order and cliques, and the scratch of a failed call: all unknowns are new."""
    vertex, region, state = t.vertex, t.region, t.state
    vertex[:, LOCAL] = NOTHING
    t.edge[:, MARKED] = 0
    state[CLIQUES] = state[MEMBERS_TOP] = state[FRONTS_TOP] = state[LIVE] = state[LIVE_MADE] = 0
    state[FREE_CLIQUE] = NOTHING
    state[REGIONS], state[FREE_REGION] = 1, NOTHING
    region[0, :] = NOTHING
    region[0, R_DEPTH] = region[0, R_COUNT] = region[0, R_MADE] = 0
    t.vacant[:] = NOTHING
    t.clique[:, IN_DEFERRED] = state[DEFERRED_COUNT] = 0
    state[TAIL_FIRST] = state[TAIL_END] = 0
    vertex[:, CLIQUE] = NOTHING
    vertex[:, REGION] = NOTHING
    enter(t, unknowns, unknowns[:0])


@kernel
def anchored(vertex: Index, edge: Index, link: Index, new: Index, edges: Index) -> bool:
    """Return whether edges join each new vertex, by a chain, to an older one or to an edge on one vertex alone."""
    for v in new:
        vertex[v, LOCAL] = 0
    for e in edges:
        edge[e, MARKED] = 1
    count, gained = 0, len(new) <= FEW
    while gained and count < len(new):
        gained = False
        for v in new:
            a = vertex[v, LINK]
            while a != NOTHING and vertex[v, LOCAL] == 0:
                e = link[a, LINK_EDGE]
                a = link[a, LINK_NEXT]
                if edge[e, MARKED] == 0:
                    continue
                fixed = edge[e, COUNT] == 1
                for s in range(edge[e, COUNT]):
                    fixed = fixed or vertex[link[edge[e, LINKED] + s, LINK_END], LOCAL] != 0
                if fixed:
                    vertex[v, LOCAL] = 1
                    count += 1
                    gained = True
    for v in new:
        vertex[v, LOCAL] = NOTHING
    for e in edges:
        edge[e, MARKED] = 0
    return count == len(new)


@kernel
def edges_of(vertex: Index, link: Index, v: int) -> Index:
    """All edges on a vertex, also those that are not in the structure, in order."""
    out, count = np.empty(16, np.int64), ZERO
    a = vertex[v, LINK]
    while a != NOTHING:
        if count == len(out):
            out = lengthened(out, count)
        out[count] = link[a, LINK_EDGE]
        count += 1
        a = link[a, LINK_NEXT]
    return in_order(out[:count])


@kernel
def solve(t: Tree, cliques: Index, tolerance: float, sigmas: float, far: float, error: float) -> tuple[int, Index]:
    """Compute the numbers of cliques, children before parents, and the steps that matter (``substitute``).

    Returns a vertex that has no pivot, or NOTHING, and the vertices that were solved.
    """
    clique, state = t.clique, t.state
    for c in cliques:
        state[FLOPS] += clique[c, FULL_DOF] ** 2 * clique[c, FRONT_DOF]
    failed = eliminate(t, cliques, 0.0)
    if failed != NOTHING:
        return failed, cliques[:0].copy()
    return failed, substitute(t, cliques, tolerance, sigmas, far, error)


@kernel
def with_those_of(t: Tree, cliques: Index, edges: Index) -> Index:
    """Return new cliques, and before them those whose numbers depend on edges, children before parents."""
    clique = t.clique
    for c in cliques:
        clique[c, MARK] = 1
    more = mark(t, ends_of(t, edges))
    for c in cliques:
        clique[c, MARK] = 0
    return joined(more, cliques)


@kernel
def renumber(t: Tree, edges: Index, tolerance: float, sigmas: float, far: float, error: float) -> tuple[int, Index]:
    """Solve after a change of the edges' numbers alone."""
    return solve(t, mark(t, ends_of(t, edges)), tolerance, sigmas, far, error)


@kernel
def relinearize(t: Tree, searched: Index, threshold: float, error: float) -> Index:
    """Move the linearisation points of those vertices whose step is too large; return all edges on them.

    A step is too large above the threshold, or where the neglected term of the linearisation is (``is_large``).
    """
    vertex, edge, link, step, diagonal = t.vertex, t.edge, t.link, t.step, t.diagonal
    edges, moving = np.empty(64, np.int64), np.empty(len(searched), np.int64)
    count, many = ZERO, 0
    for v in searched:
        if not is_large(step, diagonal, vertex[v, STEP], vertex[v, DOF], threshold, error):
            continue
        moving[many] = v
        many += 1
        a = vertex[v, LINK]
        while a != NOTHING:
            e = link[a, LINK_EDGE]
            a = link[a, LINK_NEXT]
            if edge[e, ACTIVE] == 1 and edge[e, MARKED] == 0:
                edge[e, MARKED] = 1
                if count == len(edges):
                    edges = lengthened(edges, count)
                edges[count] = e
                count += 1
    for e in edges[:count]:
        edge[e, MARKED] = 0
    accept_steps(t, moving[:many])
    return in_order(edges[:count])


@kernel
def relinearize_changed(t: Tree, tolerance: float, sigmas: float, threshold: float, error: float) -> Index:
    """Search all vertices that have moved much since the last time, and relinearise: return the edges."""
    much = find_changed(t, tolerance, sigmas, MUCH * threshold, MUCH * MUCH * error)
    return relinearize(t, much, threshold, error)


@kernel
def reach_back(t: Tree, edges: Index) -> bool:
    """Return whether one of the edges reaches a vertex that has left the tail: it closes a loop."""
    back = False
    for v in ends_of(t, edges):
        back = back or t.vertex[v, REGION] != NOTHING
    return back
