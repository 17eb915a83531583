"""The order of elimination: a nested dissection that follows the graph's growth.

Regions form a binary tree. The vertices of an inner region separate those of its two subtrees, so they are eliminated
after both: a path from any vertex to the root is short, and an update touches little. The newest vertices, the
*tail*, come last of all in order of time, so that the next odometry edge meets the root. When the tail is long its
older part moves down, each vertex into the deepest region that keeps the separation true. A region whose subtree has
grown too much is dissected anew; that is paid for by what was added to it. So is all of it when the numbers of its
fronts have grown as much: by lap after lap along the same places they grow faster than the vertices.

The separators are light sets of vertices without which a graph falls into two parts of about equal weight. They are
found on several levels, as METIS does it (Karypis and Kumar, "A fast and high quality multilevel scheme for
partitioning irregular graphs", SIAM J. Sci. Comput. 1998): contract pairs of neighbours until the graph is small,
separate that in two ways, and carry the lighter separator back level after level, refining it on each (Fiduccia and
Mattheyses 1982). A graph is (start, neighbour, strength, weight): the neighbours of u are
neighbour[start[u]:start[u + 1]], each once, joined by so many edges of the original graph; weight is a vertex's degrees
of freedom.
"""

from typing import Any

import numpy as np

from graph_slam_ros.lie.jit import inlined, inner, kernel
from graph_slam_ros.solver.clique_tree import storage as its
from graph_slam_ros.solver.clique_tree.storage import (
    NOTHING,
    ZERO,
    Tree,
    ascending,
    chosen,
    has_outgrown,
    in_order,
    joined,
)
from graph_slam_ros.typing import Array, Index

COARSE = 40  # vertices of the graph that is separated first
PASSES = 6  # of refinement on each level, at most
PATIENCE = 40  # moves without gain before a pass ends
HEAVIEST = 0.62  # share of one side
SEPARATOR: Any = np.int64(2)  # side; not a literal, for which kernels would be compiled once more


@kernel
def separate(start: Index, neighbour: Index, strength: Index, weight: Index) -> Index:
    """The side of each vertex, 0 or 1, or 2 where it separates them."""
    if len(weight) <= COARSE:
        return _first(start, neighbour, weight)
    starts, neighbours, strengths, weights = [start], [neighbour], [strength], [weight]
    coarser = [start[:0]]
    while len(weights[-1]) > COARSE:
        pair, count = _match(starts[-1], neighbours[-1], strengths[-1], weights[-1])
        if 10 * count > 9 * len(pair):
            break
        a, b, c, d = _contract(starts[-1], neighbours[-1], strengths[-1], weights[-1], pair, count)
        starts.append(a)
        neighbours.append(b)
        strengths.append(c)
        weights.append(d)
        coarser.append(pair)
    side = _first(starts[-1], neighbours[-1], weights[-1])
    for level in range(len(weights) - 2, -1, -1):
        side = chosen(side, coarser[level + 1])
        _refine(side, starts[level], neighbours[level], weights[level])
    return side


@inner
def _match(start: Index, neighbour: Index, strength: Index, weight: Index) -> tuple[Index, int]:
    """Pair each vertex with the neighbour that most edges join it to; return each vertex's pair, and their count."""
    n = len(weight)
    pair = np.full(n, NOTHING, np.int64)
    neighbours, whole = np.empty(n, np.int64), 0
    for u in range(n):
        neighbours[u] = start[u + 1] - start[u]
        whole += weight[u]
    limit = 3 * whole // COARSE
    count = 0
    # those with few neighbours choose first: they have the least choice
    for u in ascending(neighbours):
        if pair[u] != NOTHING:
            continue
        best, mate = 0.0, u
        for a in range(start[u], start[u + 1]):
            w = neighbour[a]
            if pair[w] == NOTHING and weight[u] + weight[w] <= limit and strength[a] / weight[w] > best:
                best, mate = strength[a] / weight[w], w
        pair[u] = pair[mate] = count
        count += 1
    return pair, count


