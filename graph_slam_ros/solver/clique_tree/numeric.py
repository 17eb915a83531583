"""The numbers of the clique tree: assembly and elimination of its fronts, steps, and pivots that are rounding.

Kernels take the arrays out of the tree once: each access through the tuple would count references.

A pivot is x'Hx, where x moves its unknown by one and all unknowns eliminated before follow. It is what is left of a
sum over the diagonal, whose magnitude is ``sum of H_jj x_j^2``. Its rounding error is in proportion to that magnitude.
The sum goes over the whole subtree of a clique. An update does not walk all of it: where a subtree is older than the
update, its magnitude is kept as a quadratic form ``s'Ms`` over its separator. M is symmetric; it lies in ``forms``
where the separator's block lies in ``fronts``. There are no forms before the first pivot that is suspiciously small.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numba.core import types
from numba.extending import overload
from numba.np.linalg import _BLAS, ensure_blas

from graph_slam_ros.graph.vertices import SPATIAL, retract_at
from graph_slam_ros.lie.jit import inlined, inner, kernel
from graph_slam_ros.solver.clique_tree import storage as its
from graph_slam_ros.solver.clique_tree.storage import NOTHING, ZERO, Tree, front_of, packed_size, row_of, with_children
from graph_slam_ros.typing import Array, Index

LEAST_PIVOT = 1e-14  # of its diagonal entry: what elimination left of it is rounding
WIDE = 12  # pivots that are applied to the rows below by matrix products
PANEL = 48  # pivots that are applied to the rows below all of them at once: each pass over a large front takes time
FEWEST, SHORTEST = 3, 24  # pivots, and rows below them, for which that pays
STRIP = 24  # rows of one product: half of what it makes on the diagonal is not needed

dense = partial(kernel, fastmath={"reassoc", "contract", "nsz"})


def _subtract_product(front: Array, low: int, high: int, first: int, last: int) -> None:
    """Subtract the product of the pivot rows [low, high) from the rows [first, last)."""
    front[first:last, first:] -= front[low:high, first:last].T @ front[low:high, first:]


# Compiled, it is one call of BLAS in place, by the way that Numba itself takes for np.dot: that would copy the rows and
# their product.
ensure_blas()  # type: ignore[no-untyped-call]
_gemm = _BLAS().numba_xxgemm(types.float64)  # type: ignore[no-untyped-call]
_DOUBLE, _PLAIN, _TRANSPOSED = (np.int8(ord(letter)) for letter in "dnt")


@overload(_subtract_product, jit_options={"error_model": "numpy"})
def _subtract_product_in_place(front: Any, low: Any, high: Any, first: Any, last: Any) -> Callable[..., None]:
    def compiled(front: Any, low: Any, high: Any, first: Any, last: Any) -> None:
        stride = front.shape[1]
        panel, rows = front[low:, first:].ctypes, front[first:, first:].ctypes
        minus, plus = np.full(1, -1.0).ctypes, np.full(1, 1.0).ctypes
        _gemm(
            _DOUBLE, _PLAIN, _TRANSPOSED, stride - first, last - first, high - low,
            minus, panel, stride, panel, stride, plus, rows, stride,
        )  # fmt: skip

    return compiled


@dense
def partial_cholesky(front: Array, frontal: int, diagonal: Array) -> int:
    """Eliminate the first ``frontal`` rows of a symmetric matrix with right sides; returns a row without a pivot.

    ``front`` (n, n + m) holds an upper triangle and m right sides. It becomes [U11 U12 y; . C d]: the factor, its
    diagonal inverted, and what is left for the other rows. NOTHING is returned where all pivots are safely above
    rounding, which is judged by the ``diagonal`` of the whole problem. What is below the diagonal is not used.
    """
    n = front.shape[0]
    for low in range(0, frontal, PANEL):
        high = min(low + PANEL, frontal)
        tall = high - low >= FEWEST and n - high >= SHORTEST
        below = high if tall else n  # rows that get each few pivots at once
        for done in range(low, high, WIDE):
            end = min(done + WIDE, high)
            wide = end - done >= FEWEST and below - end >= SHORTEST
            failed = _eliminate_panel(front, done, end, end if wide else below, diagonal)
            if failed != NOTHING:
                return failed
            if wide:
                _subtract_strips(front, done, end, end, below)
        if tall:
            _subtract_strips(front, low, high, high, n)
    return NOTHING


@dense
def _subtract_strips(front: Array, low: int, high: int, first: int, last: int) -> None:
    """Subtract the product of the pivot rows [low, high) from the rows [first, last), strip by strip."""
    for row in range(first, last, STRIP):
        _subtract_product(front, low, high, row, min(row + STRIP, last))


@dense
def _eliminate_panel(front: Array, low: int, high: int, below: int, diagonal: Array) -> int:
    """Eliminate some rows and subtract their product from those before ``below``; return a row without a pivot."""
    for a in range(low, high, 4):
        last = min(a + 4, high)
        for p in range(a, last):
            for q in range(a, p):
                _subtract(front, p, p, q)
            if not front[p, p] > LEAST_PIVOT * diagonal[p]:
                return p
            inverse = 1.0 / np.sqrt(front[p, p])
            front[p, p] = inverse
            for j in range(p + 1, front.shape[1]):
                front[p, j] *= inverse
        if last - a == 4:
            _subtract_four(front, last, below, a)
        elif last - a == 3:
            _subtract_three(front, last, below, a)
        elif last - a == 2:
            _subtract_two(front, last, below, a)
        else:
            for i in range(last, below):
                _subtract(front, i, i, a)
    return NOTHING


@dense
def _subtract(front: Array, row: int, column: int, pivot: int) -> None:
    """Subtract a multiple of a pivot row from a row, from a column on."""
    share = front[pivot, row]
    for j in range(column, front.shape[1]):
        front[row, j] -= share * front[pivot, j]


@dense
def _subtract_four(front: Array, low: int, high: int, pivot: int) -> None:
    """Subtract multiples of four pivot rows from rows: each number is loaded and stored once for four."""
    one, two, three, four = front[pivot], front[pivot + 1], front[pivot + 2], front[pivot + 3]
    for i in range(low, high):
        row = front[i]
        a, b, c, d = one[i], two[i], three[i], four[i]
        for j in range(i, front.shape[1]):
            row[j] -= a * one[j] + b * two[j] + c * three[j] + d * four[j]


@dense
def _subtract_three(front: Array, low: int, high: int, pivot: int) -> None:
    """The same of three pivot rows, which is what a pose in the plane has."""
    one, two, three = front[pivot], front[pivot + 1], front[pivot + 2]
    for i in range(low, high):
        row = front[i]
        a, b, c = one[i], two[i], three[i]
        for j in range(i, front.shape[1]):
            row[j] -= a * one[j] + b * two[j] + c * three[j]


@dense
def _subtract_two(front: Array, low: int, high: int, pivot: int) -> None:
    """The same of two pivot rows: what is left of a pose in space."""
    one, two = front[pivot], front[pivot + 1]
    for i in range(low, high):
        row = front[i]
        a, b = one[i], two[i]
        for j in range(i, front.shape[1]):
            row[j] -= a * one[j] + b * two[j]


@kernel
def pack(front: Array, packed: Array) -> None:
    """Pack the upper triangle of a front (n, n + 1) with its right side, row after row."""
    rows = front.shape[0]
    for i in range(rows):
        at = row_of(i, rows)
        source, target = front[i, i:], packed[at + i : at + rows + 1]
        for j in range(len(source)):
            target[j] = source[j]


@dense
def solve_upper(packed: Array, rows: int, frontal: int, x: Array) -> None:
    """``x_F = U11^-1 (y - U12 x_S)``: x holds x_S behind the first ``frontal`` numbers, and gets x_F there."""
    for a in range(frontal - 1, -1, -1):
        at, count = row_of(a, rows), rows - a
        row, behind = packed[at + a : at + rows + 1], x[a:rows]
        s = row[count]
        for i in range(1, count):
            s -= row[i] * behind[i]
        x[a] = s * row[0]


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
    pivot = front_of(t.clique, t.fronts, c)[row_of(row, t.clique[c, its.FULL_DOF]) + row]  # inverted
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
    for m in range(clique[c, its.MEMBERS], clique[c, its.MEMBERS] + clique[c, its.SIZE]):
        for i in range(vertex[members[m], its.DOF]):
            x_of[vertex[members[m], its.STEP] + i] = 0.0
    while seen < count:
        k = walk[seen]
        seen += 1
        full, frontal, low = clique[k, its.FULL_DOF], clique[k, its.FRONT_DOF], clique[k, its.MEMBERS]
        if len(x) < full:
            x = np.empty(2 * full)
        at = 0
        for m in range(low, low + clique[k, its.SIZE]):
            for i in range(vertex[members[m], its.DOF]):
                x[at] = x_of[vertex[members[m], its.STEP] + i] if at >= frontal else 0.0
                at += 1
        first = frontal
        if k == c:
            first, x[row] = row, 1.0
        elif clique[k, its.MAGNITUDES] == KEPT:
            magnitude += _kept_magnitude(front_of(clique, t.forms, k), full, frontal, x)
            continue
        _follow(front_of(clique, t.fronts, k), full, first, x)
        at = 0
        for m in range(low, low + clique[k, its.FRONTALS]):
            for i in range(vertex[members[m], its.DOF]):
                d = vertex[members[m], its.STEP] + i
                x_of[d] = x[at]
                magnitude += diagonal[d] * x[at] * x[at]
                at += 1
        walk, count = with_children(clique, k, walk, count)
    t.state[its.CHECKED] += count
    t.state[its.FORMS_WANTED] = 1
    if len(t.forms) < len(t.fronts):
        return magnitude
    place = np.empty(len(t.step), np.int64)
    for i in range(count - 1, -1, -1):  # children before parents
        k = walk[i]
        if clique[k, its.MAGNITUDES] == UNKNOWN:
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
    front, form, frontal = front_of(clique, t.fronts, c), front_of(clique, t.forms, c), clique[c, its.FRONT_DOF]
    full, low = clique[c, its.FULL_DOF], clique[c, its.MEMBERS]
    own, at = np.zeros((full, full)), 0  # the same form over all of the front
    for m in range(low, low + clique[c, its.SIZE]):
        for i in range(vertex[members[m], its.DOF]):
            place[vertex[members[m], its.STEP] + i] = at
            if at < frontal:
                own[at, at] = diagonal[vertex[members[m], its.STEP] + i]
            at += 1
    child = clique[c, its.CHILD]
    while child != NOTHING:
        _add_kept(vertex, clique, members, t.forms, child, place, own)
        child = clique[child, its.SIBLING]
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
    clique[c, its.MAGNITUDES] = KEPT


@inner
def _add_kept(
    vertex: Index, clique: Index, members: Index, forms: Array, child: int, place: Index, form: Array
) -> None:
    """Add a child's stored form to one over its parent's front."""
    stored, frontal, full = front_of(clique, forms, child), clique[child, its.FRONT_DOF], clique[child, its.FULL_DOF]
    to, at = np.empty(full - frontal, np.int64), 0
    low = clique[child, its.MEMBERS]
    for m in range(low + clique[child, its.FRONTALS], low + clique[child, its.SIZE]):
        for i in range(vertex[members[m], its.DOF]):
            to[at] = place[vertex[members[m], its.STEP] + i]
            at += 1
    for i in range(at):
        row = row_of(frontal + i, full) + frontal
        form[to[i], to[i]] += stored[row + i]
        for j in range(i + 1, at):
            form[to[i], to[j]] += stored[row + j]
            form[to[j], to[i]] += stored[row + j]


CANCELLED = 1e-4  # of what is taken off a sum: less than that left has lost digits


@kernel
def eliminate(t: Tree, cliques: Index, damping: float) -> int:
    """Factor the fronts of cliques, children before parents; return a vertex whose pivot is rounding, or NOTHING.

    ``damping`` enlarges the diagonal of H by the factor 1 + damping (Marquardt).
    """
    vertex, clique, members, fronts, diagonal = t.vertex, t.clique, t.members, t.fronts, t.diagonal
    widest = 0
    for c in cliques:
        widest = max(widest, clique[c, its.FULL_DOF])
    square, scale, runs = np.empty(widest * (widest + 1)), np.empty(widest), np.empty((widest, 3), np.int64)  # shared
    failed = NOTHING
    for c in cliques:
        full, frontal = clique[c, its.FULL_DOF], clique[c, its.FRONT_DOF]
        front = square[: full * (full + 1)].reshape(full, full + 1)
        clique[c, its.MAGNITUDES] = JUST_MADE
        front[:] = 0.0
        at = 0
        for m in range(clique[c, its.MEMBERS], clique[c, its.MEMBERS] + clique[c, its.SIZE]):
            v = members[m]
            vertex[v, its.LOCAL] = at
            if at < frontal:
                for i in range(vertex[v, its.DOF]):
                    scale[at + i] = diagonal[vertex[v, its.STEP] + i]
                    front[at + i, at + i] = damping * scale[at + i]
            at += vertex[v, its.DOF]
        for m in range(clique[c, its.MEMBERS], clique[c, its.MEMBERS] + clique[c, its.FRONTALS]):
            _add_own_edges(vertex, t.edge, t.link, t.blocks, members[m], front)
        child = clique[c, its.CHILD]
        while child != NOTHING:
            _add_contribution(vertex, clique, members, fronts, child, front, runs)
            child = clique[child, its.SIBLING]
        failed = partial_cholesky(front, frontal, scale)
        pack(front, front_of(clique, fronts, c))
        if failed == NOTHING and damping == 0.0:
            failed = suspect_row(front, frontal, scale)
            if failed != NOTHING and not is_rounding(t, c, failed):
                failed = NOTHING
        if failed != NOTHING:
            failed = _member_at(vertex, clique, members, c, failed)
            break
    for c in cliques:
        clique[c, its.MAGNITUDES] = UNKNOWN
        for m in range(clique[c, its.MEMBERS], clique[c, its.MEMBERS] + clique[c, its.FRONTALS]):
            vertex[members[m], its.LOCAL] = NOTHING
    return failed


@inner
def _member_at(vertex: Index, clique: Index, members: Index, c: int, row: int) -> int:
    for m in range(clique[c, its.MEMBERS], clique[c, its.MEMBERS] + clique[c, its.FRONTALS]):
        if row < vertex[members[m], its.LOCAL] + vertex[members[m], its.DOF]:
            return members[m]
    return NOTHING


@inlined
def _add_own_edges(vertex: Index, edge: Index, link: Index, blocks: Array, v: int, front: Array) -> None:
    """Add the blocks of the edges of which v is eliminated first."""
    right = front.shape[0]
    a = vertex[v, its.LINK]
    while a != NOTHING:
        e = link[a, its.LINK_EDGE]
        a = link[a, its.LINK_NEXT]
        if edge[e, its.OWNER] != v:
            continue
        block, width, row = blocks[edge[e, its.BLOCK] :], edge[e, its.WIDTH], 0
        for s in range(edge[e, its.COUNT]):
            u = link[edge[e, its.LINKED] + s, its.LINK_END]
            dof, at = vertex[u, its.DOF], vertex[u, its.LOCAL]
            if vertex[u, its.FREE] == 1:
                for i in range(dof):
                    packed = row_of(row + i, width)
                    front[at + i, right] -= block[packed + width]
                    for j in range(i, dof):
                        front[at + i, at + j] += block[packed + row + j]
                column = row + dof
                for z in range(s + 1, edge[e, its.COUNT]):
                    w = link[edge[e, its.LINKED] + z, its.LINK_END]
                    if vertex[w, its.FREE] == 1:
                        _add_block(block, width, row, column, front, at, vertex[w, its.LOCAL], dof, vertex[w, its.DOF])
                    column += vertex[w, its.DOF]
            row += dof


@inlined
def _add_block(
    packed: Array, rows: int, row: int, column: int, front: Array, at: int, to: int, dof: int, width: int
) -> None:
    """Add the block (row, column) of two vertices in a packed front to their places (at, to) in another front."""
    if at < to:
        for i in range(dof):
            _add_run(front[at + i, to:], packed[row_of(row + i, rows) + column :], width)
    else:
        for i in range(dof):
            begin = row_of(row + i, rows) + column
            for j in range(width):
                front[to + j, at + i] += packed[begin + j]


@inlined
def _add_contribution(
    vertex: Index, clique: Index, members: Index, fronts: Array, child: int, front: Array, runs: Index
) -> None:
    """Add a child's contribution to its separator.

    Columns that follow one another in both fronts are added together. ``runs`` (widest, 3) is scratch: place in the
    front, place in the child's, and length of each such run.
    """
    of_child = front_of(clique, fronts, child)
    right, of_right = front.shape[0], clique[child, its.FULL_DOF]
    column, count = clique[child, its.FRONT_DOF], ZERO
    low = clique[child, its.MEMBERS]
    for m in range(low + clique[child, its.FRONTALS], low + clique[child, its.SIZE]):
        at, dof = vertex[members[m], its.LOCAL], vertex[members[m], its.DOF]
        if count > 0 and runs[count - 1, 0] + runs[count - 1, 2] == at:
            runs[count - 1, 2] += dof
        else:
            runs[count, 0], runs[count, 1], runs[count, 2] = at, column, dof
            count += 1
        column += dof
    for r in range(count):
        at, row, length = runs[r, 0], runs[r, 1], runs[r, 2]
        for i in range(length):
            packed = row_of(row + i, of_right)
            front[at + i, right] += of_child[packed + of_right]
            _add_run(front[at + i, at + i :], of_child[packed + row + i :], length - i)
            for z in range(r + 1, count):
                to, begin, width = runs[z, 0], packed + runs[z, 1], runs[z, 2]
                if at < to:
                    _add_run(front[at + i, to:], of_child[begin:], width)
                else:
                    for j in range(width):
                        front[to + j, at + i] += of_child[begin + j]


@inlined
def _add_run(target: Array, source: Array, width: int) -> None:
    if width == 3:  # the usual widths by themselves: a loop of known length is unrolled
        for j in range(3):
            target[j] += source[j]
    elif width == 6:
        for j in range(6):
            target[j] += source[j]
    else:
        for j in range(width):
            target[j] += source[j]


@inlined
def retract_vertex(vertex: Index, value: Array, step: Array, estimate: Array, v: int) -> None:
    """The estimate of a vertex: its linearisation point [+] its step."""
    kind, x, d, dof = vertex[v, its.KIND], vertex[v, its.VALUE], vertex[v, its.STEP], vertex[v, its.DOF]
    moved = False
    for i in range(7 if kind == SPATIAL else dof):
        estimate[x + i] = value[x + i]
    for i in range(d, d + dof):
        moved = moved or step[i] != 0.0
    if moved:
        retract_at(estimate, x, kind, dof, step, d)


@inlined
def add_to_diagonal(vertex: Index, edge: Index, link: Index, e: int, blocks: Array, diagonal: Array) -> None:
    """Add the diagonal of an edge's block to that of the information matrix."""
    at, across = edge[e, its.BLOCK], edge[e, its.WIDTH] + 1  # from one number of a diagonal to the next
    for s in range(edge[e, its.COUNT]):
        v = link[edge[e, its.LINKED] + s, its.LINK_END]
        for i in range(vertex[v, its.DOF]):
            diagonal[vertex[v, its.STEP] + i] += blocks[at]
            at += across
            across -= 1


