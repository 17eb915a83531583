"""An update of the clique tree: cliques that a change touches, those that replace them, their numbers, and steps."""

import numpy as np

from graph_slam_ros.lie.jit import inlined, inner, kernel
from graph_slam_ros.solver.clique_tree import storage as its
from graph_slam_ros.solver.clique_tree.numeric import accept_steps, clear_block, eliminate
from graph_slam_ros.solver.clique_tree.ordering import ROOT, dissect, ends_of, key_of, move_tail, neighbourhood
from graph_slam_ros.solver.clique_tree.storage import (
    NOTHING,
    ZERO,
    Limits,
    Tree,
    allocate,
    ascending,
    chosen,
    compact,
    has_outgrown,
    in_order,
    joined,
    lengthened,
    release,
    room_for,
    tree_of,
    with_room,
)
from graph_slam_ros.solver.clique_tree.substitution import find_changed, is_large_step, show, solve_marked, substitute
from graph_slam_ros.typing import Array, Index

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
        c = vertex[v, its.CLIQUE]
        begin[ways] = count
        while c != NOTHING and clique[c, its.MARK] == 0:
            clique[c, its.MARK] = 1
            if count == len(found):
                found = lengthened(found, count)
            found[count] = c
            count += 1
            c = clique[c, its.PARENT]
        ways += 1
    begin[ways] = count
    out = np.empty(count, np.int64)
    at = 0
    for w in range(ways - 1, -1, -1):  # each way ends below an earlier one
        for k in range(begin[w], begin[w + 1]):
            out[at] = found[k]
            clique[found[k], its.MARK] = 0
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
        clique[c, its.MARK] = 1
    for c in marked:
        count += clique[c, its.FRONTALS]
        k = clique[c, its.CHILD]
        while k != NOTHING:
            children += 1 - clique[k, its.MARK]
            k = clique[k, its.SIBLING]
    affected, orphans = np.empty(count, np.int64), np.empty(children, np.int64)
    count = children = 0
    for v in new:
        if vertex[v, its.FREE] == 1:
            affected[count] = v
            count += 1
    for c in marked:
        for m in range(clique[c, its.MEMBERS], clique[c, its.MEMBERS] + clique[c, its.FRONTALS]):
            if vertex[members[m], its.FREE] == 1:
                affected[count] = members[m]
                count += 1
        k = clique[c, its.CHILD]
        while k != NOTHING:
            if clique[k, its.MARK] == 0:
                orphans[children] = k
                children += 1
            k = clique[k, its.SIBLING]
    for c in marked:
        clique[c, its.MARK] = 0
    key = np.empty(count, np.int64)
    for k in range(count):
        key[k] = vertex[affected[k], its.KEY]
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
        vertex[order[k], its.LOCAL] = k
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
        vertex[v, its.LOCAL] = NOTHING
    return start, later


@inner
def _link_by_first(t: Tree, orphans: Index, n: int, orphan_of: Index, orphan_next: Index) -> None:
    """Link the orphans to lists by the vertex of their separator that is eliminated first."""
    vertex, clique, members = t.vertex, t.clique, t.members
    for i in range(len(orphans)):
        c = orphans[i]
        first = n
        for m in range(clique[c, its.MEMBERS] + clique[c, its.FRONTALS], clique[c, its.MEMBERS] + clique[c, its.SIZE]):
            first = min(first, vertex[members[m], its.LOCAL])
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
    a = vertex[v, its.LINK]
    while a != NOTHING:
        e = link[a, its.LINK_EDGE]
        a = link[a, its.LINK_NEXT]
        if edge[e, its.ACTIVE] == 0:
            continue
        first = True
        for s in range(edge[e, its.COUNT]):
            w = link[edge[e, its.LINKED] + s, its.LINK_END]
            u = vertex[w, its.LOCAL]
            first = first and not (u < k and vertex[w, its.FREE] == 1)
            top = _note_later(u, k, seen, later, top)
        if first:
            edge[e, its.OWNER] = v
    return top


