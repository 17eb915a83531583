"""Symbolic elimination: the cliques that a change touches, and those that replace them."""

import numpy as np

from graph_slam_ros.lie.jit import inlined, inner, kernel
from graph_slam_ros.solver.clique_tree.indices import ascending, chosen, lengthened
from graph_slam_ros.solver.clique_tree.pools import allocate
from graph_slam_ros.solver.clique_tree.storage import (
    ACTIVE,
    CHILD,
    CLIQUE,
    COUNT,
    DOF,
    FREE,
    FRONT_DOF,
    FRONTALS,
    FULL_DOF,
    KEY,
    LINK,
    LINK_EDGE,
    LINK_END,
    LINK_NEXT,
    LINKED,
    LOCAL,
    MARK,
    MEMBERS,
    NEVER,
    NOTHING,
    OWNER,
    PARENT,
    REGION,
    SEEN,
    SIBLING,
    SIZE,
    ZERO,
    Tree,
)
from graph_slam_ros.typing import Index

RELAXED = 36  # zeros that a vertex may bring along when it joins a clique: fewer, larger fronts
SHARE = 0.36  # or so many in each row of a large one: elimination pays for them, and assembly of a front is saved


@kernel
def mark(t: Tree, touched: Index) -> Index:
    """Return the cliques of the touched vertices and all their ancestors, children before parents.

    Ancestors are found by the tree, not by the keys: below a region that was ordered again, keys may be later.
    """
    vertex, clique = t.vertex, t.clique
    count, ways = ZERO, 0
    found, begin = np.empty(64, np.int64), np.empty(len(touched) + 1, np.int64)
    for v in touched:
        c = vertex[v, CLIQUE]
        begin[ways] = count
        while c != NOTHING and clique[c, MARK] == 0:
            clique[c, MARK] = 1
            if count == len(found):
                found = lengthened(found, count)
            found[count] = c
            count += 1
            c = clique[c, PARENT]
        ways += 1
    begin[ways] = count
    out = np.empty(count, np.int64)
    at = 0
    for w in range(ways - 1, -1, -1):  # each way ends below an earlier one
        for k in range(begin[w], begin[w + 1]):
            out[at] = found[k]
            clique[found[k], MARK] = 0
            at += 1
    return out


@kernel
def collect(t: Tree, marked: Index, new: Index) -> tuple[Index, Index]:
    """Collect the vertices to eliminate again (frontals of marked cliques, and new ones) in order, and the orphans.

    Orphans are unmarked children of marked cliques: their subtrees stay as they are.
    """
    vertex, clique, members = t.vertex, t.clique, t.members
    count = len(new)
    children = 0
    for c in marked:
        clique[c, MARK] = 1
    for c in marked:
        count += clique[c, FRONTALS]
        k = clique[c, CHILD]
        while k != NOTHING:
            children += 1 - clique[k, MARK]
            k = clique[k, SIBLING]
    affected, orphans = np.empty(count, np.int64), np.empty(children, np.int64)
    count = children = 0
    for v in new:
        if vertex[v, FREE] == 1:
            affected[count] = v
            count += 1
    for c in marked:
        for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, FRONTALS]):
            if vertex[members[m], FREE] == 1:
                affected[count] = members[m]
                count += 1
        k = clique[c, CHILD]
        while k != NOTHING:
            if clique[k, MARK] == 0:
                orphans[children] = k
                children += 1
            k = clique[k, SIBLING]
    for c in marked:
        clique[c, MARK] = 0
    key = np.empty(count, np.int64)
    for k in range(count):
        key[k] = vertex[affected[k], KEY]
    return chosen(affected, ascending(key)), orphans


@inner
def structure(t: Tree, order: Index, orphans: Index) -> tuple[Index, Index]:
    """Find what each eliminated vertex leaves connected: of the k-th, indices in ``order``, later ones, nearest first.

    It is connected by edges, by the separators of orphans, and by what earlier vertices left (its children in the
    elimination tree). Returns where each begins (n + 1) and the indices.
    """
    vertex = t.vertex
    n = len(order)
    for k in range(n):
        vertex[order[k], LOCAL] = k
    scratch = np.full(4 * n + len(orphans), NOTHING, np.int64)  # one array: each takes as long as ten vertices
    child_of, child_next, seen = scratch[:n], scratch[n : 2 * n], scratch[2 * n : 3 * n]
    orphan_of, orphan_next = scratch[3 * n : 4 * n], scratch[4 * n :]
    _link_by_first(t, orphans, n, orphan_of, orphan_next)
    start = np.empty(n + 1, np.int64)
    later = np.empty(8 * n + 64, np.int64)
    top = ZERO
    for k in range(n):
        start[k] = top
        if top + n - k > len(later):
            later = lengthened(later, len(later) + n)
        top = _joined_by_edges(t, order[k], k, seen, later, top)
        i = orphan_of[k]
        while i != NOTHING:
            top = _joined_by_orphan(t, orphans[i], k, seen, later, top)
            i = orphan_next[i]
        i = child_of[k]
        while i != NOTHING:
            for m in range(start[i], start[i + 1]):
                top = _note_later(later[m], k, seen, later, top)
            i = child_next[i]
        if top > start[k]:
            nearest = start[k]
            for m in range(start[k] + 1, top):
                if later[m] < later[nearest]:
                    nearest = m
            later[start[k]], later[nearest] = later[nearest], later[start[k]]
            parent = later[start[k]]
            child_next[k] = child_of[parent]
            child_of[parent] = k
    start[n] = top
    for v in order:
        vertex[v, LOCAL] = NOTHING
    return start, later


