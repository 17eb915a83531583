"""The numbers of the clique tree: assembly and elimination, steps.

Kernels take the arrays out of the tree once: each access through the tuple would count references.
"""

import numpy as np

from graph_slam_ros.graph.retraction import SPATIAL, retract_at
from graph_slam_ros.lie.jit import inlined, inner, kernel
from graph_slam_ros.solver.clique_tree.dense import pack, partial_cholesky
from graph_slam_ros.solver.clique_tree.rounding import JUST_MADE, UNKNOWN, is_rounding, suspect_row
from graph_slam_ros.solver.clique_tree.storage import (
    BLOCK,
    CHILD,
    COUNT,
    DOF,
    FREE,
    FRONT_DOF,
    FRONTALS,
    FULL_DOF,
    KIND,
    LINK,
    LINK_EDGE,
    LINK_END,
    LINK_NEXT,
    LINKED,
    LOCAL,
    MAGNITUDES,
    MEMBERS,
    NOTHING,
    OWNER,
    SIBLING,
    SIZE,
    STEP,
    VALUE,
    WIDTH,
    ZERO,
    Tree,
    front_of,
    packed_size,
    row_of,
)
from graph_slam_ros.typing import Array, Index

CANCELLED = 1e-4  # of what is taken off a sum: less than that left has lost digits


@kernel
def eliminate(t: Tree, cliques: Index, damping: float) -> int:
    """Factor the fronts of cliques, children before parents; return a vertex whose pivot is rounding, or NOTHING.

    ``damping`` enlarges the diagonal of H by the factor 1 + damping (Marquardt).
    """
    vertex, clique, members, fronts, diagonal = t.vertex, t.clique, t.members, t.fronts, t.diagonal
    widest = 0
    for c in cliques:
        widest = max(widest, clique[c, FULL_DOF])
    square, scale, runs = np.empty(widest * (widest + 1)), np.empty(widest), np.empty((widest, 3), np.int64)  # shared
    failed = NOTHING
    for c in cliques:
        full, frontal = clique[c, FULL_DOF], clique[c, FRONT_DOF]
        front = square[: full * (full + 1)].reshape(full, full + 1)
        clique[c, MAGNITUDES] = JUST_MADE
        front[:] = 0.0
        at = 0
        for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, SIZE]):
            v = members[m]
            vertex[v, LOCAL] = at
            if at < frontal:
                for i in range(vertex[v, DOF]):
                    scale[at + i] = diagonal[vertex[v, STEP] + i]
                    front[at + i, at + i] = damping * scale[at + i]
            at += vertex[v, DOF]
        for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, FRONTALS]):
            _add_own_edges(vertex, t.edge, t.link, t.blocks, members[m], front)
        child = clique[c, CHILD]
        while child != NOTHING:
            _add_contribution(vertex, clique, members, fronts, child, front, runs)
            child = clique[child, SIBLING]
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
        clique[c, MAGNITUDES] = UNKNOWN
        for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, FRONTALS]):
            vertex[members[m], LOCAL] = NOTHING
    return failed


@inner
def _member_at(vertex: Index, clique: Index, members: Index, c: int, row: int) -> int:
    for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, FRONTALS]):
        if row < vertex[members[m], LOCAL] + vertex[members[m], DOF]:
            return members[m]
    return NOTHING


@inlined
def _add_own_edges(vertex: Index, edge: Index, link: Index, blocks: Array, v: int, front: Array) -> None:
    """Add the blocks of the edges of which v is eliminated first."""
    right = front.shape[0]
    a = vertex[v, LINK]
    while a != NOTHING:
        e = link[a, LINK_EDGE]
        a = link[a, LINK_NEXT]
        if edge[e, OWNER] != v:
            continue
        block, width, row = blocks[edge[e, BLOCK] :], edge[e, WIDTH], 0
        for s in range(edge[e, COUNT]):
            u = link[edge[e, LINKED] + s, LINK_END]
            dof, at = vertex[u, DOF], vertex[u, LOCAL]
            if vertex[u, FREE] == 1:
                for i in range(dof):
                    packed = row_of(row + i, width)
                    front[at + i, right] -= block[packed + width]
                    for j in range(i, dof):
                        front[at + i, at + j] += block[packed + row + j]
                column = row + dof
                for z in range(s + 1, edge[e, COUNT]):
                    w = link[edge[e, LINKED] + z, LINK_END]
                    if vertex[w, FREE] == 1:
                        _add_block(block, width, row, column, front, at, vertex[w, LOCAL], dof, vertex[w, DOF])
                    column += vertex[w, DOF]
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
    right, of_right = front.shape[0], clique[child, FULL_DOF]
    column, count = clique[child, FRONT_DOF], ZERO
    for m in range(clique[child, MEMBERS] + clique[child, FRONTALS], clique[child, MEMBERS] + clique[child, SIZE]):
        at, dof = vertex[members[m], LOCAL], vertex[members[m], DOF]
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
    kind, x, d, dof = vertex[v, KIND], vertex[v, VALUE], vertex[v, STEP], vertex[v, DOF]
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
    at, across = edge[e, BLOCK], edge[e, WIDTH] + 1  # from one number of a diagonal to the next
    for s in range(edge[e, COUNT]):
        v = link[edge[e, LINKED] + s, LINK_END]
        for i in range(vertex[v, DOF]):
            diagonal[vertex[v, STEP] + i] += blocks[at]
            at += across
            across -= 1


