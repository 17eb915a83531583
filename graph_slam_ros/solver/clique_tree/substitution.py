"""Back-substitution: the steps of the vertices, computed when somebody asks for them.

A clique is solved from its front and the steps of its separator. An update solves the cliques that it eliminated, and
those below whose separator is far from its linearisation point. The others wait until they are read, or until a search
for large steps finds that their separator has moved much since the last one (``find_changed``). Solutions are numbered.
A clique waits if a step of its separator changed after its own solution.
"""

import numpy as np

from graph_slam_ros.graph import records
from graph_slam_ros.graph.records import integers
from graph_slam_ros.graph.vertices import PLANAR, SPATIAL
from graph_slam_ros.lie.jit import inlined, inner, kernel
from graph_slam_ros.solver.clique_tree import storage as its
from graph_slam_ros.solver.clique_tree.numeric import retract_vertex, solve_upper
from graph_slam_ros.solver.clique_tree.storage import (
    NOTHING,
    ZERO,
    Limits,
    Tree,
    front_of,
    in_order,
    kept_of,
    lengthened,
    shapes_of,
    tree_of,
    with_children,
)
from graph_slam_ros.typing import Array, Index

FEW = 8  # vertices that are read one by one; for more all that waits is solved


@kernel
def substitute(t: Tree, cliques: Index, tolerance: float, sigmas: float, far: Limits) -> Index:
    """Solve cliques (children before parents) from the root down, and those below whose separator moved far.

    Others whose separator moved wait. Returns the frontal vertices of all that were solved.

    Parameters
    ----------
    tolerance, sigmas : a step is kept if it changes by no more than so many m or rad, or standard deviations of the
        vertex given its neighbours. Then all that depends on it alone is kept, so errors do not add up
    far : a step above these is far (``is_large_step``)
    """
    vertex, clique, members = t.vertex, t.clique, t.members
    solved, count = np.empty(64, np.int64), ZERO
    stack, top = np.empty(64, np.int64), ZERO
    x = np.empty(64)
    t.state[its.SUBSTITUTED] += 1
    for c in cliques:
        clique[c, its.MARK] = 1
        if clique[c, its.PARENT] == NOTHING:
            if top == len(stack):
                stack = lengthened(stack, top)
            stack[top] = c
            top += 1
    while top:
        top -= 1
        c = stack[top]
        clique[c, its.MARK] = 0
        if len(x) < clique[c, its.FULL_DOF]:
            x = np.empty(2 * clique[c, its.FULL_DOF])
        solve_clique(t, c, x, tolerance, sigmas)
        low, frontals = clique[c, its.MEMBERS], clique[c, its.FRONTALS]
        if count + frontals > len(solved):
            solved = lengthened(solved, count + frontals)
        for m in range(low, low + frontals):
            v = members[m]
            solved[count] = v
            count += 1
            if is_large_step(t, v, False, far):
                vertex[v, its.NOTED] |= its.IS_FAR
            else:
                vertex[v, its.NOTED] &= ~its.IS_FAR
        k = clique[c, its.CHILD]
        while k != NOTHING:
            if clique[k, its.MARK] == 1 or _is_noted(vertex, clique, members, k, its.IS_FAR):
                if top == len(stack):
                    stack = lengthened(stack, top)
                stack[top] = k
                top += 1
            elif must_be_solved(vertex, clique, members, k):
                _defer(t, k)
            k = clique[k, its.SIBLING]
    return solved[:count]


@inlined
def is_large_step(t: Tree, v: int, changed: bool, above: Limits) -> bool:
    """Return whether a vertex's step is above one of the limits.

    The square of the step is what the linearisation neglects. The position of a pose counts in units of the typical
    motion: of a motion, the linearisation neglects products of a turn with what is moved, relative to it.

    Parameters
    ----------
    changed : whether the change since the last search is compared, instead of the whole step
    """
    vertex, step, diagonal, unit = t.vertex, t.step, t.diagonal, 1e-3 * t.state[its.MOTION_MM]
    first, kind = vertex[v, its.STEP], vertex[v, its.KIND]
    turns = first + (2 if kind == PLANAR else 3 if kind == SPATIAL else vertex[v, its.DOF])
    is_pose = kind in (PLANAR, SPATIAL)
    largest = turned = information = 0.0
    for i in range(first, first + vertex[v, its.DOF]):
        scale, since = unit if is_pose and i < turns else 1.0, t.reference[i] if changed else 0.0
        one = abs(step[i] - since) / scale
        largest, turned = max(largest, one), max(turned, one if i >= turns else 0.0)
        information = max(information, diagonal[i] * scale * scale)
    component, turn, square = above
    return largest > component or turned > turn or largest * largest * np.sqrt(information) > square


