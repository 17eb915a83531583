"""The numbers of the clique tree: assembly, partial Cholesky, back-substitution, covariances."""

import numba
import numpy as np

from graph_slam_ros.lie import se2, se3
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.tree import (
    ACTIVE,
    BLOCK,
    CHILD,
    CLIQUE,
    COUNT,
    DOF,
    END,
    FREE,
    FRONT,
    FRONT_DOF,
    FRONTALS,
    FULL_DOF,
    KEY,
    KIND,
    LINK,
    LINK_EDGE,
    LINK_NEXT,
    LOCAL,
    MARK,
    MEMBERS,
    NOTHING,
    PARENT,
    ROWS,
    SE2_KIND,
    SE3_KIND,
    SIBLING,
    SIZE,
    STEP,
    VALUE,
    Array,
    Index,
    Tree,
)

LEAST_PIVOT = 1e-14  # of its diagonal entry: what elimination left of it is rounding


@kernel
def eliminate(t: Tree, cliques: Index, damping: float) -> int:
    """Factor the fronts of cliques, children before parents; returns a vertex without a positive pivot, or NOTHING.

    ``damping`` enlarges the diagonal of H by the factor 1 + damping (Marquardt).
    """
    diagonal = np.empty(0)
    failed = NOTHING
    for c in cliques:
        front, gradient = front_of(t, c)
        full, frontal = t.clique[c, FULL_DOF], t.clique[c, FRONT_DOF]
        if len(diagonal) < frontal:
            diagonal = np.empty(2 * frontal)
        front[:] = 0.0
        gradient[:] = 0.0
        _number(t, c)
        _add_edges(t, c, front, gradient, diagonal)
        for i in range(frontal):
            front[i, i] += damping * diagonal[i]
        child = t.clique[c, CHILD]
        while child != NOTHING:
            _add_contribution(t, child, front, gradient)
            child = t.clique[child, SIBLING]
        failed = _factor(front, gradient, frontal, diagonal)
        if failed != NOTHING:
            failed = _member_at(t, c, failed)
            break
    for c in cliques:
        for m in range(t.clique[c, MEMBERS], t.clique[c, MEMBERS] + t.clique[c, FRONTALS]):
            t.vertex[t.members[m], LOCAL] = NOTHING
    return failed


@kernel
def front_of(t: Tree, c: int) -> tuple[Array, Array]:
    """The front (full, full), of which the lower triangle counts, and its vector (full,)."""
    full, base = t.clique[c, FULL_DOF], t.clique[c, FRONT]
    return t.fronts[base : base + full * full].reshape(full, full), t.fronts[base + full * full : base + full * (full + 1)]


@kernel
def _number(t: Tree, c: int) -> None:
    """Where each member begins in the front."""
    at = 0
    for m in range(t.clique[c, MEMBERS], t.clique[c, MEMBERS] + t.clique[c, SIZE]):
        t.vertex[t.members[m], LOCAL] = at
        at += t.vertex[t.members[m], DOF]


@kernel
def _member_at(t: Tree, c: int, row: int) -> int:
    at = 0
    for m in range(t.clique[c, MEMBERS], t.clique[c, MEMBERS] + t.clique[c, SIZE]):
        at += t.vertex[t.members[m], DOF]
        if row < at:
            return t.members[m]
    return NOTHING


@kernel
def _add_edges(t: Tree, c: int, front: Array, gradient: Array, diagonal: Array) -> None:
    """Add J'J and -J'r of the edges whose first eliminated vertex is frontal here; the diagonal of H of all edges."""
    at = 0
    for m in range(t.clique[c, MEMBERS], t.clique[c, MEMBERS] + t.clique[c, FRONTALS]):
        v = t.members[m]
        dof = t.vertex[v, DOF]
        for i in range(at, at + dof):
            diagonal[i] = 0.0
        a = t.vertex[v, LINK]
        while a != NOTHING:
            e = t.link[a, LINK_EDGE]
            a = t.link[a, LINK_NEXT]
            if t.edge[e, ACTIVE] == 0:
                continue
            first = True
            width = before = 0
            for s in range(t.edge[e, COUNT]):
                u = t.edge[e, END + s]
                if u == v:
                    before = width
                elif t.vertex[u, FREE] == 1 and t.vertex[u, KEY] < t.vertex[v, KEY]:
                    first = False
                width += t.vertex[u, DOF]
            rows, block = t.edge[e, ROWS], t.edge[e, BLOCK]
            for i in range(dof):
                for r in range(rows):
                    diagonal[at + i] += t.blocks[block + r * width + before + i] ** 2
            if first:
                _add_edge(t, e, width, front, gradient)
        at += dof