@inlined
def clear_block(vertex: Index, edge: Index, link: Index, e: int, blocks: Array, diagonal: Array) -> None:
    """Clear an edge's block, and its part of the diagonal of H.

    If that was nearly all of the diagonal, the difference would be rounding. Then the diagonal is summed again.
    """
    begin, width = edge[e, BLOCK], edge[e, WIDTH]
    at, across, cancelled = begin, width + 1, False
    for s in range(edge[e, COUNT]):
        v = link[edge[e, LINKED] + s, LINK_END]
        for i in range(vertex[v, DOF]):
            diagonal[vertex[v, STEP] + i] -= blocks[at]
            cancelled = cancelled or diagonal[vertex[v, STEP] + i] < CANCELLED * blocks[at]
            at += across  # from one number of the block's diagonal to the next
            across -= 1
    for i in range(begin, begin + packed_size(width)):
        blocks[i] = 0.0
    if cancelled:
        for s in range(edge[e, COUNT]):
            _add_up_diagonal(vertex, edge, link, link[edge[e, LINKED] + s, LINK_END], blocks, diagonal)


@inner
def _add_up_diagonal(vertex: Index, edge: Index, link: Index, v: int, blocks: Array, diagonal: Array) -> None:
    own = diagonal[vertex[v, STEP] : vertex[v, STEP] + vertex[v, DOF]]
    own[:] = 0.0
    a = vertex[v, LINK]
    while a != NOTHING:
        e = link[a, LINK_EDGE]
        a = link[a, LINK_NEXT]
        row = 0
        for s in range(edge[e, COUNT]):
            u = link[edge[e, LINKED] + s, LINK_END]
            if u == v:
                for i in range(row, row + vertex[v, DOF]):
                    own[i - row] += blocks[edge[e, BLOCK] + row_of(i, edge[e, WIDTH]) + i]
            row += vertex[u, DOF]


@kernel
def accept_steps(t: Tree, vertices: Index) -> None:
    """Make the estimates of vertices their linearisation points."""
    vertex, step, reference, value, estimate = t.vertex, t.step, t.reference, t.value, t.estimate
    for v in vertices:
        retract_vertex(vertex, value, step, estimate, v)
        x, d, dof = vertex[v, VALUE], vertex[v, STEP], vertex[v, DOF]
        for i in range(dof):
            step[d + i] = reference[d + i] = 0.0
        for i in range(7 if vertex[v, KIND] == SPATIAL else dof):
            value[x + i] = estimate[x + i]


@kernel
def step_by(t: Tree, vertices: Index, step: Array) -> None:
    """Set the steps of vertices, and their estimates."""
    for v in vertices:
        for i in range(t.vertex[v, STEP], t.vertex[v, STEP] + t.vertex[v, DOF]):
            t.step[i] = step[i]
        retract_vertex(t.vertex, t.value, t.step, t.estimate, v)


@kernel
def gradient(t: Tree, edges: Index) -> Array:
    """J'r over the unknowns, numbered as ``step``."""
    vertex, edge, link, blocks = t.vertex, t.edge, t.link, t.blocks
    out = np.zeros(len(t.step))
    for e in edges:
        width = edge[e, WIDTH]
        at, across = edge[e, BLOCK] + width, width  # from one number of the last column to the next
        for s in range(edge[e, COUNT]):
            v = link[edge[e, LINKED] + s, LINK_END]
            for i in range(vertex[v, DOF]):
                if vertex[v, FREE] == 1:
                    out[vertex[v, STEP] + i] += blocks[at]
                at += across
                across -= 1
    return out


@kernel
def curvature(t: Tree, edges: Index, d: Array) -> float:
    """``d' J'J d`` for a direction over the unknowns, numbered as ``step``."""
    vertex, edge, link, blocks = t.vertex, t.edge, t.link, t.blocks
    mine = np.empty(64)
    out = 0.0
    for e in edges:
        width = edge[e, WIDTH]
        if width > len(mine):
            mine = np.empty(width)
        k = 0
        for s in range(edge[e, COUNT]):
            v = link[edge[e, LINKED] + s, LINK_END]
            for i in range(vertex[v, DOF]):
                mine[k] = d[vertex[v, STEP] + i] if vertex[v, FREE] == 1 else 0.0
                k += 1
        at = edge[e, BLOCK]
        for i in range(width):
            out += mine[i] * blocks[at] * mine[i]
            for j in range(i + 1, width):
                out += 2.0 * mine[i] * blocks[at + j - i] * mine[j]
            at += width + 1 - i
    return out
