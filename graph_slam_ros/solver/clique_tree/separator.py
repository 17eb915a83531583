"""Vertex separators of a graph: a light set of vertices without which it falls into two parts of about equal weight.

Multilevel, as METIS does it (Karypis and Kumar, "A fast and high quality multilevel scheme for partitioning irregular
graphs", SIAM J. Sci. Comput. 1998): contract pairs of neighbours until the graph is small, separate that in two
ways, and carry the lighter separator back level after level, refining it on each (Fiduccia and Mattheyses 1982).

A graph is (start, neighbour, strength, weight): the neighbours of u are neighbour[start[u]:start[u + 1]], each once,
joined by so many edges of the original graph; weight is a vertex's degrees of freedom.
"""

from typing import Any

import numpy as np

from graph_slam_ros.lie.jit import inlined, inner, kernel
from graph_slam_ros.solver.clique_tree.indices import ascending, chosen
from graph_slam_ros.solver.clique_tree.storage import NOTHING, ZERO
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