@inlined
def solve_clique(t: Tree, c: int, x: Array, tolerance: float, sigmas: float) -> None:
    """Solve one clique; ``x`` is scratch, as long as its degrees of freedom."""
    vertex, clique, members, step, state = t.vertex, t.clique, t.members, t.step, t.state
    diagonal, listed = t.diagonal, t.listed
    limit = sigmas * abs(sigmas)
    state[its.SOLUTIONS] += 1
    clique[c, its.SEEN] = state[its.SOLUTIONS]
    low, frontal = clique[c, its.MEMBERS], clique[c, its.FRONT_DOF]
    at = frontal
    for m in range(low + clique[c, its.FRONTALS], low + clique[c, its.SIZE]):
        first = vertex[members[m], its.STEP]
        for i in range(vertex[members[m], its.DOF]):
            x[at + i] = step[first + i]
        at += vertex[members[m], its.DOF]
    solve_upper(front_of(clique, t.fronts, c), clique[c, its.FULL_DOF], frontal, x)
    at = 0
    for m in range(low, low + clique[c, its.FRONTALS]):
        v = members[m]
        first, dof = vertex[v, its.STEP], vertex[v, its.DOF]
        change = error = 0.0
        for i in range(dof):
            d = abs(step[first + i] - x[at + i])
            change, error = max(change, d), max(error, d * d * diagonal[first + i])
        if not (change <= tolerance or error <= limit):
            for i in range(dof):
                step[first + i] = x[at + i]
            vertex[v, its.CHANGED] = state[its.SOLUTIONS]
            if vertex[v, its.NOTED] & its.IS_SHIFTED == 0:
                listed[state[its.SHIFTED_COUNT], its.SHIFTED] = v
                state[its.SHIFTED_COUNT] += 1
            if vertex[v, its.NOTED] & its.IS_STALE == 0:
                listed[state[its.STALE_COUNT], its.STALE] = v
                state[its.STALE_COUNT] += 1
            vertex[v, its.NOTED] |= its.IS_SHIFTED | its.IS_STALE
        at += dof


@inlined
def must_be_solved(vertex: Index, clique: Index, members: Index, c: int) -> bool:
    """Return whether a step of a clique's separator changed after the clique was solved."""
    seen = clique[c, its.SEEN]
    for m in range(clique[c, its.MEMBERS] + clique[c, its.FRONTALS], clique[c, its.MEMBERS] + clique[c, its.SIZE]):
        if vertex[members[m], its.CHANGED] > seen:
            return True
    return False


@inlined
def _is_noted(vertex: Index, clique: Index, members: Index, c: int, bit: int) -> bool:
    """Return whether a vertex of a clique's separator has a bit of ``NOTED``."""
    for m in range(clique[c, its.MEMBERS] + clique[c, its.FRONTALS], clique[c, its.MEMBERS] + clique[c, its.SIZE]):
        if vertex[members[m], its.NOTED] & bit:
            return True
    return False


@inlined
def _defer(t: Tree, c: int) -> None:
    """Let a clique wait."""
    if t.clique[c, its.IN_DEFERRED] == 0:
        t.clique[c, its.IN_DEFERRED] = 1
        t.listed[t.state[its.DEFERRED_COUNT], its.DEFERRED] = c
        t.state[its.DEFERRED_COUNT] += 1


