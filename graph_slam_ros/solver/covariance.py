"""Covariances out of the clique tree.

After Kaess and Dellaert, "Covariance recovery from a square root information matrix for data association", 2009.
"""

import numpy as np

from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.numeric import front_of
from graph_slam_ros.solver.symbolic import mark
from graph_slam_ros.solver.tree import (
    CLIQUE,
    DOF,
    FRONT_DOF,
    FRONTALS,
    FULL_DOF,
    LOCAL,
    MARK,
    MEMBERS,
    NOTHING,
    PARENT,
    SIZE,
    STEP,
    Array,
    Index,
    Tree,
)


@kernel
def marginals(t: Tree, vertices: Index) -> Array:
    """Covariances of vertices, (dof, dof) each, end to end.

    From the root down to their cliques: each clique's own given its parent's, once for all of them.
    """
    vertex, clique, members = t.vertex, t.clique, t.members
    cliques = mark(t, vertices)[::-1]
    start, size = np.zeros(len(cliques) + 1, np.int64), 0
    for k in range(len(cliques)):
        clique[cliques[k], MARK] = k
        start[k + 1] = start[k] + clique[cliques[k], FULL_DOF] ** 2
    for v in vertices:
        size += vertex[v, DOF] ** 2
    pool, out = np.empty(start[-1]), np.empty(size)
    for k in range(len(cliques)):
        c = cliques[k]
        full = clique[c, FULL_DOF]
        covariance = pool[start[k] : start[k + 1]].reshape(full, full)
        if clique[c, PARENT] != NOTHING:
            above = clique[clique[c, PARENT], MARK]
            wide = clique[clique[c, PARENT], FULL_DOF]
            _inherit(t, c, pool[start[above] : start[above + 1]].reshape(wide, wide), covariance)
        _complete(front_of(clique, t.fronts, c), clique[c, FRONT_DOF], covariance)
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
def _place_in(vertex: Index, clique: Index, members: Index, c: int, v: int) -> int:
    """Where a member begins in a clique's front."""
    at = 0
    m = clique[c, MEMBERS]
    while members[m] != v:
        at += vertex[members[m], DOF]
        m += 1
    return at


@kernel
def _inherit(t: Tree, c: int, above: Array, covariance: Array) -> None:
    """Take the covariance of a separator out of the parent's."""
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


@kernel
def _complete(front: Array, frontal: int, covariance: Array) -> None:
    """From the separator's block to the whole: ``U11 X = [1 / U11', 0] - U12 Sigma``, column after column."""
    full = len(covariance)
    for j in range(full - 1, -1, -1):
        row = covariance[j]  # symmetric: also its column
        for a in range(min(frontal - 1, j), -1, -1):
            s = front[a, a] if a == j else 0.0
            for i in range(a + 1, full):
                s -= front[a, i] * row[i]
            row[a] = covariance[a, j] = s * front[a, a]


@kernel
def joint(t: Tree, vertices: Index) -> Array:
    """Covariance (D, D) of some vertices together: the solutions of ``H X = E`` for the unit vectors of theirs.

    Each goes from its vertex up to the root, and from there down to all of them.
    """
    vertex, clique, members = t.vertex, t.clique, t.members
    cliques = mark(t, vertices)
    place = np.empty(np.sum(vertex[vertices, DOF]), np.int64)
    size = widest = 0
    for v in vertices:
        for i in range(vertex[v, DOF]):
            place[size] = vertex[v, STEP] + i
            size += 1
    for c in cliques:
        widest = max(widest, clique[c, FULL_DOF])
    out, x, local = np.empty((size, size)), np.zeros(len(t.step)), np.empty(widest)
    for column in range(size):
        x[place[column]] = 1.0
        for c in cliques:
            _gather(vertex, clique, members, c, x, local)
            front = front_of(clique, t.fronts, c)
            for a in range(clique[c, FRONT_DOF]):
                local[a] *= front[a, a]
                for i in range(a + 1, clique[c, FULL_DOF]):
                    local[i] -= front[a, i] * local[a]
            _scatter(vertex, clique, members, c, local, x)
        for c in cliques[::-1]:
            _gather(vertex, clique, members, c, x, local)
            front = front_of(clique, t.fronts, c)
            for a in range(clique[c, FRONT_DOF] - 1, -1, -1):
                s = local[a]
                for i in range(a + 1, clique[c, FULL_DOF]):
                    s -= front[a, i] * local[i]
                local[a] = s * front[a, a]
            _scatter(vertex, clique, members, c, local, x)
        for row in range(size):
            out[row, column] = x[place[row]]
        for c in cliques:
            for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, FRONTALS]):
                x[vertex[members[m], STEP] : vertex[members[m], STEP] + vertex[members[m], DOF]] = 0.0
    return 0.5 * (out + out.T)


@kernel
def _gather(vertex: Index, clique: Index, members: Index, c: int, x: Array, local: Array) -> None:
    at = 0
    for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, SIZE]):
        for i in range(vertex[members[m], DOF]):
            local[at] = x[vertex[members[m], STEP] + i]
            at += 1


@kernel
def _scatter(vertex: Index, clique: Index, members: Index, c: int, local: Array, x: Array) -> None:
    at = 0
    for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, SIZE]):
        for i in range(vertex[members[m], DOF]):
            x[vertex[members[m], STEP] + i] = local[at]
            at += 1