@inner
def _contract(
    start: Index, neighbour: Index, strength: Index, weight: Index, pair: Index, count: int
) -> tuple[Index, Index, Index, Index]:
    """The graph of the pairs."""
    n = len(weight)
    first, second = np.full(count, NOTHING, np.int64), np.full(count, NOTHING, np.int64)
    heavier = np.zeros(count, np.int64)
    for u in range(n):
        heavier[pair[u]] += weight[u]
        if first[pair[u]] == NOTHING:
            first[pair[u]] = u
        else:
            second[pair[u]] = u
    begin = np.zeros(count + 1, np.int64)
    joined, stronger = np.empty(len(neighbour), np.int64), np.empty(len(neighbour), np.int64)
    place = np.full(count, NOTHING, np.int64)
    top = 0
    for p in range(count):
        begin[p] = top
        for u in (first[p], second[p]):
            if u == NOTHING:
                continue
            for a in range(start[u], start[u + 1]):
                q = pair[neighbour[a]]
                if q == p:
                    continue
                if place[q] < begin[p]:
                    place[q] = top
                    joined[top], stronger[top] = q, 0
                    top += 1
                stronger[place[q]] += strength[a]
    begin[count] = top
    return begin, joined[:top].copy(), stronger[:top].copy(), heavier


@kernel
def _first(start: Index, neighbour: Index, weight: Index) -> Index:
    """Return the lighter of two separators: by the given order, and by the distance from its last vertex."""
    order = np.arange(len(weight))
    side = _sweep(order, start, neighbour, weight)
    score = _refine(side, start, neighbour, weight)
    other = _sweep(_by_distance(order[-1], start, neighbour), start, neighbour, weight)
    return other if _refine(other, start, neighbour, weight) < score else side


@inner
def _by_distance(first: int, start: Index, neighbour: Index) -> Index:
    """Return a breadth-first order from a vertex; parts that it does not reach follow, one by one."""
    n = len(start) - 1
    order = np.empty(n, np.int64)
    seen = np.zeros(n, np.uint8)
    order[0], seen[first] = first, 1
    done, count, rest = 0, 1, 0
    while done < n:
        if done == count:
            while seen[rest]:
                rest += 1
            order[count], seen[rest] = rest, 1
            count += 1
        u = order[done]
        done += 1
        for a in range(start[u], start[u + 1]):
            w = neighbour[a]
            if seen[w] == 0:
                order[count], seen[w] = w, 1
                count += 1
    return order


@inner
def _sweep(order: Index, start: Index, neighbour: Index, weight: Index) -> Index:
    """Cut an order in two; vertices of one part with a neighbour in the other separate. The lightest such cut."""
    n = len(order)
    position = np.empty(n, np.int64)
    for k in range(n):
        position[order[k]] = k
    before, after = np.zeros(n + 2), np.zeros(n + 2)  # weight that begins or ends to separate at each cut
    low, high = position.copy(), position.copy()
    whole = 0
    for u in range(n):
        whole += weight[u]
        for a in range(start[u], start[u + 1]):
            q = position[neighbour[a]]
            low[u], high[u] = min(low[u], q), max(high[u], q)
        before[position[u] + 1] += weight[u]
        before[high[u] + 1] -= weight[u]
        after[low[u] + 1] += weight[u]
        after[position[u] + 1] -= weight[u]
    best, cut, of_before = np.inf, n // 2, True
    x = y = 0.0
    passed, half = 0.0, 0.5 * whole
    for c in range(n):
        x += before[c]
        y += after[c]
        if c > 0:
            passed += weight[order[c - 1]]
        score = min(x, y) * (1.0 + abs(passed - half) / half)
        if abs(passed - half) <= 0.3 * half and score < best:
            best, cut, of_before = score, c, x <= y
    side = np.empty(n, np.int64)
    for u in range(n):
        if position[u] < cut:
            side[u] = 2 if of_before and high[u] >= cut else 0
        else:
            side[u] = 2 if not of_before and low[u] < cut else 1
    return side