@inlined
def _joined_by_orphan(t: Tree, c: int, k: int, seen: Index, later: Index, top: int) -> int:
    """Note the vertices that an orphan's separator connects."""
    vertex, clique, members = t.vertex, t.clique, t.members
    for m in range(clique[c, its.MEMBERS] + clique[c, its.FRONTALS], clique[c, its.MEMBERS] + clique[c, its.SIZE]):
        top = _note_later(vertex[members[m], its.LOCAL], k, seen, later, top)
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
        dof = vertex[order[k], its.DOF]
        width = 0
        for m in range(start[k], start[k + 1]):
            width += vertex[order[later[m]], its.DOF]
        if width > 0:
            parent = later[start[k]]
            c = clique[parent]
            same = (vertex[order[k], its.REGION] == NOTHING) == (vertex[order[parent], its.REGION] == NOTHING)
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
        clique[c, its.FRONTALS] = frontals[j]
        clique[c, its.SIZE] = frontals[j] + start[k + 1] - start[k]
        clique[c, its.FULL_DOF] = size[j]
        clique[c, its.FRONT_DOF] = 0
        clique[c, its.SEEN] = its.NEVER
        clique[c, its.PARENT] = clique[c, its.CHILD] = clique[c, its.SIBLING] = NOTHING
        fill[j] = clique[c, its.MEMBERS]
        separator = fill[j] + frontals[j]
        for m in range(start[k], start[k + 1]):
            members[separator] = order[later[m]]
            separator += 1
    for k in range(n):
        j, v = group[k], order[k]
        members[fill[j]] = v
        fill[j] += 1
        vertex[v, its.CLIQUE] = new[j]
        clique[new[j], its.FRONT_DOF] += vertex[v, its.DOF]
    for j in range(count):
        k = last[j]
        if start[k + 1] > start[k]:
            _hang(t, new[j], new[group[later[start[k]]]])
    for c in orphans:
        parent = ZERO + NOTHING
        key = np.iinfo(np.int64).max
        for m in range(clique[c, its.MEMBERS] + clique[c, its.FRONTALS], clique[c, its.MEMBERS] + clique[c, its.SIZE]):
            if vertex[members[m], its.KEY] < key:
                key = vertex[members[m], its.KEY]
                parent = vertex[members[m], its.CLIQUE]
        _hang(t, c, parent)
    for j in range(count):
        upwards[j] = new[count - 1 - j]
    return upwards


@inlined
def _hang(t: Tree, c: int, parent: int) -> None:
    clique = t.clique
    clique[c, its.PARENT] = parent
    clique[c, its.SIBLING] = clique[parent, its.CHILD]
    clique[parent, its.CHILD] = c


MUCH = 0.2  # of the threshold above which a vertex is linearised anew: changes below are not followed for that


@kernel
def enter(t: Tree, vertices: Index, edges: Index) -> None:
    """Make vertices the newest unknowns, and put edges into the structure; their blocks are not computed yet."""
    vertex, tail, state = t.vertex, t.tail, t.state
    state[its.ENTERED] += 1
    for v in vertices:
        vertex[v, its.FREE] = 1
        vertex[v, its.REGION] = vertex[v, its.NEXT] = vertex[v, its.CLIQUE] = NOTHING
        vertex[v, its.KEY] = key_of(-1, 0, v)
        if state[its.TAIL_END] == len(tail):  # what is before the first is not needed any more
            first, kept = state[its.TAIL_FIRST], state[its.TAIL_END] - state[its.TAIL_FIRST]
            for k in range(kept):
                tail[k] = tail[first + k]
            state[its.TAIL_FIRST], state[its.TAIL_END] = 0, kept
        tail[state[its.TAIL_END]] = v
        state[its.TAIL_END] += 1
    for e in edges:
        t.edge[e, its.ACTIVE] = 1


@kernel
def leave(t: Tree, vertices: Index, edges: Index) -> Index:
    """Remove vertices and edges again; return the vertices whose cliques must be rebuilt."""
    deactivate(t, edges)
    touched = neighbourhood(t, vertices)
    for v in vertices:
        t.vertex[v, its.FREE] = 0
    return touched


@kernel
def deactivate(t: Tree, edges: Index) -> None:
    """Remove edges from the structure and from the diagonal of H."""
    vertex, edge, link, blocks, diagonal = t.vertex, t.edge, t.link, t.blocks, t.diagonal
    for e in edges:
        edge[e, its.ACTIVE], edge[e, its.OWNER] = 0, NOTHING
        clear_block(vertex, edge, link, e, blocks, diagonal)


@kernel
def reset(t: Tree, unknowns: Index) -> None:
    """Forget order and cliques, and the scratch of a failed call: all unknowns are new."""
    vertex, region, state = t.vertex, t.region, t.state
    vertex[:, its.LOCAL] = NOTHING
    t.edge[:, its.MARKED] = 0
    state[its.CLIQUES] = state[its.MEMBERS_TOP] = state[its.FRONTS_TOP] = state[its.LIVE] = state[its.LIVE_MADE] = 0
    state[its.FREE_CLIQUE] = NOTHING
    state[its.REGIONS], state[its.FREE_REGION] = 1, NOTHING
    region[0, :] = NOTHING
    region[0, its.R_DEPTH] = region[0, its.R_COUNT] = region[0, its.R_MADE] = 0
    t.vacant[:] = NOTHING
    t.clique[:, its.IN_DEFERRED] = state[its.DEFERRED_COUNT] = 0
    state[its.TAIL_FIRST] = state[its.TAIL_END] = 0
    vertex[:, its.CLIQUE] = NOTHING
    vertex[:, its.REGION] = NOTHING
    enter(t, unknowns, unknowns[:0])