@inner
def _link_by_first(t: Tree, orphans: Index, n: int, orphan_of: Index, orphan_next: Index) -> None:
    """Link the orphans to lists by the vertex of their separator that is eliminated first."""
    vertex, clique, members = t.vertex, t.clique, t.members
    for i in range(len(orphans)):
        c = orphans[i]
        first = n
        for m in range(clique[c, MEMBERS] + clique[c, FRONTALS], clique[c, MEMBERS] + clique[c, SIZE]):
            first = min(first, vertex[members[m], LOCAL])
        orphan_next[i] = orphan_of[first]
        orphan_of[first] = i


@inlined
def _note_later(u: int, k: int, seen: Index, later: Index, top: int) -> int:
    """Note u as connected to k, once, if it is later; return how many are noted."""
    if u > k and seen[u] != k:
        seen[u] = k
        later[top] = u
        return top + 1
    return top


@inlined
def _joined_by_edges(t: Tree, v: int, k: int, seen: Index, later: Index, top: int) -> int:
    """Note the vertices that edges connect to v; v owns those edges of which it is eliminated first."""
    vertex, edge, link = t.vertex, t.edge, t.link
    a = vertex[v, LINK]
    while a != NOTHING:
        e = link[a, LINK_EDGE]
        a = link[a, LINK_NEXT]
        if edge[e, ACTIVE] == 0:
            continue
        first = True
        for s in range(edge[e, COUNT]):
            w = link[edge[e, LINKED] + s, LINK_END]
            u = vertex[w, LOCAL]
            first = first and not (u < k and vertex[w, FREE] == 1)
            top = _note_later(u, k, seen, later, top)
        if first:
            edge[e, OWNER] = v
    return top


@inlined
def _joined_by_orphan(t: Tree, c: int, k: int, seen: Index, later: Index, top: int) -> int:
    """Note the vertices that an orphan's separator connects."""
    vertex, clique, members = t.vertex, t.clique, t.members
    for m in range(clique[c, MEMBERS] + clique[c, FRONTALS], clique[c, MEMBERS] + clique[c, SIZE]):
        top = _note_later(vertex[members[m], LOCAL], k, seen, later, top)
    return top


@inner
def cliques_of(t: Tree, order: Index, start: Index, later: Index) -> tuple[Index, Index, Index]:
    """Group vertices into cliques, parents before children.

    A vertex joins its parent's clique if that adds few zeros. Returns the clique of each vertex, and of each clique its
    last vertex and its size in degrees of freedom.
    """
    vertex = t.vertex
    n = len(order)
    made = np.empty(4 * n, np.int64)
    clique, last, head, size = made[:n], made[n : 2 * n], made[2 * n : 3 * n], made[3 * n :]
    count = 0
    for k in range(n - 1, -1, -1):
        dof = vertex[order[k], DOF]
        width = 0
        for m in range(start[k], start[k + 1]):
            width += vertex[order[later[m]], DOF]
        if width > 0:
            parent = later[start[k]]
            c = clique[parent]
            same = (vertex[order[k], REGION] == NOTHING) == (vertex[order[parent], REGION] == NOTHING)
            zeros = dof * (size[c] - width)
            if head[c] == parent and (zeros <= RELAXED or (same and zeros <= SHARE * size[c])):
                clique[k], head[c] = c, k
                size[c] += dof
                continue
        clique[k], last[count], head[count], size[count] = count, k, k, width + dof
        count += 1
    return clique, last[:count], size[:count]


@kernel
def build(
    t: Tree, order: Index, start: Index, later: Index, group: Index, last: Index, size: Index, orphans: Index
) -> Index:
    """Write the new cliques into the tree; returns them, children before parents."""
    vertex, clique, members = t.vertex, t.clique, t.members
    n, count = len(order), len(last)
    made = np.zeros(4 * count, np.int64)
    new, fill, frontals, upwards = made[:count], made[count : 2 * count], made[2 * count : 3 * count], made[3 * count :]
    for k in range(n):
        frontals[group[k]] += 1
    for j in range(count):
        c = new[j] = allocate(t, size[j])
        k = last[j]
        clique[c, FRONTALS] = frontals[j]
        clique[c, SIZE] = frontals[j] + start[k + 1] - start[k]
        clique[c, FULL_DOF] = size[j]
        clique[c, FRONT_DOF] = 0
        clique[c, SEEN] = NEVER
        clique[c, PARENT] = clique[c, CHILD] = clique[c, SIBLING] = NOTHING
        fill[j] = clique[c, MEMBERS]
        separator = fill[j] + frontals[j]
        for m in range(start[k], start[k + 1]):
            members[separator] = order[later[m]]
            separator += 1
    for k in range(n):
        j, v = group[k], order[k]
        members[fill[j]] = v
        fill[j] += 1
        vertex[v, CLIQUE] = new[j]
        clique[new[j], FRONT_DOF] += vertex[v, DOF]
    for j in range(count):
        k = last[j]
        if start[k + 1] > start[k]:
            _hang(t, new[j], new[group[later[start[k]]]])
    for c in orphans:
        parent = ZERO + NOTHING
        key = np.iinfo(np.int64).max
        for m in range(clique[c, MEMBERS] + clique[c, FRONTALS], clique[c, MEMBERS] + clique[c, SIZE]):
            if vertex[members[m], KEY] < key:
                key = vertex[members[m], KEY]
                parent = vertex[members[m], CLIQUE]
        _hang(t, c, parent)
    for j in range(count):
        upwards[j] = new[count - 1 - j]
    return upwards


@inlined
def _hang(t: Tree, c: int, parent: int) -> None:
    clique = t.clique
    clique[c, PARENT] = parent
    clique[c, SIBLING] = clique[parent, CHILD]
    clique[parent, CHILD] = c
