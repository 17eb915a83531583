"""An update of the clique tree: its structure, its numbers, and what is to be linearised anew."""

import numpy as np

from graph_slam_ros.lie.jit import inner, kernel
from graph_slam_ros.solver.clique_tree.incremental import relinearize, solve, with_those_of
from graph_slam_ros.solver.clique_tree.indices import joined
from graph_slam_ros.solver.clique_tree.ordering import ROOT, dissect, move_tail
from graph_slam_ros.solver.clique_tree.pools import compact, has_outgrown, release, room_for
from graph_slam_ros.solver.clique_tree.storage import (
    AFFECTED,
    CLIQUES,
    CLIQUES_WANTED,
    FORMS_WANTED,
    FRONTS_TOP,
    FRONTS_WANTED,
    LIVE,
    LIVE_MADE,
    MEMBERS_TOP,
    MEMBERS_WANTED,
    NOTHING,
    ZERO,
    Limits,
    Tree,
    with_room,
)
from graph_slam_ros.solver.clique_tree.substitution import show, solve_marked
from graph_slam_ros.solver.clique_tree.symbolic import build, cliques_of, collect, mark, structure
from graph_slam_ros.typing import Array, Index

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
    state[CLIQUES_WANTED] = state[CLIQUES] + cliques
    state[MEMBERS_WANTED] = state[MEMBERS_TOP] + members
    state[FRONTS_WANTED] = state[FRONTS_TOP] + numbers
    if (
        state[CLIQUES_WANTED] > len(clique)
        or state[MEMBERS_WANTED] > len(t.members)
        or state[FRONTS_WANTED] > len(t.fronts)
        or (state[FORMS_WANTED] == 1 and len(t.forms) < len(t.fronts))
    ):
        return False, new
    release(t, marked)
    state[AFFECTED] += len(order)
    cliques = build(t, order, start, later, group, last, size, orphans)
    state[LIVE_MADE] = state[LIVE_MADE] or state[LIVE]
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
    if state[FRONTS_TOP] > max(SPARSE * state[LIVE], state[LIVE] + SPARE):
        compact(tree)
        return tree
    tree = with_room(
        tree,
        clique=state[CLIQUES_WANTED],
        listed=state[CLIQUES_WANTED],
        members=state[MEMBERS_WANTED],
        fronts=state[FRONTS_WANTED] + (STRETCH if state[FRONTS_WANTED] > len(tree.fronts) else 0),
    )
    return with_room(tree, forms=len(tree.fronts)) if state[FORMS_WANTED] else tree
