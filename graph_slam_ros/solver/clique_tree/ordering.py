"""The order of elimination: a nested dissection that follows the graph's growth.

Regions form a binary tree. The vertices of an inner region separate those of its two subtrees, so they are eliminated
after both: a path from any vertex to the root is short, and an update touches little. The newest vertices, the
*tail*, come last of all in order of time, so that the next odometry edge meets the root. When the tail is long its
older part moves down, each vertex into the deepest region that keeps the separation true. A region whose subtree has
grown too much is dissected anew; that is paid for by what was added to it. So is all of it when the numbers of its
fronts have grown as much: by lap after lap along the same places they grow faster than the vertices.
"""

from typing import Any

import numpy as np

from graph_slam_ros.lie.jit import inner, kernel
from graph_slam_ros.solver.clique_tree.indices import in_order, joined
from graph_slam_ros.solver.clique_tree.pools import GROWTH, has_outgrown
from graph_slam_ros.solver.clique_tree.separator import separate
from graph_slam_ros.solver.clique_tree.storage import (
    ACTIVE,
    COUNT,
    DOF,
    FLOPS,
    FLOPS_SEEN,
    FLOPS_USUAL,
    FREE,
    FREE_REGION,
    KEY,
    LINK,
    LINK_EDGE,
    LINK_END,
    LINK_NEXT,
    LINKED,
    LIVE_MADE,
    LOCAL,
    NEXT,
    NOTHING,
    R_COUNT,
    R_DEPTH,
    R_FIRST,
    R_LEFT,
    R_MADE,
    R_PARENT,
    R_RIGHT,
    RECENT,
    REGION,
    REGIONS,
    RESTRUCTURED,
    RESTRUCTURED_SEEN,
    TAIL_END,
    TAIL_FIRST,
    TAIL_KEPT,
    TAIL_LEAST,
    ZERO,
    Tree,
)
from graph_slam_ros.typing import Index

LEAF = 6  # vertices a region need not be dissected for
FEWEST = 64  # vertices by which a subtree must have grown as well: to dissect a small one costs more than it is worth
DEEPEST = 200
ROOT: Any = np.int64(0)  # region; not a literal, for which kernels would be compiled once more
TAIL_MOST = 128  # vertices that are kept in the tail at most
SLACK = 8  # vertices beyond these that move down in one go, when a closure comes
SLACK_WITHOUT = 56  # as long as none comes
INSIDE = 0.9  # share of the recent closures that a longer tail must hold


@inner
def key_of(depth: int, region: int, vertex: int) -> int:
    """Return the sorting key: deeper regions are eliminated first, then the older vertex; the tail (depth -1) last."""
    return ((DEEPEST - depth) << 54) | (region << 31) | vertex


@kernel
def move_tail(t: Tree, edges: Index, touched: Index) -> tuple[Index, int]:
    """Move the older vertices of a long tail down.

    This happens at a change that goes further back, or when the tail is very long: what odometry alone adds is cheap.

    Returns
    -------
    The touched vertices, those of the edges and all others that this touches; and the region that is to be dissected
    anew, or NOTHING.
    """
    vertex, region, tail, state = t.vertex, t.region, t.tail, t.state
    first, end = state[TAIL_FIRST], state[TAIL_END]
    touched = joined(ends_of(t, edges), touched)
    state[RESTRUCTURED] += 1
    if first == end:
        return touched, NOTHING
    back, beyond = ZERO, False
    for v in touched:
        back = max(back, tail[end - 1] - v)
        beyond = beyond or vertex[v, REGION] != NOTHING
    if back > TAIL_LEAST:
        _decide_length(t, back)
    keep = state[TAIL_KEPT]
    beyond = beyond or (keep > TAIL_LEAST and back > TAIL_LEAST)
    if end - first <= keep + (SLACK if beyond else SLACK_WITHOUT):
        return touched, NOTHING
    last = end - keep
    moving = tail[first:last]
    state[TAIL_FIRST] = last
    if last - first > max(region[0, R_COUNT], 4 * TAIL_LEAST):  # as many as there are: all in one go
        for v in moving:
            if vertex[v, FREE] == 1:
                _enter(t, v, ROOT)
        return touched, ROOT
    overgrown = NOTHING
    for v in moving:
        if vertex[v, FREE] == 0:
            continue
        _enter(t, v, _deepest_place(t, v))
        r = vertex[v, REGION]
        while r != NOTHING:
            if region[r, R_COUNT] > GROWTH * region[r, R_MADE] + FEWEST and (
                overgrown == NOTHING or region[r, R_DEPTH] < region[overgrown, R_DEPTH]
            ):
                overgrown = r
            r = region[r, R_PARENT]
    if has_outgrown(t):
        overgrown = ROOT
    return joined(touched, neighbourhood(t, moving)), overgrown


