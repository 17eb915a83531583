"""Covariances out of the clique tree: of some vertices together, and without some edges.

After Kaess and Dellaert, "Covariance recovery from a square root information matrix for data association", 2009.
"""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtrs

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.lie.jit import inlined, inner, kernel
from graph_slam_ros.solver.clique_tree import storage as its
from graph_slam_ros.solver.clique_tree.incremental import mark
from graph_slam_ros.solver.clique_tree.storage import NOTHING, Tree, ascending, front_of, row_of
from graph_slam_ros.solver.linearization import blocks_of
from graph_slam_ros.typing import Array, Index


@kernel
def among(t: Tree, ends: Index) -> Array:
    """Return joint covariances (n, D, D) of the vertices (n, k) of edges of one type; zero for held vertices.

    All vertices of an edge are in the clique of the one that is eliminated first.
    """
    vertex, clique, members = t.vertex, t.clique, t.members
    n, count = ends.shape
    every = ends.ravel()
    cliques = mark(t, every[vertex[every, its.FREE] == 1])[::-1]
    start, pool = _of_cliques(t, cliques)
    width = 0
    for s in range(count):
        width += vertex[ends[0, s], its.DOF]
    out, place = np.zeros((n, width, width)), np.empty(width, np.int64)
    for k in range(n):
        lowest, at = NOTHING, 0
        for v in ends[k]:
            if vertex[v, its.FREE]:
                lowest = max(lowest, clique[vertex[v, its.CLIQUE], its.MARK])
        if lowest == NOTHING:
            continue
        for v in ends[k]:
            first = _place_in(vertex, clique, members, cliques[lowest], v) if vertex[v, its.FREE] else NOTHING
            for i in range(vertex[v, its.DOF]):
                place[at] = first + i if vertex[v, its.FREE] else NOTHING
                at += 1
        full = clique[cliques[lowest], its.FULL_DOF]
        covariance = pool[start[lowest] : start[lowest + 1]].reshape(full, full)
        for i in range(width):
            for j in range(width):
                if place[i] != NOTHING and place[j] != NOTHING:
                    out[k, i, j] = covariance[place[i], place[j]]
    for c in cliques:
        clique[c, its.MARK] = 0
    return out


@inner
def _of_cliques(t: Tree, cliques: Index) -> tuple[Index, Array]:
    """Return where each clique's covariance begins, and all of them; the cliques' marks count them until reset.

    Each clique's covariance follows from its parent's, from the root down, once for all vertices.
    """
    clique = t.clique
    start = np.zeros(len(cliques) + 1, np.int64)
    for k in range(len(cliques)):
        clique[cliques[k], its.MARK] = k
        start[k + 1] = start[k] + clique[cliques[k], its.FULL_DOF] ** 2
    pool = np.empty(start[-1])
    for k in range(len(cliques)):
        c = cliques[k]
        full = clique[c, its.FULL_DOF]
        covariance = pool[start[k] : start[k + 1]].reshape(full, full)
        if clique[c, its.PARENT] != NOTHING:
            above = clique[clique[c, its.PARENT], its.MARK]
            wide = clique[clique[c, its.PARENT], its.FULL_DOF]
            _inherit(t, c, pool[start[above] : start[above + 1]].reshape(wide, wide), covariance)
        _complete(front_of(clique, t.fronts, c), clique[c, its.FRONT_DOF], covariance)
    return start, pool


@inlined
def _place_in(vertex: Index, clique: Index, members: Index, c: int, v: int) -> int:
    """The row where a member begins in a clique's front."""
    at = 0
    m = clique[c, its.MEMBERS]
    while members[m] != v:
        at += vertex[members[m], its.DOF]
        m += 1
    return at


