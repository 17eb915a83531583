"""Pivots that cannot be told from rounding.

A pivot is x'Hx, where x moves its unknown by one and all unknowns eliminated before follow. It is what is left of a
sum over the diagonal, whose magnitude is ``sum of H_jj x_j^2``. Its rounding error is in proportion to that magnitude.

The sum goes over the whole subtree of a clique. An update does not walk all of it: where a subtree is older than the
update, its magnitude is kept as a quadratic form ``s'Ms`` over its separator. M is symmetric; it lies in the clique's
front below the diagonal, which is not used otherwise.
"""

import numpy as np

from graph_slam_ros.lie.jit import inner, kernel
from graph_slam_ros.solver.clique_tree.storage import (
    CHECKED,
    CHILD,
    DOF,
    FRONT_DOF,
    FRONTALS,
    FULL_DOF,
    MAGNITUDES,
    MEMBERS,
    NOTHING,
    SIBLING,
    SIZE,
    STEP,
    ZERO,
    Tree,
    front_of,
    with_children,
)
from graph_slam_ros.typing import Array, Index

SUSPECT = 1e-9  # of its diagonal entry: a pivot below is looked into
ROUNDING = 2.0**-52  # of the magnitudes that cancelled: a pivot below cannot be told from rounding

JUST_MADE, UNKNOWN, KEPT = range(3)  # the magnitudes of a clique's subtree


@inner
def suspect_row(front: Array, frontal: int, diagonal: Array) -> int:
    """The row of the least pivot, as a part of its diagonal entry, if it is suspiciously small, or NOTHING."""
    found, least = NOTHING, 1.0 / SUSPECT
    for a in range(frontal):
        if front[a, a] * front[a, a] * diagonal[a] > least:  # inverted, and its root
            found, least = a, front[a, a] * front[a, a] * diagonal[a]
    return found


@inner
def is_rounding(t: Tree, c: int, row: int) -> bool:
    """Return whether the pivot in a row of a clique's front may be rounding alone."""
    front = front_of(t.clique, t.fronts, c)
    return 1.0 / front[row, row] ** 2 <= ROUNDING * magnitude_of(t, c, row)


@kernel
def magnitude_of(t: Tree, c: int, row: int) -> float:
    """Return the magnitude ``sum of H_jj x_j^2`` of what cancelled in the pivot of a row.

    Subtrees older than this elimination store their forms afterwards, and are not walked again.
    """
    vertex, clique, members, fronts, diagonal = t.vertex, t.clique, t.members, t.fronts, t.diagonal
    x_of, x = np.empty(len(t.step)), np.empty(256)  # by unknown; of one front
    walk, seen, count, magnitude = np.empty(256, np.int64), 0, ZERO + 1, 0.0
    walk[0] = c
    for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, SIZE]):
        for i in range(vertex[members[m], DOF]):
            x_of[vertex[members[m], STEP] + i] = 0.0
    while seen < count:
        k = walk[seen]
        seen += 1
        full, frontal, low = clique[k, FULL_DOF], clique[k, FRONT_DOF], clique[k, MEMBERS]
        if len(x) < full:
            x = np.empty(2 * full)
        at = 0
        for m in range(low, low + clique[k, SIZE]):
            for i in range(vertex[members[m], DOF]):
                x[at] = x_of[vertex[members[m], STEP] + i] if at >= frontal else 0.0
                at += 1
        front, first = front_of(clique, fronts, k), frontal
        if k == c:
            first, x[row] = row, 1.0
        elif clique[k, MAGNITUDES] == KEPT:
            magnitude += _kept_magnitude(front, frontal, x)
            continue
        _follow(front, first, x)
        at = 0
        for m in range(low, low + clique[k, FRONTALS]):
            for i in range(vertex[members[m], DOF]):
                d = vertex[members[m], STEP] + i
                x_of[d] = x[at]
                magnitude += diagonal[d] * x[at] * x[at]
                at += 1
        walk, count = with_children(clique, k, walk, count)
    t.state[CHECKED] += count
    place = np.empty(len(t.step), np.int64)
    for i in range(count - 1, -1, -1):  # children before parents
        k = walk[i]
        if clique[k, MAGNITUDES] == UNKNOWN:
            _keep_magnitudes(vertex, clique, members, fronts, diagonal, k, place)
    return magnitude


@kernel
def _follow(front: Array, first: int, x: Array) -> None:
    """Move the unknowns of the rows before ``first`` to where they have no residual, given those behind them."""
    for a in range(first - 1, -1, -1):
        s = 0.0
        for i in range(a + 1, front.shape[0]):
            s -= front[a, i] * x[i]
        x[a] = s * front[a, a]


@inner
def _kept_magnitude(front: Array, frontal: int, x: Array) -> float:
    """Return ``s'Ms`` of a clique that stores it: M below the diagonal of the separator's block, its diagonal first."""
    total = 0.0
    for i in range(frontal, front.shape[0]):
        s = 0.5 * front[i, 0] * x[i]
        for j in range(frontal, i):
            s += front[i, j] * x[j]
        total += 2.0 * s * x[i]
    return total


@inner
def _keep_magnitudes(
    vertex: Index, clique: Index, members: Index, fronts: Array, diagonal: Array, c: int, place: Index
) -> None:
    """Store M of a clique, whose children store theirs, in its front; ``place`` is scratch, by unknown."""
    front, frontal = front_of(clique, fronts, c), clique[c, FRONT_DOF]
    full, low = front.shape[0], clique[c, MEMBERS]
    own, at = np.zeros((full, full)), 0  # the same form over all of the front
    for m in range(low, low + clique[c, SIZE]):
        for i in range(vertex[members[m], DOF]):
            place[vertex[members[m], STEP] + i] = at
            if at < frontal:
                own[at, at] = diagonal[vertex[members[m], STEP] + i]
            at += 1
    child = clique[c, CHILD]
    while child != NOTHING:
        _add_kept(vertex, clique, members, fronts, child, place, own)
        child = clique[child, SIBLING]
    separator = full - frontal
    moves = np.zeros((separator, full))
    for i in range(separator):  # how the frontals follow a unit of the separator
        moves[i, frontal + i] = 1.0
        _follow(front, frontal, moves[i])
    for i in range(separator):
        pulled = own[frontal + i].copy()
        for a in range(frontal):
            for j in range(full):
                pulled[j] += moves[i, a] * own[a, j]
        for j in range(i + 1):
            s = pulled[frontal + j]
            for a in range(frontal):
                s += pulled[a] * moves[j, a]
            front[frontal + i, frontal + j if j < i else 0] = s
    clique[c, MAGNITUDES] = KEPT


@inner
def _add_kept(
    vertex: Index, clique: Index, members: Index, fronts: Array, child: int, place: Index, form: Array
) -> None:
    """Add a child's stored form to one over its parent's front."""
    front, frontal = front_of(clique, fronts, child), clique[child, FRONT_DOF]
    to, at = np.empty(front.shape[0] - frontal, np.int64), 0
    for m in range(clique[child, MEMBERS] + clique[child, FRONTALS], clique[child, MEMBERS] + clique[child, SIZE]):
        for i in range(vertex[members[m], DOF]):
            to[at] = place[vertex[members[m], STEP] + i]
            at += 1
    for i in range(at):
        form[to[i], to[i]] += front[frontal + i, 0]
        for j in range(i):
            form[to[i], to[j]] += front[frontal + i, frontal + j]
            form[to[j], to[i]] += front[frontal + i, frontal + j]
