"""One update of the clique tree: from changes of the graph to the steps of the vertices that they move."""

import numpy as np

from graph_slam_ros.lie.jit import inner, kernel
from graph_slam_ros.solver.clique_tree.indices import in_order, joined, lengthened
from graph_slam_ros.solver.clique_tree.numeric import accept_steps, clear_block, eliminate
from graph_slam_ros.solver.clique_tree.ordering import ends_of, key_of, neighbourhood
from graph_slam_ros.solver.clique_tree.pointers import tree_of
from graph_slam_ros.solver.clique_tree.storage import (
    ACTIVE,
    CLIQUE,
    CLIQUES,
    DEFERRED_COUNT,
    ENTERED,
    FLOPS,
    FREE,
    FREE_CLIQUE,
    FREE_REGION,
    FRONT_DOF,
    FRONTS_TOP,
    FULL_DOF,
    IN_DEFERRED,
    KEY,
    LINK,
    LINK_EDGE,
    LINK_NEXT,
    LIVE,
    LIVE_MADE,
    LOCAL,
    MARK,
    MARKED,
    MEMBERS_TOP,
    NEXT,
    NOTHING,
    OWNER,
    R_COUNT,
    R_DEPTH,
    R_MADE,
    REGION,
    REGIONS,
    TAIL_END,
    TAIL_FIRST,
    ZERO,
    Limits,
    Tree,
)
from graph_slam_ros.solver.clique_tree.substitution import find_changed, is_large_step, substitute
from graph_slam_ros.solver.clique_tree.symbolic import mark
from graph_slam_ros.typing import Index

MUCH = 0.2  # of the threshold above which a vertex is linearised anew: changes below are not followed for that


@kernel
def enter(t: Tree, vertices: Index, edges: Index) -> None:
    """Make vertices the newest unknowns, and put edges into the structure; their blocks are not computed yet."""
    vertex, tail, state = t.vertex, t.tail, t.state
    state[ENTERED] += 1
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
def solve(t: Tree, cliques: Index, tolerance: float, sigmas: float, far: Limits) -> tuple[int, Index]:
    """Compute the numbers of cliques, children before parents, and the steps that matter (``substitute``).

    Returns a vertex that has no pivot, or NOTHING, and the vertices that were solved.
    """
    clique, state = t.clique, t.state
    for c in cliques:
        state[FLOPS] += clique[c, FULL_DOF] ** 2 * clique[c, FRONT_DOF]
    failed = eliminate(t, cliques, 0.0)
    if failed != NOTHING:
        return failed, cliques[:0].copy()
    return failed, substitute(t, cliques, tolerance, sigmas, far)


@inner
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
def renumber(t: Tree, edges: Index, tolerance: float, sigmas: float, far: Limits) -> tuple[int, Index]:
    """Solve after a change of the edges' numbers alone."""
    return solve(t, mark(t, ends_of(t, edges)), tolerance, sigmas, far)


@kernel
def relinearize(t: Tree, searched: Index, above: Limits) -> Index:
    """Move the linearisation points of those vertices whose step is too large; return all edges on them.

    A step is too large above one of the limits (``is_large_step``).
    """
    vertex, edge, link = t.vertex, t.edge, t.link
    large = False
    for v in searched:
        large = large or is_large_step(t, v, False, above)
    if not large:  # as nearly always
        return np.empty(0, np.int64)
    edges, moving = np.empty(64, np.int64), np.empty(len(searched), np.int64)
    count, many = ZERO, 0
    for v in searched:
        if not is_large_step(t, v, False, above):
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
def relinearize_changed(pointers: Index, tolerance: float, sigmas: float, above: Limits) -> Index:
    """Search all vertices that have moved much since the last time, and relinearise: return the edges."""
    t = tree_of(pointers)
    component, turn, square = above
    much = find_changed(t, tolerance, sigmas, (MUCH * component, MUCH * turn, MUCH * MUCH * square))
    return relinearize(t, much, above)


@kernel
def reach_back(t: Tree, edges: Index) -> bool:
    """Return whether one of the edges reaches a vertex that has left the tail: it closes a loop."""
    back = False
    for v in ends_of(t, edges):
        back = back or t.vertex[v, REGION] != NOTHING
    return back
