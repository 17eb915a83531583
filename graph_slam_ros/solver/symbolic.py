"""Which cliques a change touches, and which cliques take their place."""

import numpy as np

from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.tree import (
    ACTIVE,
    CAPACITIES,
    CHILD,
    CLASS,
    CLIQUE,
    CLIQUES,
    COUNT,
    DOF,
    END,
    FREE,
    FRONT,
    FRONT_DOF,
    FRONTALS,
    FRONTS_TOP,
    FULL_DOF,
    KEY,
    LINK,
    LINK_EDGE,
    LINK_NEXT,
    LOCAL,
    MARK,
    MEMBERS,
    MEMBERS_TOP,
    NOTHING,
    PARENT,
    SIBLING,
    SIZE,
    Index,
    Tree,
)

RELAXED = 36  # zeros that a vertex may bring along when it joins a clique: fewer, larger fronts


@kernel
def mark(t: Tree, touched: Index) -> Index:
    """The cliques of the touched vertices and all their ancestors, children before parents."""
    count = 0
    out = np.empty(64, np.int64)
    for v in touched:
        c = t.vertex[v, CLIQUE]
        while c != NOTHING and t.clique[c, MARK] == 0:
            t.clique[c, MARK] = 1
            if count == len(out):
                out = np.concatenate((out, np.empty(count, np.int64)))
            out[count] = c
            count += 1
            c = t.clique[c, PARENT]
    marked = out[:count]
    last = np.empty(count, np.int64)
    for k in range(count):
        c = marked[k]
        t.clique[c, MARK] = 0
        last[k] = t.vertex[t.members[t.clique[c, MEMBERS] + t.clique[c, FRONTALS] - 1], KEY]
    return marked[np.argsort(last)]


@kernel
def collect(t: Tree, marked: Index, new: Index) -> tuple[Index, Index]:
    """What is eliminated again (frontals of marked cliques, and new vertices) in order, and the orphans.

    Orphans are unmarked children of marked cliques: their subtrees stay as they are.
    """
    count = len(new)
    children = 0
    for c in marked:
        t.clique[c, MARK] = 1
    for c in marked:
        count += t.clique[c, FRONTALS]
        k = t.clique[c, CHILD]
        while k != NOTHING:
            children += 1 - t.clique[k, MARK]
            k = t.clique[k, SIBLING]
    affected, orphans = np.empty(count, np.int64), np.empty(children, np.int64)
    count = children = 0
    for v in new:
        if t.vertex[v, FREE] == 1:
            affected[count] = v
            count += 1
    for c in marked:
        for m in range(t.clique[c, MEMBERS], t.clique[c, MEMBERS] + t.clique[c, FRONTALS]):
            if t.vertex[t.members[m], FREE] == 1:
                affected[count] = t.members[m]
                count += 1
        k = t.clique[c, CHILD]
        while k != NOTHING:
            if t.clique[k, MARK] == 0:
                orphans[children] = k
                children += 1
            k = t.clique[k, SIBLING]
    for c in marked:
        t.clique[c, MARK] = 0
    affected = affected[:count]
    key = np.empty(count, np.int64)
    for k in range(count):
        key[k] = t.vertex[affected[k], KEY]
    return affected[np.argsort(key)], orphans


@kernel
def structure(t: Tree, order: Index, orphans: Index) -> tuple[Index, Index]:
    """What each eliminated vertex leaves connected: of the k-th, numbers in ``order``, all later, the nearest first.

    It is joined by edges, by the separators of orphans, and by what earlier vertices left (its children in the
    elimination tree). Returns where each begins (n + 1) and the numbers.
    """
    n = len(order)
    for k in range(n):
        t.vertex[order[k], LOCAL] = k
    orphan_of, orphan_next = np.full(n, NOTHING, np.int64), np.empty(len(orphans), np.int64)
    for i in range(len(orphans)):
        c = orphans[i]
        first = n
        for m in range(t.clique[c, MEMBERS] + t.clique[c, FRONTALS], t.clique[c, MEMBERS] + t.clique[c, SIZE]):
            first = min(first, t.vertex[t.members[m], LOCAL])
        orphan_next[i] = orphan_of[first]
        orphan_of[first] = i
    child_of, child_next = np.full(n, NOTHING, np.int64), np.full(n, NOTHING, np.int64)
    seen = np.full(n, NOTHING, np.int64)
    start = np.zeros(n + 1, np.int64)
    later = np.empty(8 * n + 64, np.int64)
    top = 0
    for k in range(n):
        start[k] = top
        if top + n - k > len(later):
            later = np.concatenate((later, np.empty(len(later) + n, np.int64)))
        a = t.vertex[order[k], LINK]
        while a != NOTHING:
            e = t.link[a, LINK_EDGE]
            a = t.link[a, LINK_NEXT]
            if t.edge[e, ACTIVE] == 0:
                continue
            for s in range(t.edge[e, COUNT]):
                u = t.vertex[t.edge[e, END + s], LOCAL]
                if u > k and seen[u] != k:
                    seen[u] = k
                    later[top] = u
                    top += 1
        i = orphan_of[k]
        while i != NOTHING:
            c = orphans[i]
            i = orphan_next[i]
            for m in range(t.clique[c, MEMBERS] + t.clique[c, FRONTALS], t.clique[c, MEMBERS] + t.clique[c, SIZE]):
                u = t.vertex[t.members[m], LOCAL]
                if u > k and seen[u] != k:
                    seen[u] = k
                    later[top] = u
                    top += 1
        i = child_of[k]
        while i != NOTHING:
            for m in range(start[i], start[i + 1]):
                u = later[m]
                if u > k and seen[u] != k:
                    seen[u] = k
                    later[top] = u
                    top += 1
            i = child_next[i]
        if top > start[k]:
            nearest = start[k]
            for m in range(start[k], top):
                if later[m] < later[nearest]:
                    nearest = m
            later[start[k]], later[nearest] = later[nearest], later[start[k]]
            parent = later[start[k]]
            child_next[k] = child_of[parent]
            child_of[parent] = k
        start[k + 1] = top
    for v in order:
        t.vertex[v, LOCAL] = NOTHING
    return start, later


