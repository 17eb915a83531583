"""In which order vertices are eliminated: a nested dissection that follows the graph's growth.

Regions form a binary tree. The vertices of an inner region separate those of its two subtrees, so they are eliminated
after both: a path from any vertex to the root is short, and an update touches little. The newest vertices, the
*tail*, come last of all in order of time, so that the next odometry edge meets the root. When the tail is long its
older half moves down, each vertex into the deepest region that keeps the separation true. A region whose subtree has
grown too much is dissected anew; that is paid for by what was added to it.
"""

import numpy as np

from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.tree import (
    ACTIVE,
    COUNT,
    DOF,
    END,
    FREE,
    FREE_REGION,
    KEY,
    LINK,
    LINK_EDGE,
    LINK_NEXT,
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
    REGION,
    REGIONS,
    TAIL_END,
    TAIL_FIRST,
    Index,
    Tree,
)

LEAF = 6  # vertices a region need not be dissected for
GROWTH = 2.0  # a subtree is dissected anew when it has grown by this factor
DEEPEST = 200


@kernel
def key_of(depth: int, region: int, vertex: int) -> int:
    """Deeper regions are eliminated first, then as they came; the tail (depth -1) last."""
    return ((DEEPEST - depth) << 54) | (region << 31) | vertex


@kernel
def move_tail(t: Tree, keep: int, touched: Index) -> Index:
    """Move the older vertices of a tail of more than twice ``keep`` down; returns all vertices this touches."""
    first, end = t.state[TAIL_FIRST], t.state[TAIL_END]
    if end - first <= 2 * keep:
        return touched
    last = end - keep
    moving = t.tail[first:last]
    t.state[TAIL_FIRST] = last
    if last - first > max(t.region[0, R_COUNT], 4 * keep):  # as many as there are: all in one go
        for v in moving:
            if t.vertex[v, FREE] == 1:
                _enter(t, v, 0)
        return np.concatenate((touched, dissect(t, 0)))
    overgrown = NOTHING
    for v in moving:
        if t.vertex[v, FREE] == 0:
            continue
        _enter(t, v, _deepest_place(t, v))
        r = t.vertex[v, REGION]
        while r != NOTHING:
            if t.region[r, R_COUNT] > GROWTH * t.region[r, R_MADE] + LEAF and (
                overgrown == NOTHING or t.region[r, R_DEPTH] < t.region[overgrown, R_DEPTH]
            ):
                overgrown = r
            r = t.region[r, R_PARENT]
    touched = np.concatenate((touched, neighbourhood(t, moving)))
    if overgrown != NOTHING:
        touched = np.concatenate((touched, dissect(t, overgrown)))
    return touched


@kernel
def neighbourhood(t: Tree, vertices: Index) -> Index:
    """The vertices and all that share an edge with one of them; some more than once."""
    count = 0
    for v in vertices:
        count += 1
        a = t.vertex[v, LINK]
        while a != NOTHING:
            count += t.edge[t.link[a, LINK_EDGE], COUNT]
            a = t.link[a, LINK_NEXT]
    out = np.empty(count, np.int64)
    count = 0
    for v in vertices:
        out[count] = v
        count += 1
        a = t.vertex[v, LINK]
        while a != NOTHING:
            e = t.link[a, LINK_EDGE]
            for s in range(t.edge[e, COUNT]):
                out[count] = t.edge[e, END + s]
                count += 1
            a = t.link[a, LINK_NEXT]
    return out


@kernel
def _enter(t: Tree, v: int, region: int) -> None:
    """Put a vertex into a region."""
    t.vertex[v, REGION] = region
    t.vertex[v, KEY] = key_of(t.region[region, R_DEPTH], region, v)
    t.vertex[v, NEXT] = t.region[region, R_FIRST]
    t.region[region, R_FIRST] = v
    while region != NOTHING:
        t.region[region, R_COUNT] += 1
        region = t.region[region, R_PARENT]


