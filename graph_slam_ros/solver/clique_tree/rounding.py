"""Pivots that cannot be told from rounding.

A pivot is x'Hx, where x moves its unknown by one and all unknowns eliminated before follow. It is what is left of a
sum over the diagonal, whose magnitude is ``sum of H_jj x_j^2``. Its rounding error is in proportion to that magnitude.

The sum goes over the whole subtree of a clique. An update does not walk all of it: where a subtree is older than the
update, its magnitude is kept as a quadratic form ``s'Ms`` over its separator. M is symmetric; it lies in ``forms``
where the separator's block lies in ``fronts``. There are no forms before the first pivot that is suspiciously small.
"""

import numpy as np

from graph_slam_ros.lie.jit import inner, kernel
from graph_slam_ros.solver.clique_tree.storage import (
    CHECKED,
    CHILD,
    DOF,
    FORMS_WANTED,
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
    row_of,
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
    pivot = front_of(t.clique, t.fronts, c)[row_of(row, t.clique[c, FULL_DOF]) + row]  # inverted
    return 1.0 / pivot**2 <= ROUNDING * magnitude_of(t, c, row)


@kernel
def magnitude_of(t: Tree, c: int, row: int) -> float:
    """Return the magnitude ``sum of H_jj x_j^2`` of what cancelled in the pivot of a row.

    Subtrees older than this elimination store their forms afterwards, and are not walked again.
    """
    vertex, clique, members, diagonal = t.vertex, t.clique, t.members, t.diagonal
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
        first = frontal
        if k == c:
            first, x[row] = row, 1.0
        elif clique[k, MAGNITUDES] == KEPT:
            magnitude += _kept_magnitude(front_of(clique, t.forms, k), full, frontal, x)
            continue
        _follow(front_of(clique, t.fronts, k), full, first, x)
        at = 0
        for m in range(low, low + clique[k, FRONTALS]):
            for i in range(vertex[members[m], DOF]):
                d = vertex[members[m], STEP] + i
                x_of[d] = x[at]
                magnitude += diagonal[d] * x[at] * x[at]
                at += 1
        walk, count = with_children(clique, k, walk, count)
    t.state[CHECKED] += count
    t.state[FORMS_WANTED] = 1
    if len(t.forms) < len(t.fronts):
        return magnitude
    place = np.empty(len(t.step), np.int64)
    for i in range(count - 1, -1, -1):  # children before parents
        k = walk[i]
        if clique[k, MAGNITUDES] == UNKNOWN:
            _keep_magnitudes(t, k, place)
    return magnitude


@kernel
def _follow(front: Array, rows: int, first: int, x: Array) -> None:
    """Move the unknowns of the rows before ``first`` to where they have no residual, given those behind them."""
    for a in range(first - 1, -1, -1):
        s, row = 0.0, row_of(a, rows)
        for i in range(a + 1, rows):
            s -= front[row + i] * x[i]
        x[a] = s * front[row + a]


@inner
def _kept_magnitude(form: Array, rows: int, frontal: int, x: Array) -> float:
    """Return ``s'Ms`` of a clique that stores it: the upper triangle of M, where the separator is in the front."""
    total = 0.0
    for i in range(frontal, rows):
        row = row_of(i, rows)
        s = 0.5 * form[row + i] * x[i]
        for j in range(i + 1, rows):
            s += form[row + j] * x[j]
        total += 2.0 * s * x[i]
    return total


@inner
def _keep_magnitudes(t: Tree, c: int, place: Index) -> None:
    """Store M of a clique, whose children store theirs, among the forms; ``place`` is scratch, by unknown."""
    vertex, clique, members, diagonal = t.vertex, t.clique, t.members, t.diagonal
    front, form, frontal = front_of(clique, t.fronts, c), front_of(clique, t.forms, c), clique[c, FRONT_DOF]
    full, low = clique[c, FULL_DOF], clique[c, MEMBERS]
    own, at = np.zeros((full, full)), 0  # the same form over all of the front
    for m in range(low, low + clique[c, SIZE]):
        for i in range(vertex[members[m], DOF]):
            place[vertex[members[m], STEP] + i] = at
            if at < frontal:
                own[at, at] = diagonal[vertex[members[m], STEP] + i]
            at += 1
    child = clique[c, CHILD]
    while child != NOTHING:
        _add_kept(vertex, clique, members, t.forms, child, place, own)
        child = clique[child, SIBLING]
    separator = full - frontal
    moves = np.zeros((separator, full))
    for i in range(separator):  # how the frontals follow a unit of the separator
        moves[i, frontal + i] = 1.0
        _follow(front, full, frontal, moves[i])
    for i in range(separator):
        pulled = own[frontal + i].copy()
        for a in range(frontal):
            for j in range(full):
                pulled[j] += moves[i, a] * own[a, j]
        row = row_of(frontal + i, full) + frontal
        for j in range(i, separator):
            s = pulled[frontal + j]
            for a in range(frontal):
                s += pulled[a] * moves[j, a]
            form[row + j] = s
    clique[c, MAGNITUDES] = KEPT


@inner
def _add_kept(
    vertex: Index, clique: Index, members: Index, forms: Array, child: int, place: Index, form: Array
) -> None:
    """Add a child's stored form to one over its parent's front."""
    stored, frontal, full = front_of(clique, forms, child), clique[child, FRONT_DOF], clique[child, FULL_DOF]
    to, at = np.empty(full - frontal, np.int64), 0
    for m in range(clique[child, MEMBERS] + clique[child, FRONTALS], clique[child, MEMBERS] + clique[child, SIZE]):
        for i in range(vertex[members[m], DOF]):
            to[at] = place[vertex[members[m], STEP] + i]
            at += 1
    for i in range(at):
        row = row_of(frontal + i, full) + frontal
        form[to[i], to[i]] += stored[row + i]
        for j in range(i + 1, at):
            form[to[i], to[j]] += stored[row + j]
            form[to[j], to[i]] += stored[row + j]