@kernel
def edges_of(vertex: Index, link: Index, v: int) -> Index:
    """All edges on a vertex, also those that are not in the structure, in order."""
    out, count = np.empty(16, np.int64), ZERO
    a = vertex[v, its.LINK]
    while a != NOTHING:
        if count == len(out):
            out = lengthened(out, count)
        out[count] = link[a, its.LINK_EDGE]
        count += 1
        a = link[a, its.LINK_NEXT]
    return in_order(out[:count])


@kernel
def solve(t: Tree, cliques: Index, tolerance: float, sigmas: float, far: Limits) -> tuple[int, Index]:
    """Compute the numbers of cliques, children before parents, and the steps that matter (``substitute``).

    Returns a vertex that has no pivot, or NOTHING, and the vertices that were solved.
    """
    clique, state = t.clique, t.state
    for c in cliques:
        state[its.FLOPS] += clique[c, its.FULL_DOF] ** 2 * clique[c, its.FRONT_DOF]
    failed = eliminate(t, cliques, 0.0)
    if failed != NOTHING:
        return failed, cliques[:0].copy()
    return failed, substitute(t, cliques, tolerance, sigmas, far)


@inner
def with_those_of(t: Tree, cliques: Index, edges: Index) -> Index:
    """Return new cliques, and before them those whose numbers depend on edges, children before parents."""
    clique = t.clique
    for c in cliques:
        clique[c, its.MARK] = 1
    more = mark(t, ends_of(t, edges))
    for c in cliques:
        clique[c, its.MARK] = 0
    return joined(more, cliques)


@kernel
def renumber(t: Tree, edges: Index, tolerance: float, sigmas: float, far: Limits) -> tuple[int, Index]:
    """Solve after a change of the edges' numbers alone."""
    return solve(t, mark(t, ends_of(t, edges)), tolerance, sigmas, far)


@kernel
def relinearize(t: Tree, searched: Index, above: Limits) -> Index:
    """Move the linearisation points of those vertices whose step is too large; return all edges on them.

    A step is too large above one of the limits (``is_large_step``).
    """
    vertex, edge, link = t.vertex, t.edge, t.link
    large = False
    for v in searched:
        large = large or is_large_step(t, v, False, above)
    if not large:  # as nearly always
        return np.empty(0, np.int64)
    edges, moving = np.empty(64, np.int64), np.empty(len(searched), np.int64)
    count, many = ZERO, 0
    for v in searched:
        if not is_large_step(t, v, False, above):
            continue
        moving[many] = v
        many += 1
        a = vertex[v, its.LINK]
        while a != NOTHING:
            e = link[a, its.LINK_EDGE]
            a = link[a, its.LINK_NEXT]
            if edge[e, its.ACTIVE] == 1 and edge[e, its.MARKED] == 0:
                edge[e, its.MARKED] = 1
                if count == len(edges):
                    edges = lengthened(edges, count)
                edges[count] = e
                count += 1
    for e in edges[:count]:
        edge[e, its.MARKED] = 0
    accept_steps(t, moving[:many])
    return in_order(edges[:count])


@kernel
def relinearize_changed(pointers: Index, tolerance: float, sigmas: float, above: Limits) -> Index:
    """Search all vertices that have moved much since the last time, and relinearise: return the edges."""
    t = tree_of(pointers)
    component, turn, square = above
    much = find_changed(t, tolerance, sigmas, (MUCH * component, MUCH * turn, MUCH * MUCH * square))
    return relinearize(t, much, above)


@kernel
def reach_back(t: Tree, edges: Index) -> bool:
    """Return whether one of the edges reaches a vertex that has left the tail: it closes a loop."""
    back = False
    for v in ends_of(t, edges):
        back = back or t.vertex[v, its.REGION] != NOTHING
    return back


SPARSE = 1.2  # of the memory of fronts, as a multiple of those in use: then it is compacted, not lengthened
SPARE = 1 << 16  # numbers of fronts for which that does not pay
STRETCH = 1 << 13  # numbers of fronts by which it is lengthened at least
DONE, ROOM, DISSECT = range(3)  # how ``advance_tree`` ends