@inner
def _decide_length(t: Tree, back: int) -> None:
    """Decide how many vertices the tail keeps after a closure that reaches further back.

    The tail is in the root. A closure within it touches nothing else, but every update pays for its size. So it is
    longer than a few vertices only if most recent closures reach no further, and if a root of that size costs less than
    updates cost while the graph was small. That is so where a robot sweeps row beside row.
    """
    state, reach = t.state, t.reach
    for k in range(len(reach) - 1):
        reach[k] = reach[k + 1]
    reach[-1] = back
    updates = state[RESTRUCTURED] - state[RESTRUCTURED_SEEN]
    spent = (state[FLOPS] - state[FLOPS_SEEN]) // updates
    state[RESTRUCTURED_SEEN], state[FLOPS_SEEN] = state[RESTRUCTURED], state[FLOPS]
    if state[TAIL_KEPT] == TAIL_LEAST:
        state[FLOPS_USUAL] += (spent - state[FLOPS_USUAL]) // RECENT
    enough = in_order(reach)[int(INSIDE * RECENT)] + 1
    state[TAIL_KEPT] = TAIL_LEAST
    if enough <= TAIL_MOST:
        size = (enough + SLACK) * t.vertex[t.tail[state[TAIL_END] - 1], DOF]
        if 2 * size**3 <= state[FLOPS_USUAL]:
            state[TAIL_KEPT] = enough


@kernel
def ends_of(t: Tree, edges: Index) -> Index:
    """Return the vertices of edges; some occur more than once."""
    edge, link = t.edge, t.link
    count = 0
    for e in edges:
        count += edge[e, COUNT]
    out = np.empty(count, np.int64)
    count = 0
    for e in edges:
        for s in range(edge[e, COUNT]):
            out[count] = link[edge[e, LINKED] + s, LINK_END]
            count += 1
    return out


@inner
def neighbourhood(t: Tree, vertices: Index) -> Index:
    """Return the vertices and their neighbours; some occur more than once."""
    vertex, edge, link = t.vertex, t.edge, t.link
    count = 0
    for v in vertices:
        count += 1
        a = vertex[v, LINK]
        while a != NOTHING:
            count += edge[link[a, LINK_EDGE], COUNT]
            a = link[a, LINK_NEXT]
    out = np.empty(count, np.int64)
    count = 0
    for v in vertices:
        out[count] = v
        count += 1
        a = vertex[v, LINK]
        while a != NOTHING:
            e = link[a, LINK_EDGE]
            for s in range(edge[e, COUNT]):
                out[count] = link[edge[e, LINKED] + s, LINK_END]
                count += 1
            a = link[a, LINK_NEXT]
    return out


@inner
def _enter(t: Tree, v: int, region: int) -> None:
    """Put a vertex into a region."""
    vertex, t_region = t.vertex, t.region
    vertex[v, REGION] = region
    vertex[v, KEY] = key_of(t_region[region, R_DEPTH], region, v)
    vertex[v, NEXT] = t_region[region, R_FIRST]
    t_region[region, R_FIRST] = v
    while region != NOTHING:
        t_region[region, R_COUNT] += 1
        region = t_region[region, R_PARENT]


