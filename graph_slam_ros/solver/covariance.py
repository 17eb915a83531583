"""Covariances out of the clique tree.

After Kaess and Dellaert, "Covariance recovery from a square root information matrix for data association", 2009.
"""

import numpy as np

from graph_slam_ros.lie.jit import inlined, inner, kernel
from graph_slam_ros.solver.clique_tree.indices import ascending, chosen
from graph_slam_ros.solver.clique_tree.storage import (
    CLIQUE,
    DOF,
    FREE,
    FRONT_DOF,
    FRONTALS,
    FULL_DOF,
    KEY,
    LOCAL,
    MARK,
    MEMBERS,
    NOTHING,
    PARENT,
    SIZE,
    Tree,
    front_of,
    row_of,
)
from graph_slam_ros.solver.clique_tree.symbolic import mark
from graph_slam_ros.typing import Array, Index


@kernel
def marginals(t: Tree, vertices: Index) -> Array:
    """Return the covariances of vertices, (dof, dof) each, one after the other."""
    vertex, clique, members = t.vertex, t.clique, t.members
    cliques = mark(t, vertices)[::-1]
    start, pool = _of_cliques(t, cliques)
    size = 0
    for v in vertices:
        size += vertex[v, DOF] ** 2
    out = np.empty(size)
    size = 0
    for v in vertices:
        c, dof = vertex[v, CLIQUE], vertex[v, DOF]
        full, at = clique[c, FULL_DOF], _place_in(vertex, clique, members, c, v)
        covariance = pool[start[clique[c, MARK]] : start[clique[c, MARK] + 1]].reshape(full, full)
        for i in range(dof):
            for j in range(dof):
                out[size] = covariance[at + i, at + j]
                size += 1
    for c in cliques:
        clique[c, MARK] = 0
    return out


@kernel
def among(t: Tree, ends: Index) -> Array:
    """Return joint covariances (n, D, D) of the vertices (n, k) of edges of one type; zero for held vertices.

    All vertices of an edge are in the clique of the one that is eliminated first.
    """
    vertex, clique, members = t.vertex, t.clique, t.members
    n, count = ends.shape
    every = ends.ravel()
    cliques = mark(t, every[vertex[every, FREE] == 1])[::-1]
    start, pool = _of_cliques(t, cliques)
    width = 0
    for s in range(count):
        width += vertex[ends[0, s], DOF]
    out, place = np.zeros((n, width, width)), np.empty(width, np.int64)
    for k in range(n):
        lowest, at = NOTHING, 0
        for v in ends[k]:
            if vertex[v, FREE]:
                lowest = max(lowest, clique[vertex[v, CLIQUE], MARK])
        if lowest == NOTHING:
            continue
        for v in ends[k]:
            first = _place_in(vertex, clique, members, cliques[lowest], v) if vertex[v, FREE] else NOTHING
            for i in range(vertex[v, DOF]):
                place[at] = first + i if vertex[v, FREE] else NOTHING
                at += 1
        full = clique[cliques[lowest], FULL_DOF]
        covariance = pool[start[lowest] : start[lowest + 1]].reshape(full, full)
        for i in range(width):
            for j in range(width):
                if place[i] != NOTHING and place[j] != NOTHING:
                    out[k, i, j] = covariance[place[i], place[j]]
    for c in cliques:
        clique[c, MARK] = 0
    return out


@inner
def _of_cliques(t: Tree, cliques: Index) -> tuple[Index, Array]:
    """Return where each clique's covariance begins, and all of them; the cliques' marks count them until reset.

    Each clique's covariance follows from its parent's, from the root down, once for all vertices.
    """
    clique = t.clique
    start = np.zeros(len(cliques) + 1, np.int64)
    for k in range(len(cliques)):
        clique[cliques[k], MARK] = k
        start[k + 1] = start[k] + clique[cliques[k], FULL_DOF] ** 2
    pool = np.empty(start[-1])
    for k in range(len(cliques)):
        c = cliques[k]
        full = clique[c, FULL_DOF]
        covariance = pool[start[k] : start[k + 1]].reshape(full, full)
        if clique[c, PARENT] != NOTHING:
            above = clique[clique[c, PARENT], MARK]
            wide = clique[clique[c, PARENT], FULL_DOF]
            _inherit(t, c, pool[start[above] : start[above + 1]].reshape(wide, wide), covariance)
        _complete(front_of(clique, t.fronts, c), clique[c, FRONT_DOF], covariance)
    return start, pool


@inlined
def _place_in(vertex: Index, clique: Index, members: Index, c: int, v: int) -> int:
    """The row where a member begins in a clique's front."""
    at = 0
    m = clique[c, MEMBERS]
    while members[m] != v:
        at += vertex[members[m], DOF]
        m += 1
    return at