@inner
def solve_deferred(t: Tree, tolerance: float, sigmas: float) -> None:
    """Solve all cliques that wait, and what is below them where it matters."""
    vertex, clique, members, listed, state = t.vertex, t.clique, t.members, t.listed, t.state
    stack, top = np.empty(64, np.int64), ZERO
    x = np.empty(64)
    for i in range(state[its.DEFERRED_COUNT] - 1, -1, -1):  # the last first: it may be above an earlier one
        stack[0], top = listed[i, its.DEFERRED], ZERO + 1
        clique[stack[0], its.IN_DEFERRED] = 0
        while top:
            top -= 1
            c = stack[top]
            if not must_be_solved(vertex, clique, members, c):
                continue
            if len(x) < clique[c, its.FULL_DOF]:
                x = np.empty(2 * clique[c, its.FULL_DOF])
            solve_clique(t, c, x, tolerance, sigmas)
            stack, top = with_children(clique, c, stack, top)
    state[its.DEFERRED_COUNT] = 0


@inner
def solve_way(t: Tree, c: int, way: Index, tolerance: float, sigmas: float) -> Index:
    """Solve what waits from the root down to a clique; ``way`` is scratch, which is returned, perhaps longer."""
    vertex, clique, members = t.vertex, t.clique, t.members
    count, first = ZERO, NOTHING
    while c != NOTHING:
        if count == len(way):
            way = lengthened(way, count)
        way[count] = c
        if must_be_solved(vertex, clique, members, c):
            first = count
        count += 1
        c = clique[c, its.PARENT]
    if first == NOTHING:
        return way
    x = np.empty(64)
    for i in range(first, -1, -1):
        c = way[i]
        if not must_be_solved(vertex, clique, members, c):
            continue
        if len(x) < clique[c, its.FULL_DOF]:
            x = np.empty(2 * clique[c, its.FULL_DOF])
        solve_clique(t, c, x, tolerance, sigmas)
        k = clique[c, its.CHILD]
        while k != NOTHING:
            if must_be_solved(vertex, clique, members, k):
                _defer(t, k)
            k = clique[k, its.SIBLING]
    return way


@inner
def solve_marked(t: Tree, marked: Index, tolerance: float, sigmas: float) -> None:
    """Solve those of marked cliques (children before parents) that wait, before they are eliminated again."""
    way = np.empty(64, np.int64)
    for k in range(len(marked) - 1, -1, -1):
        if must_be_solved(t.vertex, t.clique, t.members, marked[k]):
            way = solve_way(t, marked[k], way, tolerance, sigmas)


@kernel
def show(t: Tree, kept: Array, vertices: Index) -> None:
    """Compute the estimates of vertices from their steps, and copy them to ``kept``."""
    vertex, value, step, estimate = t.vertex, t.value, t.step, t.estimate
    for v in vertices:
        retract_vertex(vertex, value, step, estimate, v)
        x = vertex[v, its.VALUE]
        for i in range(7 if vertex[v, its.KIND] == SPATIAL else vertex[v, its.DOF]):
            kept[x + i] = estimate[x + i]


@kernel
def show_all(t: Tree, kept: Array, tolerance: float, sigmas: float) -> None:
    """Solve all that waits, and compute all estimates that have changed."""
    vertex, state = t.vertex, t.state
    if state[its.DEFERRED_COUNT]:
        solve_deferred(t, tolerance, sigmas)
    stale = t.listed[: state[its.STALE_COUNT], its.STALE]
    for v in stale:
        vertex[v, its.NOTED] &= ~its.IS_STALE
    show(t, kept, stale.copy())
    state[its.STALE_COUNT] = 0


@kernel
def read(
    graph: Index, pointers: Index, vertices: int, ids: Index, tolerance: float, sigmas: float
) -> tuple[int, Array]:
    """Return an unfit id's index or NOTHING, and stored numbers (n, size) of vertices, one at least, of one kind."""
    t, kept = tree_of(pointers), kept_of(pointers)
    vertex, estimate, kind = t.vertex, t.estimate, integers(graph[records.KIND], vertices)
    for k in range(len(ids)):
        if ids[k] < 0 or ids[k] >= vertices or kind[ids[k]] != kind[ids[0]]:
            return k, np.empty((0, 0))
    size = shapes_of(pointers)[kind[ids[0]], its.SHAPE_SIZE]
    out = np.empty((len(ids), size))
    if len(ids) > FEW:
        show_all(t, kept, tolerance, sigmas)
    elif t.state[its.STALE_COUNT] or t.state[its.DEFERRED_COUNT]:
        way = np.empty(64, np.int64)
        for v in ids:
            way = solve_way(t, vertex[v, its.CLIQUE], way, tolerance, sigmas)
            if vertex[v, its.NOTED] & its.IS_STALE:  # and stays in the list
                show(t, kept, np.full(1, v, np.int64))
    for k in range(len(ids)):
        at = vertex[ids[k], its.VALUE]
        for i in range(size):
            out[k, i] = estimate[at + i]
    return NOTHING, out