@inner
def _refine(side: Index, start: Index, neighbour: Index, weight: Index) -> float:
    """Lighten a separator by moving its vertices to a side, best first, even where it gets heavier for a while.

    A vertex that moves to one side draws its neighbours on the other side into the separator. A pass ends without gain
    for some moves and goes back to its best state. Returns the separator's weight, enlarged for unequal sides.
    """
    n = len(side)
    total = np.zeros(3)
    for u in range(n):
        total[side[u]] += weight[u]
    most = HEAVIEST * (total[0] + total[1] + total[2])
    moved, was = np.empty(4 * n + 8, np.int64), np.empty(4 * n + 8, np.int64)
    members, locked = np.empty(n, np.int64), np.empty(n, np.uint8)
    score = _score(total)
    for _ in range(PASSES):
        count = ZERO
        for u in range(n):
            locked[u] = 0
            if side[u] == 2:
                members[count] = u
                count += 1
        begun = score
        logged = kept = idle = 0
        while idle < PATIENCE:
            pick, to, count = _best_move(members, count, locked, total, most, side, start, neighbour, weight)
            if pick == NOTHING or logged + 1 + start[pick + 1] - start[pick] > len(moved):
                break
            locked[pick] = 1
            moved[logged], was[logged] = pick, 2
            logged += 1
            _shift(pick, to, side, total, weight)
            for a in range(start[pick], start[pick + 1]):
                w = neighbour[a]
                if side[w] == 1 - to:
                    moved[logged], was[logged] = w, 1 - to
                    logged += 1
                    _shift(w, SEPARATOR, side, total, weight)
                    members[count] = w
                    count += 1
            idle += 1
            if _score(total) < score:
                score, kept, idle = _score(total), logged, 0
        for m in range(logged - 1, kept - 1, -1):
            _shift(moved[m], was[m], side, total, weight)
        if score >= begun:
            break
    return score


@inlined
def _best_move(
    members: Index,
    count: int,
    locked: Index,
    total: Array,
    most: float,
    side: Index,
    start: Index,
    neighbour: Index,
    weight: Index,
) -> tuple[int, int, int]:
    """Return the vertex whose move lightens the separator most, and its side; drop those that have left it."""
    pick, to, best = NOTHING, 0, -np.inf
    live = 0
    for m in range(count):
        u = members[m]
        if side[u] != 2:
            continue
        members[live] = u
        live += 1
        if locked[u]:
            continue
        on_0 = on_1 = ZERO  # weight of its neighbours on each side
        for a in range(start[u], start[u + 1]):
            w = neighbour[a]
            if side[w] == 0:
                on_0 += weight[w]
            elif side[w] == 1:
                on_1 += weight[w]
        for s in range(2):
            gain = weight[u] - (on_1 if s == 0 else on_0)
            if total[s] + weight[u] <= most and (gain > best or (gain == best and total[s] < total[to])):
                pick, to, best = u, s, gain
    return pick, to, live


@inlined
def _shift(u: int, to: int, side: Index, total: Array, weight: Index) -> None:
    total[side[u]] -= weight[u]
    side[u] = to
    total[to] += weight[u]


@inlined
def _score(total: Array) -> float:
    return total[2] * (1.0 + abs(total[0] - total[1]) / (total[0] + total[1] + total[2])) + 1e-3 * abs(
        total[0] - total[1]
    )


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
    first, end = state[its.TAIL_FIRST], state[its.TAIL_END]
    touched = joined(ends_of(t, edges), touched)
    state[its.RESTRUCTURED] += 1
    if first == end:
        return touched, NOTHING
    back, beyond = ZERO, False
    for v in touched:
        back = max(back, tail[end - 1] - v)
        beyond = beyond or vertex[v, its.REGION] != NOTHING
    if back > its.TAIL_LEAST:
        _decide_length(t, back)
    keep = state[its.TAIL_KEPT]
    beyond = beyond or (keep > its.TAIL_LEAST and back > its.TAIL_LEAST)
    if end - first <= keep + (SLACK if beyond else SLACK_WITHOUT):
        return touched, NOTHING
    last = end - keep
    moving = tail[first:last]
    state[its.TAIL_FIRST] = last
    if last - first > max(region[0, its.R_COUNT], 4 * its.TAIL_LEAST):  # as many as there are: all in one go
        for v in moving:
            if vertex[v, its.FREE] == 1:
                _enter(t, v, ROOT)
        return touched, ROOT
    overgrown = NOTHING
    for v in moving:
        if vertex[v, its.FREE] == 0:
            continue
        _enter(t, v, _deepest_place(t, v))
        r = vertex[v, its.REGION]
        while r != NOTHING:
            if region[r, its.R_COUNT] > its.GROWTH * region[r, its.R_MADE] + FEWEST and (
                overgrown == NOTHING or region[r, its.R_DEPTH] < region[overgrown, its.R_DEPTH]
            ):
                overgrown = r
            r = region[r, its.R_PARENT]
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
    updates = state[its.RESTRUCTURED] - state[its.RESTRUCTURED_SEEN]
    spent = (state[its.FLOPS] - state[its.FLOPS_SEEN]) // updates
    state[its.RESTRUCTURED_SEEN], state[its.FLOPS_SEEN] = state[its.RESTRUCTURED], state[its.FLOPS]
    if state[its.TAIL_KEPT] == its.TAIL_LEAST:
        state[its.FLOPS_USUAL] += (spent - state[its.FLOPS_USUAL]) // its.RECENT
    enough = in_order(reach)[int(INSIDE * its.RECENT)] + 1
    state[its.TAIL_KEPT] = its.TAIL_LEAST
    if enough <= TAIL_MOST:
        size = (enough + SLACK) * t.vertex[t.tail[state[its.TAIL_END] - 1], its.DOF]
        if 2 * size**3 <= state[its.FLOPS_USUAL]:
            state[its.TAIL_KEPT] = enough