@kernel
def _add_edge(t: Tree, e: int, width: int, front: Array, gradient: Array) -> None:
    rows, block = t.edge[e, ROWS], t.edge[e, BLOCK]
    residual = block + rows * width
    p = 0
    for s in range(t.edge[e, COUNT]):
        u = t.edge[e, END + s]
        if t.vertex[u, FREE] == 1:
            at = t.vertex[u, LOCAL]
            for i in range(t.vertex[u, DOF]):
                total = 0.0
                for r in range(rows):
                    total += t.blocks[block + r * width + p + i] * t.blocks[residual + r]
                gradient[at + i] -= total
            q = 0
            for z in range(t.edge[e, COUNT]):
                w = t.edge[e, END + z]
                if t.vertex[w, FREE] == 1 and t.vertex[w, LOCAL] <= at:
                    for i in range(t.vertex[u, DOF]):
                        for j in range(t.vertex[w, DOF]):
                            total = 0.0
                            for r in range(rows):
                                total += t.blocks[block + r * width + p + i] * t.blocks[block + r * width + q + j]
                            front[at + i, t.vertex[w, LOCAL] + j] += total
                q += t.vertex[w, DOF]
        p += t.vertex[u, DOF]


@kernel
def _add_contribution(t: Tree, child: int, front: Array, gradient: Array) -> None:
    """Add what a child's subtree says of its separator."""
    of_child, y = front_of(t, child)
    low = t.clique[child, MEMBERS] + t.clique[child, FRONTALS]
    high = t.clique[child, MEMBERS] + t.clique[child, SIZE]
    row = t.clique[child, FRONT_DOF]
    for m in range(low, high):
        at, dof = t.vertex[t.members[m], LOCAL], t.vertex[t.members[m], DOF]
        for i in range(dof):
            gradient[at + i] += y[row + i]
        column = t.clique[child, FRONT_DOF]
        for k in range(low, m):
            to, width = t.vertex[t.members[k], LOCAL], t.vertex[t.members[k], DOF]
            if to < at:
                for i in range(dof):
                    for j in range(width):
                        front[at + i, to + j] += of_child[row + i, column + j]
            else:
                for i in range(dof):
                    for j in range(width):
                        front[to + j, at + i] += of_child[row + i, column + j]
            column += width
        for i in range(dof):
            for j in range(i + 1):
                front[at + i, at + j] += of_child[row + i, row + j]
        row += dof


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _factor(front, y, frontal, diagonal):  # type: ignore[no-untyped-def]
    """Partial Cholesky of the first ``frontal`` columns, in place; returns a row without a positive pivot, or NOTHING.

    Rows are built one after the other from dot products of rows, which lie in memory as they are read.
    """
    full = front.shape[0]
    for i in range(full):
        top = min(i, frontal)
        for a in range(top):
            s = front[i, a]
            for z in range(a):
                s -= front[i, z] * front[a, z]
            front[i, a] = s * front[a, a]
        if i < frontal:
            s = front[i, i]
            for z in range(i):
                s -= front[i, z] * front[i, z]
            if not s > LEAST_PIVOT * diagonal[i]:
                return i
            front[i, i] = 1.0 / np.sqrt(s)
        s = y[i]
        for z in range(top):
            s -= front[i, z] * y[z]
        y[i] = s * front[i, i] if i < frontal else s
    for i in range(frontal, full):
        for k in range(frontal, i + 1):
            s = front[i, k]
            for z in range(frontal):
                s -= front[i, z] * front[k, z]
            front[i, k] = s
    return NOTHING