@kernel
def cliques_of(t: Tree, order: Index, start: Index, later: Index) -> tuple[Index, Index, Index]:
    """Group vertices into cliques, parents before children.

    A vertex joins its parent's clique where that gains few zeros. Returns the clique of each vertex, and of each
    clique its last vertex and its size in degrees of freedom.
    """
    n = len(order)
    clique = np.empty(n, np.int64)
    last, head, size = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    count = 0
    for k in range(n - 1, -1, -1):
        dof = t.vertex[order[k], DOF]
        width = 0
        for m in range(start[k], start[k + 1]):
            width += t.vertex[order[later[m]], DOF]
        if width > 0:
            parent = later[start[k]]
            c = clique[parent]
            if head[c] == parent and (size[c] - width) * dof <= RELAXED:
                clique[k], head[c] = c, k
                size[c] += dof
                continue
        clique[k], last[count], head[count], size[count] = count, k, k, width + dof
        count += 1
    return clique, last[:count], size[:count]


@kernel
def capacity_class(size: int) -> int:
    """The least size class that has room for so many degrees of freedom."""
    return np.searchsorted(CAPACITIES, size)


@kernel
def room_for(t: Tree, size: Index) -> tuple[int, int, int]:
    """What new cliques of these sizes add to the pools, beside what is vacant: cliques, members, numbers of fronts."""
    wanted = np.zeros(len(CAPACITIES), np.int64)
    for s in size:
        wanted[capacity_class(s)] += 1
    count = members = numbers = 0
    for k in range(len(CAPACITIES)):
        c = t.vacant[k]
        while c != NOTHING and wanted[k] > 0:
            wanted[k] -= 1
            c = t.clique[c, SIBLING]
        count += wanted[k]
        members += wanted[k] * CAPACITIES[k]
        numbers += wanted[k] * CAPACITIES[k] * (CAPACITIES[k] + 1)
    return count, members, numbers


@kernel
def release(t: Tree, cliques: Index) -> None:
    """Give cliques back: their places are used again by the next ones of the same size class, while still in cache."""
    for c in cliques:
        k = t.clique[c, CLASS]
        t.clique[c, SIBLING] = t.vacant[k]
        t.vacant[k] = c


@kernel
def _take(t: Tree, size: int) -> int:
    k = capacity_class(size)
    c = t.vacant[k]
    if c != NOTHING:
        t.vacant[k] = t.clique[c, SIBLING]
        return c
    c = t.state[CLIQUES]
    t.state[CLIQUES] += 1
    t.clique[c, CLASS] = k
    t.clique[c, MARK] = 0
    t.clique[c, MEMBERS] = t.state[MEMBERS_TOP]
    t.clique[c, FRONT] = t.state[FRONTS_TOP]
    t.state[MEMBERS_TOP] += CAPACITIES[k]
    t.state[FRONTS_TOP] += CAPACITIES[k] * (CAPACITIES[k] + 1)
    return c


@kernel
def build(
    t: Tree, order: Index, start: Index, later: Index, group: Index, last: Index, size: Index, orphans: Index
) -> Index:
    """Write the new cliques into the tree; returns them, children before parents."""
    n, count = len(order), len(last)
    new = np.empty(count, np.int64)
    fill = np.empty(count, np.int64)
    frontals = np.zeros(count, np.int64)
    for k in range(n):
        frontals[group[k]] += 1
    for j in range(count):
        c = new[j] = _take(t, size[j])
        k = last[j]
        t.clique[c, FRONTALS] = frontals[j]
        t.clique[c, SIZE] = frontals[j] + start[k + 1] - start[k]
        t.clique[c, FULL_DOF] = size[j]
        t.clique[c, FRONT_DOF] = 0
        t.clique[c, PARENT] = t.clique[c, CHILD] = t.clique[c, SIBLING] = NOTHING
        fill[j] = t.clique[c, MEMBERS]
        separator = fill[j] + frontals[j]
        for m in range(start[k], start[k + 1]):
            t.members[separator] = order[later[m]]
            separator += 1
    for k in range(n):
        j, v = group[k], order[k]
        t.members[fill[j]] = v
        fill[j] += 1
        t.vertex[v, CLIQUE] = new[j]
        t.clique[new[j], FRONT_DOF] += t.vertex[v, DOF]
    for j in range(count):
        k = last[j]
        if start[k + 1] > start[k]:
            _hang(t, new[j], new[group[later[start[k]]]])
    for c in orphans:
        parent = NOTHING
        key = np.iinfo(np.int64).max
        for m in range(t.clique[c, MEMBERS] + t.clique[c, FRONTALS], t.clique[c, MEMBERS] + t.clique[c, SIZE]):
            if t.vertex[t.members[m], KEY] < key:
                key = t.vertex[t.members[m], KEY]
                parent = t.vertex[t.members[m], CLIQUE]
        _hang(t, c, parent)
    return new[::-1]


@kernel
def _hang(t: Tree, c: int, parent: int) -> None:
    t.clique[c, PARENT] = parent
    t.clique[c, SIBLING] = t.clique[parent, CHILD]
    t.clique[parent, CHILD] = c