@kernel
def ends_of(t: Tree, edges: Index) -> Index:
    """Return the vertices of edges; some occur more than once."""
    edge, link = t.edge, t.link
    count = 0
    for e in edges:
        count += edge[e, its.COUNT]
    out = np.empty(count, np.int64)
    count = 0
    for e in edges:
        for s in range(edge[e, its.COUNT]):
            out[count] = link[edge[e, its.LINKED] + s, its.LINK_END]
            count += 1
    return out


@inner
def neighbourhood(t: Tree, vertices: Index) -> Index:
    """Return the vertices and their neighbours; some occur more than once."""
    vertex, edge, link = t.vertex, t.edge, t.link
    count = 0
    for v in vertices:
        count += 1
        a = vertex[v, its.LINK]
        while a != NOTHING:
            count += edge[link[a, its.LINK_EDGE], its.COUNT]
            a = link[a, its.LINK_NEXT]
    out = np.empty(count, np.int64)
    count = 0
    for v in vertices:
        out[count] = v
        count += 1
        a = vertex[v, its.LINK]
        while a != NOTHING:
            e = link[a, its.LINK_EDGE]
            for s in range(edge[e, its.COUNT]):
                out[count] = link[edge[e, its.LINKED] + s, its.LINK_END]
                count += 1
            a = link[a, its.LINK_NEXT]
    return out


@inner
def _enter(t: Tree, v: int, region: int) -> None:
    """Put a vertex into a region."""
    vertex, t_region = t.vertex, t.region
    vertex[v, its.REGION] = region
    vertex[v, its.KEY] = key_of(t_region[region, its.R_DEPTH], region, v)
    vertex[v, its.NEXT] = t_region[region, its.R_FIRST]
    t_region[region, its.R_FIRST] = v
    while region != NOTHING:
        t_region[region, its.R_COUNT] += 1
        region = t_region[region, its.R_PARENT]


@inner
def _deepest_place(t: Tree, v: int) -> int:
    """Return the deepest region that is on one path to the root with the region of each neighbour of v."""
    vertex, region = t.vertex, t.region
    deepest = NOTHING
    around = neighbourhood(t, np.full(1, v, np.int64))
    for u in around:
        r = vertex[u, its.REGION]
        if r != NOTHING and (deepest == NOTHING or region[r, its.R_DEPTH] > region[deepest, its.R_DEPTH]):
            deepest = r
    place = max(deepest, 0)
    apart = False
    for u in around:
        r = vertex[u, its.REGION]
        if r == NOTHING:
            continue
        a = deepest
        while region[a, its.R_DEPTH] > region[r, its.R_DEPTH]:
            a = region[a, its.R_PARENT]
        if a != r:
            apart = True
            while a != r:
                a, r = region[a, its.R_PARENT], region[r, its.R_PARENT]
            if region[a, its.R_DEPTH] < region[place, its.R_DEPTH]:
                place = a
    while not apart and region[place, its.R_LEFT] != NOTHING:  # beyond a separator: begin in the emptier part
        left, right = region[place, its.R_LEFT], region[place, its.R_RIGHT]
        place = left if region[left, its.R_COUNT] <= region[right, its.R_COUNT] else right
    return place


