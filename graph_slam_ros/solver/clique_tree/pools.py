"""Memory pools of cliques, their members and their fronts, by size class.

The place of a clique that leaves is reused by the next one of its class. It is then still in the processor's cache.
"""

import numpy as np

from graph_slam_ros.lie.jit import inlined, inner, jitable, kernel
from graph_slam_ros.solver.clique_tree.indices import ascending
from graph_slam_ros.solver.clique_tree.storage import (
    CAPACITIES,
    CLASS,
    CLIQUE,
    CLIQUES,
    FREE_CLIQUE,
    FRONT,
    FRONTALS,
    FRONTS_TOP,
    LIVE,
    LIVE_MADE,
    MARK,
    MEMBERS,
    MEMBERS_TOP,
    NOTHING,
    SIBLING,
    SIZE,
    Tree,
    packed_size,
)
from graph_slam_ros.typing import Index

GROWTH = 2.0  # the factor by which a part of the tree grows until it is dissected anew


@inlined
def capacity_class(size: int) -> int:
    """The least size class that has room for so many degrees of freedom."""
    low, high = 0, len(CAPACITIES)
    while low < high:
        middle = (low + high) // 2
        if CAPACITIES[middle] < size:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def numbers_of(size_class: int) -> int:
    """The numbers of a front."""
    return packed_size(CAPACITIES[size_class])


@inner
def room_for(t: Tree, size: Index, leaving: Index) -> tuple[int, int, int]:
    """Return how much new cliques of these sizes add to the pools: cliques, members, numbers of fronts.

    They first reuse the places of cliques that leave, and vacant ones.
    """
    clique, vacant = t.clique, t.vacant
    wanted = np.zeros(len(CAPACITIES), np.int64)
    for s in size:
        wanted[capacity_class(s)] += 1
    for c in leaving:
        wanted[clique[c, CLASS]] -= 1
    count = members = numbers = 0
    for k in range(len(CAPACITIES)):
        c = vacant[k]
        while c != NOTHING and wanted[k] > 0:
            wanted[k] -= 1
            c = clique[c, SIBLING]
        more = max(wanted[k], 0)
        count += more
        members += more * CAPACITIES[k]
        numbers += more * numbers_of(k)
    return count, members, numbers


@kernel
def release(t: Tree, cliques: Index) -> None:
    """Release cliques: the next ones of the same size class reuse their places."""
    vertex, clique, vacant, members = t.vertex, t.clique, t.vacant, t.members
    for c in cliques:
        for m in range(clique[c, MEMBERS], clique[c, MEMBERS] + clique[c, FRONTALS]):
            if vertex[members[m], CLIQUE] == c:  # it is no unknown any more
                vertex[members[m], CLIQUE] = NOTHING
        k = clique[c, CLASS]
        clique[c, SIBLING] = vacant[k]
        vacant[k] = c
        t.state[LIVE] -= numbers_of(k)
        clique[c, SIZE] = clique[c, FRONTALS] = 0  # it may be in the list of those that wait still


@inlined
def allocate(t: Tree, size: int) -> int:
    """Allocate the place of a clique of that many degrees of freedom."""
    clique, vacant, state = t.clique, t.vacant, t.state
    k = capacity_class(size)
    c = vacant[k]
    state[LIVE] += numbers_of(k)
    if c != NOTHING:
        vacant[k] = clique[c, SIBLING]
        return c
    c = state[FREE_CLIQUE]
    if c != NOTHING:
        state[FREE_CLIQUE] = clique[c, SIBLING]
    else:
        c = state[CLIQUES]
        state[CLIQUES] += 1
    clique[c, CLASS] = k
    clique[c, MARK] = 0
    clique[c, MEMBERS] = state[MEMBERS_TOP]
    clique[c, FRONT] = state[FRONTS_TOP]
    state[MEMBERS_TOP] += CAPACITIES[k]
    state[FRONTS_TOP] += numbers_of(k)
    return c


@jitable
def has_outgrown(t: Tree) -> bool:
    """Return whether all fronts together have grown so much that the whole tree is to be dissected anew."""
    return bool(t.state[LIVE] > GROWTH * t.state[LIVE_MADE] > 0)


@kernel
def compact(t: Tree) -> None:
    """Move all cliques together in memory; vacant ones keep none."""
    clique, vacant, members, fronts, forms, state = t.clique, t.vacant, t.members, t.fronts, t.forms, t.state
    live = np.ones(state[CLIQUES], np.bool_)
    c = state[FREE_CLIQUE]
    while c != NOTHING:
        live[c] = False
        c = clique[c, SIBLING]
    for k in range(len(vacant)):
        while vacant[k] != NOTHING:
            c = vacant[k]
            vacant[k] = clique[c, SIBLING]
            live[c] = False
            clique[c, SIBLING] = state[FREE_CLIQUE]
            state[FREE_CLIQUE] = c
    begin = np.empty(state[CLIQUES], np.int64)
    for c in range(len(begin)):
        begin[c] = clique[c, FRONT]
    member = front = 0
    for c in ascending(begin):  # each goes down, so none is written over before it has moved
        if live[c]:
            k = clique[c, CLASS]
            for i in range(CAPACITIES[k]):
                members[member + i] = members[clique[c, MEMBERS] + i]
            for i in range(numbers_of(k)):
                fronts[front + i] = fronts[clique[c, FRONT] + i]
            if clique[c, FRONT] + numbers_of(k) <= len(forms):
                for i in range(numbers_of(k)):
                    forms[front + i] = forms[clique[c, FRONT] + i]
            clique[c, MEMBERS], clique[c, FRONT] = member, front
            member += CAPACITIES[k]
            front += numbers_of(k)
    state[MEMBERS_TOP], state[FRONTS_TOP] = member, front