@kernel
def _deepest_place(t: Tree, v: int) -> int:
    """The deepest region that has each region of v's neighbours above, at or below it, never beside it."""
    deepest = NOTHING
    for u in neighbourhood(t, np.array([v])):
        r = t.vertex[u, REGION]
        if r != NOTHING and (deepest == NOTHING or t.region[r, R_DEPTH] > t.region[deepest, R_DEPTH]):
            deepest = r
    place = max(deepest, 0)
    beside = False
    for u in neighbourhood(t, np.array([v])):
        r = t.vertex[u, REGION]
        if r == NOTHING:
            continue
        a = deepest
        while t.region[a, R_DEPTH] > t.region[r, R_DEPTH]:
            a = t.region[a, R_PARENT]
        if a != r:
            beside = True
            while a != r:
                a, r = t.region[a, R_PARENT], t.region[r, R_PARENT]
            if t.region[a, R_DEPTH] < t.region[place, R_DEPTH]:
                place = a
    while not beside and t.region[place, R_LEFT] != NOTHING:  # beyond a separator: begin in the emptier part
        left, right = t.region[place, R_LEFT], t.region[place, R_RIGHT]
        place = left if t.region[left, R_COUNT] <= t.region[right, R_COUNT] else right
    return place


@kernel
def _new_region(t: Tree, parent: int) -> int:
    r = t.state[FREE_REGION]
    if r != NOTHING:
        t.state[FREE_REGION] = t.region[r, R_PARENT]
    else:
        r = t.state[REGIONS]
        t.state[REGIONS] += 1
    t.region[r, R_PARENT] = parent
    t.region[r, R_DEPTH] = t.region[parent, R_DEPTH] + 1
    t.region[r, R_LEFT] = t.region[r, R_RIGHT] = t.region[r, R_FIRST] = NOTHING
    t.region[r, R_COUNT] = 0
    return r


@kernel
def _clear(t: Tree, region: int) -> Index:
    """Take all vertices out of a subtree of regions, and its inner regions away; returns the vertices by id."""
    out = np.empty(t.region[region, R_COUNT], np.int64)
    count = 0
    stack = [region]
    while len(stack):
        r = stack.pop()
        v = t.region[r, R_FIRST]
        while v != NOTHING:
            if t.vertex[v, FREE] == 1:
                out[count] = v
                count += 1
            v = t.vertex[v, NEXT]
        if t.region[r, R_LEFT] != NOTHING:
            stack.append(t.region[r, R_LEFT])
            stack.append(t.region[r, R_RIGHT])
        if r != region:
            t.region[r, R_PARENT] = t.state[FREE_REGION]
            t.state[FREE_REGION] = r
    t.region[region, R_FIRST] = t.region[region, R_LEFT] = t.region[region, R_RIGHT] = NOTHING
    gone = t.region[region, R_COUNT]
    r = region
    while r != NOTHING:
        t.region[r, R_COUNT] -= gone
        r = t.region[r, R_PARENT]
    return np.sort(out[:count])


@kernel
def dissect(t: Tree, region: int) -> Index:
    """Divide a subtree anew, from its vertices and the edges among them; returns the vertices."""
    vertices = _clear(t, region)
    start, neighbour = _adjacency(t, vertices)
    n = len(vertices)
    weight = np.empty(n, np.int64)
    for k in range(n):
        weight[k] = t.vertex[vertices[k], DOF]
    part = np.arange(n)
    position = np.full(n, NOTHING, np.int64)
    stack = [(0, n, region)]
    while len(stack):
        low, high, r = stack.pop()
        mine = part[low:high]
        if high - low > LEAF and t.region[r, R_DEPTH] < DEEPEST - 1:
            a, b = _divide(mine, start, neighbour, weight, position)
        else:
            a = b = 0
        if a > 0 and b > 0:
            left, right = _new_region(t, r), _new_region(t, r)
            t.region[r, R_LEFT], t.region[r, R_RIGHT] = left, right
            stack.append((low, low + a, left))
            stack.append((low + a, low + a + b, right))
        else:
            a = b = 0
        for k in mine[a + b :]:
            _enter(t, vertices[k], r)
        t.region[r, R_MADE] = high - low
    return vertices