@inner
def _new_region(t: Tree, parent: int) -> int:
    region, state = t.region, t.state
    r = state[its.FREE_REGION]
    if r != NOTHING:
        state[its.FREE_REGION] = region[r, its.R_PARENT]
    else:
        r = state[its.REGIONS]
        state[its.REGIONS] += 1
    region[r, its.R_PARENT] = parent
    region[r, its.R_DEPTH] = region[parent, its.R_DEPTH] + 1
    region[r, its.R_LEFT] = region[r, its.R_RIGHT] = region[r, its.R_FIRST] = NOTHING
    region[r, its.R_COUNT] = 0
    return r


@kernel
def _clear(t: Tree, region: int) -> Index:
    """Remove all vertices from a subtree of regions, and its inner regions; return the vertices by id."""
    vertex, t_region, state = t.vertex, t.region, t.state
    out = np.empty(t_region[region, its.R_COUNT], np.int64)
    count = 0
    stack, top = np.empty(DEEPEST + 2, np.int64), 1
    stack[0] = region
    while top:
        top -= 1
        r = stack[top]
        v = t_region[r, its.R_FIRST]
        while v != NOTHING:
            if vertex[v, its.FREE] == 1:
                out[count] = v
                count += 1
            v = vertex[v, its.NEXT]
        if t_region[r, its.R_LEFT] != NOTHING:
            stack[top], stack[top + 1] = t_region[r, its.R_LEFT], t_region[r, its.R_RIGHT]
            top += 2
        if r != region:
            t_region[r, its.R_PARENT] = state[its.FREE_REGION]
            state[its.FREE_REGION] = r
    t_region[region, its.R_FIRST] = t_region[region, its.R_LEFT] = t_region[region, its.R_RIGHT] = NOTHING
    gone = t_region[region, its.R_COUNT]
    r = region
    while r != NOTHING:
        t_region[r, its.R_COUNT] -= gone
        r = t_region[r, its.R_PARENT]
    return in_order(out[:count])


@kernel
def dissect(t: Tree, region: int) -> Index:
    """Dissect a subtree again, by its vertices and the edges among them; return the vertices."""
    t_region = t.region
    vertices = _clear(t, region)
    if region == ROOT:
        t.state[its.LIVE_MADE] = 0  # known as soon as there are cliques again
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
        if high - low > LEAF and t_region[r, its.R_DEPTH] < DEEPEST - 1:
            begin, joins, strong, heavy = _induced(mine, start, neighbour, strength, weight, place)
            side = separate(begin, joins, strong, heavy)
        middle, end = _parted(mine, side, part, low)
        whole = middle == low or end == middle  # it does not fall into two parts
        if not whole:
            left, right = _new_region(t, r), _new_region(t, r)
            t_region[r, its.R_LEFT], t_region[r, its.R_RIGHT] = left, right
            stack[top, 0], stack[top, 1], stack[top, 2] = low, middle, left
            stack[top + 1, 0], stack[top + 1, 1], stack[top + 1, 2] = middle, end, right
            top += 2
        for k in range(len(mine)):
            if whole or side[k] == 2:
                _enter(t, vertices[mine[k]], r)
        t_region[r, its.R_MADE] = high - low
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
        vertex[vertices[k], its.LOCAL] = k
        weight[k] = vertex[vertices[k], its.DOF]
        a = vertex[vertices[k], its.LINK]
        while a != NOTHING:
            most += edge[link[a, its.LINK_EDGE], its.COUNT] - 1
            a = link[a, its.LINK_NEXT]
    start, neighbour, strength = np.zeros(n + 1, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    place = np.full(n, NOTHING, np.int64)
    top = 0
    for k in range(n):
        start[k] = top
        a = vertex[vertices[k], its.LINK]
        while a != NOTHING:
            e = link[a, its.LINK_EDGE]
            a = link[a, its.LINK_NEXT]
            for s in range(edge[e, its.COUNT] if edge[e, its.ACTIVE] else 0):
                u = vertex[link[edge[e, its.LINKED] + s, its.LINK_END], its.LOCAL]
                if u in (NOTHING, k):
                    continue
                if place[u] < start[k]:
                    place[u] = top
                    neighbour[top], strength[top] = u, 0
                    top += 1
                strength[place[u]] += 1
    start[n] = top
    for v in vertices:
        vertex[v, its.LOCAL] = NOTHING
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