@kernel
def regroup(t: Tree, touched: Index, new: Index, tolerance: float, sigmas: float) -> tuple[bool, Index]:
    """Apply changes of the structure to the tree: eliminate what they touch again, and group it into cliques.

    Parameters
    ----------
    touched : vertices whose surroundings changed; new : vertices that are not in it yet
    tolerance, sigmas : of the steps that are computed first, as the fronts go (``substitute``)

    Returns
    -------
    Whether there was room, and then the new cliques; otherwise nothing was changed, and ``state`` says how long the
    pools must be.
    """
    clique, state = t.clique, t.state
    marked = mark(t, touched)
    solve_marked(t, marked, tolerance, sigmas)
    order, orphans = collect(t, marked, new)
    start, later = structure(t, order, orphans)
    group, last, size = cliques_of(t, order, start, later)
    cliques, members, numbers = room_for(t, size, marked)
    state[its.CLIQUES_WANTED] = state[its.CLIQUES] + cliques
    state[its.MEMBERS_WANTED] = state[its.MEMBERS_TOP] + members
    state[its.FRONTS_WANTED] = state[its.FRONTS_TOP] + numbers
    if (
        state[its.CLIQUES_WANTED] > len(clique)
        or state[its.MEMBERS_WANTED] > len(t.members)
        or state[its.FRONTS_WANTED] > len(t.fronts)
        or (state[its.FORMS_WANTED] == 1 and len(t.forms) < len(t.fronts))
    ):
        return False, new
    release(t, marked)
    state[its.AFFECTED] += len(order)
    cliques = build(t, order, start, later, group, last, size, orphans)
    state[its.LIVE_MADE] = state[its.LIVE_MADE] or state[its.LIVE]
    return True, cliques


def restructure(tree: Tree, edges: Index, touched: Index, new: Index, tolerance: float, sigmas: float) -> Tree:
    """Return the tree after changes of the structure; its new cliques have no numbers.

    Arguments are those of ``advance_tree``.
    """
    tail = True
    while True:
        overgrown = NOTHING
        if tail:
            touched, overgrown = move_tail(tree, edges, touched)
            tail = False
        if overgrown != NOTHING:
            touched = np.concatenate((touched, dissect(tree, overgrown)))
        done, _ = regroup(tree, touched, new, tolerance, sigmas)
        if not done:
            tree = more_room(tree)
        elif has_outgrown(tree):
            touched, new = dissect(tree, ROOT), new[:0]
        else:
            return tree


@inner
def advance_tree(
    t: Tree,
    kept: Array,
    edges: Index,
    touched: Index,
    new: Index,
    tail: bool,
    again: Index,
    unseen: Index,
    tolerance: float,
    sigmas: float,
    far: Limits,
) -> tuple[int, int, int, Index]:
    """Apply changes of the structure to the tree, solve, and relinearise what is far (``substitute``).

    If nothing is far, the estimates of what was solved are computed and kept.

    Parameters
    ----------
    edges : that are new or have changed; touched : other vertices whose surroundings changed
    new : vertices that are not in the tree yet
    tail : whether its older part may move down
    again : edges that were linearised again; unseen : more vertices to search for far steps

    Returns
    -------
    * DONE; a vertex that has no pivot, or NOTHING; how many vertices were solved; if there are edges to linearise at
      once: these vertices, then those edges.
    * ROOM or DISSECT, where the pools are too small, or a region is to be dissected, before it is called again; the
      region; 0; the touched vertices.
    """
    if tail:
        touched, overgrown = move_tail(t, edges, touched)
        if overgrown != NOTHING:
            return DISSECT, overgrown, ZERO, touched
    done, cliques = regroup(t, touched, new, tolerance, sigmas)
    if not done:
        return ROOM, ZERO + NOTHING, ZERO, touched
    if len(again):
        cliques = with_those_of(t, cliques, again)
    failed, solved = solve(t, cliques, tolerance, sigmas, far)
    if failed != NOTHING:
        return DONE, failed, ZERO, solved
    found = relinearize(t, joined(solved, unseen) if len(unseen) else solved, far)
    if len(found):
        return DONE, failed, len(solved), joined(solved, found)
    show(t, kept, solved)
    return DONE, failed, len(solved), found


def more_room(tree: Tree) -> Tree:
    """Return the tree with room for what ``advance_tree`` could not place: compacted, or with longer pools."""
    state = tree.state
    if state[its.FRONTS_TOP] > max(SPARSE * state[its.LIVE], state[its.LIVE] + SPARE):
        compact(tree)
        return tree
    tree = with_room(
        tree,
        clique=state[its.CLIQUES_WANTED],
        listed=state[its.CLIQUES_WANTED],
        members=state[its.MEMBERS_WANTED],
        fronts=state[its.FRONTS_WANTED] + (STRETCH if state[its.FRONTS_WANTED] > len(tree.fronts) else 0),
    )
    return with_room(tree, forms=len(tree.fronts)) if state[its.FORMS_WANTED] else tree