@kernel
def back_substitute(t: Tree, cliques: Index, tolerance: float) -> Index:
    """Steps from the root down, through the given cliques (children before parents) and below where they matter.

    A step that changes by no more than the tolerance is left as it was, and so is what depends on it alone; so errors
    do not add up. Returns the vertices whose step has changed; their estimates follow.
    """
    moved = np.empty(64, np.int64)
    count = 0
    x = np.empty(64)
    for c in cliques:
        t.clique[c, MARK] = 1
    stack = [int(c) for c in cliques if t.clique[c, PARENT] == NOTHING]
    while len(stack):
        c = stack.pop()
        to_solve = t.clique[c, MARK] == 1
        t.clique[c, MARK] = 0
        full, frontal = t.clique[c, FULL_DOF], t.clique[c, FRONT_DOF]
        if len(x) < full:
            x = np.empty(2 * full)
        low = t.clique[c, MEMBERS]
        at = frontal
        for m in range(low + t.clique[c, FRONTALS], low + t.clique[c, SIZE]):
            v = t.members[m]
            to_solve = to_solve or t.vertex[v, LOCAL] == MOVED
            for i in range(t.vertex[v, DOF]):
                x[at] = t.step[t.vertex[v, STEP] + i]
                at += 1
        if not to_solve:
            continue
        front, y = front_of(t, c)
        for a in range(frontal - 1, -1, -1):
            s = y[a]
            for i in range(a + 1, full):
                s -= front[i, a] * x[i]
            x[a] = s * front[a, a]
        at = 0
        for m in range(low, low + t.clique[c, FRONTALS]):
            v = t.members[m]
            step = t.step[t.vertex[v, STEP] : t.vertex[v, STEP] + t.vertex[v, DOF]]
            change = 0.0
            for i in range(len(step)):
                change = max(change, abs(step[i] - x[at + i]))
            if not change <= tolerance:
                for i in range(len(step)):
                    step[i] = x[at + i]
                t.vertex[v, LOCAL] = MOVED
                if count == len(moved):
                    moved = np.concatenate((moved, np.empty(count, np.int64)))
                moved[count] = v
                count += 1
                retract(t, v)
            at += len(step)
        k = t.clique[c, CHILD]
        while k != NOTHING:
            stack.append(k)
            k = t.clique[k, SIBLING]
    for c in cliques:
        t.clique[c, MARK] = 0
    for v in moved[:count]:
        t.vertex[v, LOCAL] = NOTHING
    return moved[:count]


MOVED = -2


@kernel
def retract(t: Tree, v: int) -> None:
    """The estimate of a vertex: its linearisation point [+] its step."""
    kind, x, d = t.vertex[v, KIND], t.vertex[v, VALUE], t.vertex[v, STEP]
    value, step = t.value, t.step
    if kind == SE2_KIND:
        pose = se2.retract((value[x], value[x + 1], value[x + 2]), (step[d], step[d + 1], step[d + 2]))
        for i in range(3):
            t.estimate[x + i] = pose[i]
    elif kind == SE3_KIND:
        p = (value[x], value[x + 1], value[x + 2], value[x + 3], value[x + 4], value[x + 5], value[x + 6])
        q = se3.retract(p, (step[d], step[d + 1], step[d + 2], step[d + 3], step[d + 4], step[d + 5]))
        for i in range(7):
            t.estimate[x + i] = q[i]
    else:
        for i in range(t.vertex[v, DOF]):
            t.estimate[x + i] = value[x + i] + step[d + i]


@kernel
def marginal(t: Tree, v: int) -> Array:
    """Covariance (dof, dof) of a vertex: from the root down to its clique, each clique's own given its parent's."""
    path = [t.vertex[v, CLIQUE]]
    while t.clique[path[len(path) - 1], PARENT] != NOTHING:
        path.append(t.clique[path[len(path) - 1], PARENT])
    above = np.zeros((0, 0))
    for p in range(len(path) - 1, -1, -1):
        c = path[p]
        full, frontal = t.clique[c, FULL_DOF], t.clique[c, FRONT_DOF]
        front, _ = front_of(t, c)
        covariance = np.zeros((full, full))
        # the separator's, picked from the parent's
        row = frontal
        low, high = t.clique[c, MEMBERS] + t.clique[c, FRONTALS], t.clique[c, MEMBERS] + t.clique[c, SIZE]
        for m in range(low, high):
            column = frontal
            for k in range(low, high):
                for i in range(t.vertex[t.members[m], DOF]):
                    for j in range(t.vertex[t.members[k], DOF]):
                        a, b = t.vertex[t.members[m], LOCAL] + i, t.vertex[t.members[k], LOCAL] + j
                        covariance[row + i, column + j] = above[a, b]
                column += t.vertex[t.members[k], DOF]
            row += t.vertex[t.members[m], DOF]
        # L11' X = [I / L11, 0] - L21' Sigma, column after column from the last
        for j in range(full - 1, -1, -1):
            for a in range(min(frontal - 1, j), -1, -1):
                s = front[a, a] if a == j else 0.0
                for i in range(a + 1, full):
                    s -= front[i, a] * covariance[i, j]
                covariance[a, j] = covariance[j, a] = s * front[a, a]
        _number(t, c)
        above = covariance
    at = t.vertex[v, LOCAL]
    for c in path:
        for m in range(t.clique[c, MEMBERS], t.clique[c, MEMBERS] + t.clique[c, SIZE]):
            t.vertex[t.members[m], LOCAL] = NOTHING
    return above[at : at + t.vertex[v, DOF], at : at + t.vertex[v, DOF]].copy()