@inlined
def _inherit(t: Tree, c: int, above: Array, covariance: Array) -> None:
    """Copy the covariance of a separator out of the parent's."""
    vertex, clique, members = t.vertex, t.clique, t.members
    frontal, full = clique[c, its.FRONT_DOF], clique[c, its.FULL_DOF]
    parent = clique[c, its.PARENT]
    at = 0
    for m in range(clique[parent, its.MEMBERS], clique[parent, its.MEMBERS] + clique[parent, its.SIZE]):
        vertex[members[m], its.LOCAL] = at
        at += vertex[members[m], its.DOF]
    place = np.empty(full - frontal, np.int64)
    at = 0
    for m in range(clique[c, its.MEMBERS] + clique[c, its.FRONTALS], clique[c, its.MEMBERS] + clique[c, its.SIZE]):
        for i in range(vertex[members[m], its.DOF]):
            place[at] = vertex[members[m], its.LOCAL] + i
            at += 1
    for m in range(clique[parent, its.MEMBERS], clique[parent, its.MEMBERS] + clique[parent, its.SIZE]):
        vertex[members[m], its.LOCAL] = NOTHING
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
        widest = max(widest, clique[c, its.FULL_DOF])
        for m in range(clique[c, its.MEMBERS], clique[c, its.MEMBERS] + clique[c, its.FRONTALS]):
            vertex[members[m], its.LOCAL] = rows
            rows += vertex[members[m], its.DOF]
    key, begin, size = np.empty(len(vertices), np.int64), np.empty(len(vertices), np.int64), 0
    for k in range(len(vertices)):
        key[k], begin[k] = vertex[vertices[k], its.KEY], size
        size += vertex[vertices[k], its.DOF]
    y, first, end = np.zeros((rows, size)), np.full(rows, size), np.zeros(rows, np.int64)
    column, given = 0, np.empty(size, np.int64)  # where a column is in the order that was asked for
    for k in ascending(key):
        v = vertices[k]
        for i in range(vertex[v, its.DOF]):
            row = vertex[v, its.LOCAL] + i
            y[row, column], given[column] = 1.0, begin[k] + i
            first[row], end[row] = column, column + 1
            column += 1
    place = np.empty(widest, np.int64)
    for c in cliques:
        front, at = front_of(clique, t.fronts, c), 0
        for m in range(clique[c, its.MEMBERS], clique[c, its.MEMBERS] + clique[c, its.SIZE]):
            for i in range(vertex[members[m], its.DOF]):
                place[at] = vertex[members[m], its.LOCAL] + i
                at += 1
        for a in range(clique[c, its.FRONT_DOF]):
            p, packed = place[a], row_of(a, at)
            for k in range(first[p], end[p]):
                y[p, k] *= front[packed + a]
            for i in range(a + 1, at if first[p] < end[p] else 0):
                q, share = place[i], front[packed + i]
                for k in range(first[p], end[p]):
                    y[q, k] -= share * y[p, k]
                first[q], end[q] = min(first[q], first[p]), max(end[q], end[p])
    for c in cliques:
        for m in range(clique[c, its.MEMBERS], clique[c, its.MEMBERS] + clique[c, its.FRONTALS]):
            vertex[members[m], its.LOCAL] = NOTHING
    ordered, out = y.T @ y, np.empty((size, size))
    for i in range(size):
        for j in range(i + 1):
            out[given[i], given[j]] = out[given[j], given[i]] = ordered[i, j]
    return out


@kernel
def joint_of_each(t: Tree, ends: Index) -> Array:
    """Return the joint covariance (n, D, D) of the vertices (n, k) in each row, of the same kinds; zero for held ones.

    No edge need be between them.
    """
    vertex = t.vertex
    n, count = ends.shape
    width = 0
    for s in range(count):
        width += vertex[ends[0, s], its.DOF]
    out, free, place = np.zeros((n, width, width)), np.empty(count, np.int64), np.empty(width, np.int64)
    for k in range(n):
        many = size = at = 0
        for v in ends[k]:
            if vertex[v, its.FREE]:
                free[many] = v
                many += 1
                for i in range(vertex[v, its.DOF]):
                    place[size] = at + i
                    size += 1
            at += vertex[v, its.DOF]
        if many == 0:
            continue
        of_free = joint(t, free[:many])
        for i in range(size):
            for j in range(size):
                out[k, place[i], place[j]] = of_free[i, j]
    return out


_LEAST_PIVOT = 1e-8  # of what is left of the information, in units of all of it: below, rounding would decide