@inner
def _deepest_place(t: Tree, v: int) -> int:
    """Return the deepest region that is on one path to the root with the region of each neighbour of v."""
    vertex, region = t.vertex, t.region
    deepest = NOTHING
    around = neighbourhood(t, np.full(1, v, np.int64))
    for u in around:
        r = vertex[u, REGION]
        if r != NOTHING and (deepest == NOTHING or region[r, R_DEPTH] > region[deepest, R_DEPTH]):
            deepest = r
    place = max(deepest, 0)
    apart = False
    for u in around:
        r = vertex[u, REGION]
        if r == NOTHING:
            continue
        a = deepest
        while region[a, R_DEPTH] > region[r, R_DEPTH]:
            a = region[a, R_PARENT]
        if a != r:
            apart = True
            while a != r:
                a, r = region[a, R_PARENT], region[r, R_PARENT]
            if region[a, R_DEPTH] < region[place, R_DEPTH]:
                place = a
    while not apart and region[place, R_LEFT] != NOTHING:  # beyond a separator: begin in the emptier part
        left, right = region[place, R_LEFT], region[place, R_RIGHT]
        place = left if region[left, R_COUNT] <= region[right, R_COUNT] else right
    return place


@inner
def _new_region(t: Tree, parent: int) -> int:
    region, state = t.region, t.state
    r = state[FREE_REGION]
    if r != NOTHING:
        state[FREE_REGION] = region[r, R_PARENT]
    else:
        r = state[REGIONS]
        state[REGIONS] += 1
    region[r, R_PARENT] = parent
    region[r, R_DEPTH] = region[parent, R_DEPTH] + 1
    region[r, R_LEFT] = region[r, R_RIGHT] = region[r, R_FIRST] = NOTHING
    region[r, R_COUNT] = 0
    return r


@kernel
def _clear(t: Tree, region: int) -> Index:
    """Remove all vertices from a subtree of regions, and its inner regions; return the vertices by id."""
    vertex, t_region, state = t.vertex, t.region, t.state
    out = np.empty(t_region[region, R_COUNT], np.int64)
    count = 0
    stack, top = np.empty(DEEPEST + 2, np.int64), 1
    stack[0] = region
    while top:
        top -= 1
        r = stack[top]
        v = t_region[r, R_FIRST]
        while v != NOTHING:
            if vertex[v, FREE] == 1:
                out[count] = v
                count += 1
            v = vertex[v, NEXT]
        if t_region[r, R_LEFT] != NOTHING:
            stack[top], stack[top + 1] = t_region[r, R_LEFT], t_region[r, R_RIGHT]
            top += 2
        if r != region:
            t_region[r, R_PARENT] = state[FREE_REGION]
            state[FREE_REGION] = r
    t_region[region, R_FIRST] = t_region[region, R_LEFT] = t_region[region, R_RIGHT] = NOTHING
    gone = t_region[region, R_COUNT]
    r = region
    while r != NOTHING:
        t_region[r, R_COUNT] -= gone
        r = t_region[r, R_PARENT]
    return in_order(out[:count])