@kernel
def _adjacency(t: Tree, vertices: Index) -> tuple[Index, Index]:
    """Neighbours among the given vertices: of the k-th, numbers start[k] to start[k + 1]; some more than once."""
    n = len(vertices)
    for k in range(n):
        t.vertex[vertices[k], LOCAL] = k
    start = np.zeros(n + 1, np.int64)
    neighbour = np.empty(0, np.int64)
    for fill in range(2):
        count = 0
        for k in range(n):
            start[k] = count
            a = t.vertex[vertices[k], LINK]
            while a != NOTHING:
                e = t.link[a, LINK_EDGE]
                a = t.link[a, LINK_NEXT]
                if t.edge[e, ACTIVE] == 0:
                    continue
                for s in range(t.edge[e, COUNT]):
                    u = t.vertex[t.edge[e, END + s], LOCAL]
                    if u != NOTHING and u != k:
                        if fill:
                            neighbour[count] = u
                        count += 1
        start[n] = count
        if not fill:
            neighbour = np.empty(count, np.int64)
    for v in vertices:
        t.vertex[v, LOCAL] = NOTHING
    return start, neighbour


@kernel
def _divide(part: Index, start: Index, neighbour: Index, weight: Index, position: Index) -> tuple[int, int]:
    """Reorder ``part`` into two sides and what separates them; returns the sizes of the sides.

    Orders of the vertices are swept by a cut; the vertices on one side of the cut that have a neighbour across it
    separate. The lightest separator between a third and two thirds wins. Tried: the order of time, and of distance
    from an outermost vertex.
    """
    n = len(part)
    side = np.empty(n, np.int64)
    best = 1e300
    for k in range(n):
        position[part[k]] = k
    for attempt in range(2):
        if attempt == 1:
            outermost = _by_distance(part[0], part, start, neighbour, position)[n - 1]
            order = _by_distance(outermost, part, start, neighbour, position)
            for k in range(n):
                position[order[k]] = k
        before, after = np.zeros(n + 2), np.zeros(n + 2)
        low, high = np.empty(n, np.int64), np.empty(n, np.int64)
        for i in range(n):
            u = part[i]
            p = position[u]
            low[i] = high[i] = p
            for a in range(start[u], start[u + 1]):
                q = position[neighbour[a]]
                if q != NOTHING:
                    low[i], high[i] = min(low[i], q), max(high[i], q)
            # the cut at c has positions below c before it
            before[p + 1] += weight[u]
            before[high[i] + 1] -= weight[u]
            after[low[i] + 1] += weight[u]
            after[p + 1] -= weight[u]
        cut, of_before = NOTHING, True
        x = y = 0.0
        for c in range(n):
            x += before[c]
            y += after[c]
            if 3 * c < n or 3 * c > 2 * n or c == 0:
                continue
            off = 1.0 + abs(2.0 * c / n - 1.0)
            if x * off < best:
                best, cut, of_before = x * off, c, True
            if y * off < best:
                best, cut, of_before = y * off, c, False
        if cut != NOTHING:
            for i in range(n):
                p = position[part[i]]
                if p < cut:
                    side[i] = 2 if of_before and high[i] >= cut else 0
                else:
                    side[i] = 2 if not of_before and low[i] < cut else 1
    for u in part:
        position[u] = NOTHING
    one, other, between = part[side == 0], part[side == 1], part[side == 2]
    part[:] = np.concatenate((one, other, between))
    return len(one), len(other)


@kernel
def _by_distance(first: int, part: Index, start: Index, neighbour: Index, position: Index) -> Index:
    """Breadth-first order from a vertex, ``position`` counting in ``part``; what it does not reach follows."""
    n = len(part)
    order = np.empty(n, np.int64)
    seen = np.zeros(n, np.uint8)
    order[0] = first
    seen[position[first]] = 1
    done, count, rest = 0, 1, 0
    while count < n or done < count:
        if done == count:
            while seen[rest]:
                rest += 1
            order[count] = part[rest]
            seen[rest] = 1
            count += 1
        u = order[done]
        done += 1
        for a in range(start[u], start[u + 1]):
            w = neighbour[a]
            if position[w] != NOTHING and seen[position[w]] == 0:
                seen[position[w]] = 1
                order[count] = w
                count += 1
    return order