def without_edges(
    graph: Graph, tree: Tree, joint: Callable[[Index], Array], vertices: Index, edges: Index
) -> tuple[Array, Array]:
    """Return stored values of vertices, one after the other, and their joint covariance (D, D); zero for held ones.

    The tree has current numbers and steps, and ``joint`` the joint covariance with these edges. What they say is
    subtracted, as it was linearised. All other edges stay linearised where they are. A SingularError where these do not
    determine the vertices, or so weakly that rounding would decide.
    """
    if not tree.vertex[vertices, its.FREE].any():
        return np.concatenate([_moved(graph, tree, v, NOTHING, tree.step) for v in vertices.tolist()]), joint(vertices)
    rows = graph.rows_by_table(edges[tree.edge[edges, its.ACTIVE] == 1])
    every = np.unique(np.concatenate([vertices, *(t.vertex_rows.values[chosen].ravel() for t, chosen in rows.items())]))
    is_free = tree.vertex[every, its.FREE] == 1
    dof = tree.vertex[every, its.DOF] * is_free
    begin, free = np.where(is_free, np.cumsum(dof) - dof, NOTHING), every[is_free]
    step = tree.step[_ranges(tree.vertex[free, its.STEP], dof[is_free])]
    information, gradient = _sums(tree, rows, every, begin, len(step))
    root, left = _roots(joint(free), information)
    # with Sigma = L L', what is left of the information is L'^-1 (1 - L' H L) L^-1
    moved = step + root @ dpotrs(left, root.T @ (gradient + information @ step), lower=True)[0]
    at = np.searchsorted(every, vertices)
    values = [_moved(graph, tree, v, first, moved) for v, first in zip(vertices.tolist(), begin[at], strict=True)]
    is_row = np.repeat(is_free[at], tree.vertex[vertices, its.DOF])
    white = np.zeros((len(root), len(is_row)))
    white[:, is_row] = dtrtrs(left, root[_ranges(begin[at], dof[at])].T, lower=True)[0]
    return np.concatenate(values), white.T @ white


def _roots(covariance: Array, information: Array) -> tuple[Array, Array]:
    """Return the roots L of the covariance, and of what is left without the information, in its units: 1 - L' H L."""
    root, failed = dpotrf(covariance, lower=True, clean=True)
    if not failed:
        left, failed = dpotrf(np.eye(len(root)) - root.T @ information @ root, lower=True, clean=True)
    if failed or not np.square(left.diagonal()).min() >= _LEAST_PIVOT:  # nor is NaN
        raise SingularError("the other edges do not determine what these edges are on")
    return root, left


def _sums(tree: Tree, rows: Mapping[EdgeTable, Index], every: Index, begin: Index, size: int) -> tuple[Array, Array]:
    """Return information (size, size) and gradient (size,), at the linearisation points, of rows of tables.

    Parameters
    ----------
    every : their vertices, in order; begin : where each begins, NOTHING for held ones
    """
    information, gradient = np.zeros((size + 1, size + 1)), np.zeros(size + 1)  # the last is for held vertices
    for table, of_table in rows.items():
        dofs, blocks = np.array(table.type.dofs), blocks_of(tree, table, of_table)
        begins = np.repeat(begin[np.searchsorted(every, table.vertex_rows.values[of_table])], dofs, axis=1)
        at = np.where(begins < 0, size, begins + _ranges(np.zeros_like(dofs), dofs))
        np.add.at(information, (at[:, :, None], at[:, None, :]), blocks[:, :, :-1])
        np.add.at(gradient, at, blocks[:, :, -1])
    return information[:size, :size], gradient[:size]


def _moved(graph: Graph, tree: Tree, vertex: int, first: int, step: Array) -> Array:
    """Return the stored values of a vertex at a step (size,) from its linearisation point; of a held one as it is."""
    kind, at = graph.kinds[graph.kind.values[vertex]], tree.vertex[vertex, its.VALUE]
    value = tree.value[at : at + kind.size]
    return value if first < 0 else kind.retract(value[None], step[None, first : first + kind.dof])[0]


def _ranges(begin: Index, count: Index) -> Index:
    """Return the numbers from each begin on, so many, end to end."""
    return np.repeat(begin - np.cumsum(count) + count, count) + np.arange(count.sum())