@inlined
def _inherit(t: Tree, c: int, above: Array, covariance: Array) -> None:
    """Copy the covariance of a separator out of the parent's."""
    vertex, clique, members = t.vertex, t.clique, t.members
    frontal, full = clique[c, FRONT_DOF], clique[c, FULL_DOF]
    parent = clique[c, PARENT]
    at = 0
    for m in range(clique[parent, MEMBERS], clique[parent, MEMBERS] + clique[parent, SIZE]):
        vertex[members[m], LOCAL] = at
        at += vertex[members[m], DOF]
    place = np.empty(full - frontal, np.int64)
    at = 0
    for m in range(clique[c, MEMBERS] + clique[c, FRONTALS], clique[c, MEMBERS] + clique[c, SIZE]):
        for i in range(vertex[members[m], DOF]):
            place[at] = vertex[members[m], LOCAL] + i
            at += 1
    for m in range(clique[parent, MEMBERS], clique[parent, MEMBERS] + clique[parent, SIZE]):
        vertex[members[m], LOCAL] = NOTHING
    for i in range(at):
        for j in range(at):
            covariance[frontal + i, frontal + j] = above[place[i], place[j]]


@inlined
def _complete(front: Array, frontal: int, covariance: Array) -> None:
    """Complete the covariance from the separator's block: ``U11 X = [1 / U11', 0] - U12 Sigma``, column by column."""
    full = len(covariance)
    for j in range(full - 1, -1, -1):
        row = covariance[j]  # symmetric: also its column
        for a in range(min(frontal - 1, j), -1, -1):
            at = row_of(a, full)
            s = front[at + a] if a == j else 0.0
            for i in range(a + 1, full):
                s -= front[at + i] * row[i]
            row[a] = covariance[a, j] = s * front[at + a]


@kernel
def joint(t: Tree, vertices: Index) -> Array:
    """Return the joint covariance (D, D) of some vertices: ``Y'Y`` with ``U'Y = E``, E the unit vectors of theirs.

    Each column of Y goes from its vertex up to the root; all go up together. They are in order of elimination, so few
    of each row's entries between the first and the last are not zero.
    """
    vertex, clique, members = t.vertex, t.clique, t.members
    cliques = mark(t, vertices)
    rows = widest = 0
    for c in cliques:
        widest = max(widest, clique[c, FULL_DOF])
        for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, FRONTALS]):
            vertex[members[m], LOCAL] = rows
            rows += vertex[members[m], DOF]
    size = 0
    for v in vertices:
        size += vertex[v, DOF]
    y, first, end = np.zeros((rows, size)), np.full(rows, size), np.zeros(rows, np.int64)
    column = 0
    for v in chosen(vertices, _by_key(vertex, vertices)):
        for row in range(vertex[v, LOCAL], vertex[v, LOCAL] + vertex[v, DOF]):
            y[row, column] = 1.0
            first[row], end[row] = column, column + 1
            column += 1
    place = np.empty(widest, np.int64)
    for c in cliques:
        front, at = front_of(clique, t.fronts, c), 0
        for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, SIZE]):
            for i in range(vertex[members[m], DOF]):
                place[at] = vertex[members[m], LOCAL] + i
                at += 1
        for a in range(clique[c, FRONT_DOF]):
            p, packed = place[a], row_of(a, at)
            for k in range(first[p], end[p]):
                y[p, k] *= front[packed + a]
            for i in range(a + 1, at if first[p] < end[p] else 0):
                q, share = place[i], front[packed + i]
                for k in range(first[p], end[p]):
                    y[q, k] -= share * y[p, k]
                first[q], end[q] = min(first[q], first[p]), max(end[q], end[p])
    for c in cliques:
        for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, FRONTALS]):
            vertex[members[m], LOCAL] = NOTHING
    ordered = y.T @ y
    return _in_order_asked_for(vertex, vertices, ordered)


@kernel
def joint_of_each(t: Tree, ends: Index) -> Array:
    """Return the joint covariance (n, D, D) of the vertices (n, k) in each row, of the same kinds; zero for held ones.

    No edge need be between them.
    """
    vertex = t.vertex
    n, count = ends.shape
    width = 0
    for s in range(count):
        width += vertex[ends[0, s], DOF]
    out, free, place = np.zeros((n, width, width)), np.empty(count, np.int64), np.empty(width, np.int64)
    for k in range(n):
        many = size = at = 0
        for v in ends[k]:
            if vertex[v, FREE]:
                free[many] = v
                many += 1
                for i in range(vertex[v, DOF]):
                    place[size] = at + i
                    size += 1
            at += vertex[v, DOF]
        if many == 0:
            continue
        of_free = joint(t, free[:many])
        for i in range(size):
            for j in range(size):
                out[k, place[i], place[j]] = of_free[i, j]
    return out


@inner
def _by_key(vertex: Index, vertices: Index) -> Index:
    """Return the indices that sort vertices by their order of elimination."""
    key = np.empty(len(vertices), np.int64)
    for k in range(len(vertices)):
        key[k] = vertex[vertices[k], KEY]
    return ascending(key)


@inner
def _in_order_asked_for(vertex: Index, vertices: Index, ordered: Array) -> Array:
    """Return a symmetric matrix in the order of ``vertices``, from one in order of elimination."""
    begin = np.empty(len(vertices), np.int64)
    at = 0
    for k in _by_key(vertex, vertices):
        begin[k] = at
        at += vertex[vertices[k], DOF]
    place = np.empty(at, np.int64)
    at = 0
    for k in range(len(vertices)):
        for i in range(vertex[vertices[k], DOF]):
            place[at] = begin[k] + i
            at += 1
    out = np.empty((at, at))
    for i in range(at):
        for j in range(i + 1):
            out[i, j] = out[j, i] = ordered[place[i], place[j]]
    return out