@kernel
def dissect(t: Tree, region: int) -> Index:
    """Dissect a subtree again, by its vertices and the edges among them; return the vertices."""
    t_region = t.region
    vertices = _clear(t, region)
    if region == ROOT:
        t.state[LIVE_MADE] = 0  # known as soon as there are cliques again
    start, neighbour, strength, weight = _graph_of(t, vertices)
    n = len(vertices)
    part = np.arange(n)
    place = np.full(n, NOTHING, np.int64)
    stack, top = np.empty((DEEPEST + 2, 3), np.int64), 1
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, n, region
    while top:
        top -= 1
        low, high, r = stack[top, 0], stack[top, 1], stack[top, 2]
        mine, side = part[low:high].copy(), np.full(high - low, 2, np.int64)
        if high - low > LEAF and t_region[r, R_DEPTH] < DEEPEST - 1:
            begin, joins, strong, heavy = _induced(mine, start, neighbour, strength, weight, place)
            side = separate(begin, joins, strong, heavy)
        middle, end = _parted(mine, side, part, low)
        whole = middle == low or end == middle  # it does not fall into two parts
        if not whole:
            left, right = _new_region(t, r), _new_region(t, r)
            t_region[r, R_LEFT], t_region[r, R_RIGHT] = left, right
            stack[top, 0], stack[top, 1], stack[top, 2] = low, middle, left
            stack[top + 1, 0], stack[top + 1, 1], stack[top + 1, 2] = middle, end, right
            top += 2
        for k in range(len(mine)):
            if whole or side[k] == 2:
                _enter(t, vertices[mine[k]], r)
        t_region[r, R_MADE] = high - low
    return vertices


@kernel
def _parted(mine: Index, side: Index, part: Index, low: int) -> tuple[int, int]:
    """Write the vertices of side 0 into ``part`` from ``low`` on, then those of side 1; return where each ends."""
    at = low
    for k in range(len(mine)):
        if side[k] == 0:
            part[at] = mine[k]
            at += 1
    middle = at
    for k in range(len(mine)):
        if side[k] == 1:
            part[at] = mine[k]
            at += 1
    return middle, at


@inner
def _graph_of(t: Tree, vertices: Index) -> tuple[Index, Index, Index, Index]:
    """Return the graph of the active edges among some vertices, numbered in their order (see ``separator``)."""
    vertex, edge, link = t.vertex, t.edge, t.link
    n = len(vertices)
    most = 0
    weight = np.empty(n, np.int64)
    for k in range(n):
        vertex[vertices[k], LOCAL] = k
        weight[k] = vertex[vertices[k], DOF]
        a = vertex[vertices[k], LINK]
        while a != NOTHING:
            most += edge[link[a, LINK_EDGE], COUNT] - 1
            a = link[a, LINK_NEXT]
    start, neighbour, strength = np.zeros(n + 1, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    place = np.full(n, NOTHING, np.int64)
    top = 0
    for k in range(n):
        start[k] = top
        a = vertex[vertices[k], LINK]
        while a != NOTHING:
            e = link[a, LINK_EDGE]
            a = link[a, LINK_NEXT]
            for s in range(edge[e, COUNT] if edge[e, ACTIVE] else 0):
                u = vertex[link[edge[e, LINKED] + s, LINK_END], LOCAL]
                if u in (NOTHING, k):
                    continue
                if place[u] < start[k]:
                    place[u] = top
                    neighbour[top], strength[top] = u, 0
                    top += 1
                strength[place[u]] += 1
    start[n] = top
    for v in vertices:
        vertex[v, LOCAL] = NOTHING
    return start, neighbour[:top], strength[:top], weight


@inner
def _induced(
    part: Index, start: Index, neighbour: Index, strength: Index, weight: Index, place: Index
) -> tuple[Index, Index, Index, Index]:
    """Return the graph of a part of its vertices; ``place`` is scratch, NOTHING everywhere before and after."""
    n = len(part)
    most = 0
    for k in range(n):
        place[part[k]] = k
        most += start[part[k] + 1] - start[part[k]]
    begin, heavy = np.zeros(n + 1, np.int64), np.empty(n, np.int64)
    joins, strong = np.empty(most, np.int64), np.empty(most, np.int64)
    top = 0
    for k in range(n):
        for a in range(start[part[k]], start[part[k] + 1]):
            if place[neighbour[a]] != NOTHING:
                joins[top], strong[top] = place[neighbour[a]], strength[a]
                top += 1
        begin[k + 1] = top
        heavy[k] = weight[part[k]]
    for u in part:
        place[u] = NOTHING
    return begin, joins[:top], strong[:top], heavy