@inlined
def clear_block(vertex: Index, edge: Index, link: Index, e: int, blocks: Array, diagonal: Array) -> None:
    """Clear an edge's block, and its part of the diagonal of H.

    If that was nearly all of the diagonal, the difference would be rounding. Then the diagonal is summed again.
    """
    begin, width = edge[e, its.BLOCK], edge[e, its.WIDTH]
    at, across, cancelled = begin, width + 1, False
    for s in range(edge[e, its.COUNT]):
        v = link[edge[e, its.LINKED] + s, its.LINK_END]
        for i in range(vertex[v, its.DOF]):
            diagonal[vertex[v, its.STEP] + i] -= blocks[at]
            cancelled = cancelled or diagonal[vertex[v, its.STEP] + i] < CANCELLED * blocks[at]
            at += across  # from one number of the block's diagonal to the next
            across -= 1
    for i in range(begin, begin + packed_size(width)):
        blocks[i] = 0.0
    if cancelled:
        for s in range(edge[e, its.COUNT]):
            _add_up_diagonal(vertex, edge, link, link[edge[e, its.LINKED] + s, its.LINK_END], blocks, diagonal)


@inner
def _add_up_diagonal(vertex: Index, edge: Index, link: Index, v: int, blocks: Array, diagonal: Array) -> None:
    own = diagonal[vertex[v, its.STEP] : vertex[v, its.STEP] + vertex[v, its.DOF]]
    own[:] = 0.0
    a = vertex[v, its.LINK]
    while a != NOTHING:
        e = link[a, its.LINK_EDGE]
        a = link[a, its.LINK_NEXT]
        row = 0
        for s in range(edge[e, its.COUNT]):
            u = link[edge[e, its.LINKED] + s, its.LINK_END]
            if u == v:
                for i in range(row, row + vertex[v, its.DOF]):
                    own[i - row] += blocks[edge[e, its.BLOCK] + row_of(i, edge[e, its.WIDTH]) + i]
            row += vertex[u, its.DOF]


@kernel
def accept_steps(t: Tree, vertices: Index) -> None:
    """Make the estimates of vertices their linearisation points."""
    vertex, step, reference, value, estimate = t.vertex, t.step, t.reference, t.value, t.estimate
    for v in vertices:
        retract_vertex(vertex, value, step, estimate, v)
        x, d, dof = vertex[v, its.VALUE], vertex[v, its.STEP], vertex[v, its.DOF]
        for i in range(dof):
            step[d + i] = reference[d + i] = 0.0
        for i in range(7 if vertex[v, its.KIND] == SPATIAL else dof):
            value[x + i] = estimate[x + i]


@kernel
def step_by(t: Tree, vertices: Index, step: Array) -> None:
    """Set the steps of vertices, and their estimates."""
    for v in vertices:
        for i in range(t.vertex[v, its.STEP], t.vertex[v, its.STEP] + t.vertex[v, its.DOF]):
            t.step[i] = step[i]
        retract_vertex(t.vertex, t.value, t.step, t.estimate, v)