@inner
def find_changed(t: Tree, tolerance: float, sigmas: float, much: Limits) -> Index:
    """Return the vertices, in order, whose steps have changed much since they were last returned.

    A change above the limits ``much`` is much (``is_large_step``). What waits is solved where a step of its separator
    has changed much; below that, changes are no larger.
    """
    vertex, clique, members, listed, state = t.vertex, t.clique, t.members, t.listed, t.state
    step, reference = t.step, t.reference
    for k in range(state[its.SHIFTED_COUNT]):
        _note_if_much(t, listed[k, its.SHIFTED], much)
    stack, top, x = np.empty(64, np.int64), ZERO, np.empty(64)
    for k in range(state[its.DEFERRED_COUNT]):
        stack[0], top = listed[k, its.DEFERRED], ZERO + 1
        while top:
            top -= 1
            c = stack[top]
            if not must_be_solved(vertex, clique, members, c):
                continue
            if not _is_noted(vertex, clique, members, c, its.IS_MUCH):
                _defer(t, c)
                continue
            if len(x) < clique[c, its.FULL_DOF]:
                x = np.empty(2 * clique[c, its.FULL_DOF])
            solve_clique(t, c, x, tolerance, sigmas)
            for m in range(clique[c, its.MEMBERS], clique[c, its.MEMBERS] + clique[c, its.FRONTALS]):
                _note_if_much(t, members[m], much)
            stack, top = with_children(clique, c, stack, top)
    count = kept = 0
    for k in range(state[its.DEFERRED_COUNT]):
        c = listed[k, its.DEFERRED]
        if must_be_solved(vertex, clique, members, c):
            listed[kept, its.DEFERRED] = c
            kept += 1
        else:
            clique[c, its.IN_DEFERRED] = 0
    state[its.DEFERRED_COUNT], kept = kept, 0
    out = np.empty(state[its.SHIFTED_COUNT], np.int64)
    for k in range(state[its.SHIFTED_COUNT]):
        v = listed[k, its.SHIFTED]
        if vertex[v, its.NOTED] & its.IS_MUCH:
            for i in range(vertex[v, its.STEP], vertex[v, its.STEP] + vertex[v, its.DOF]):
                reference[i] = step[i]
            vertex[v, its.NOTED] &= ~(its.IS_SHIFTED | its.IS_MUCH)
            out[count] = v
            count += 1
        else:
            listed[kept, its.SHIFTED] = v
            kept += 1
    state[its.SHIFTED_COUNT] = kept
    return in_order(out[:count])


@inlined
def _note_if_much(t: Tree, v: int, much: Limits) -> None:
    """Note a vertex whose step has changed much since a search last found it."""
    if is_large_step(t, v, True, much):
        t.vertex[v, its.NOTED] |= its.IS_MUCH


@kernel
def step_all(t: Tree, cliques: Index) -> None:
    """Solve cliques (children before parents) from the root down, to the last digit; estimates are not computed."""
    x = np.empty(64)
    for c in cliques[::-1]:
        if len(x) < t.clique[c, its.FULL_DOF]:
            x = np.empty(2 * t.clique[c, its.FULL_DOF])
        solve_clique(t, c, x, -1.0, -1.0)


@kernel
def forget(t: Tree) -> None:
    """Forget all steps, and what waits: the estimates are the linearisation points."""
    t.step[:] = t.reference[:] = 0.0
    t.vertex[:, its.NOTED] = 0
    t.clique[:, its.IN_DEFERRED] = 0
    t.clique[:, its.SEEN] = t.state[its.SOLUTIONS]
    t.state[its.SHIFTED_COUNT] = t.state[its.STALE_COUNT] = t.state[its.DEFERRED_COUNT] = 0
