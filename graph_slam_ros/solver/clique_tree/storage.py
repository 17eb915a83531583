"""The clique tree (Bayes tree): the records of vertices, edges, cliques and regions, in flat arrays.

Eliminating the information matrix H vertex after vertex leaves cliques: *frontal* vertices that were eliminated
together, given a *separator* of later ones, which the parent clique contains. Each clique keeps one dense front::

    [ U11  U12 | y ]   U11: the factor of the frontal variables, its diagonal inverted; U12: on the separator
    [  .    C  | d ]   C, d: what the whole subtree says of the separator, the contribution to the parent

What is below the diagonal is not stored: a front is packed, row after row, each from its diagonal on.

Because contributions are kept, an update touches only the cliques of changed edges and their ancestors (Kaess et al.,
"iSAM2: incremental smoothing and mapping using the Bayes tree", IJRR 2012).

Records are columns of integer arrays, so that compiled code reaches everything through one tuple. Other modules call
their numbers ``its``: ``vertex[v, its.STEP]``.
"""

import math
from sys import getrefcount, version_info
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.graph.records import address_of, integers, reals, table
from graph_slam_ros.lie.jit import inlined, inner, jitable, kernel
from graph_slam_ros.typing import Array, Index

NOTHING = -1
NEVER = 1 << 62  # later than any solution
NONE = np.empty(0, dtype=np.int64)  # no vertices, no edges
ZERO: Any = np.int64(0)  # no literal: a kernel that is called with one is compiled for it alone

# vertex: degrees of freedom; begin in ``step`` and in ``value``; kind (below); key: the order of elimination;
# the clique it is frontal in; first link to its edges; its region and the next vertex there; 1 where it is an unknown;
# scratch, NOTHING between uses; the solution (``substitution``) that last changed its step; in which lists it is
DOF, STEP, VALUE, KIND, KEY, CLIQUE, LINK, REGION, NEXT, FREE, LOCAL, CHANGED, NOTED, VERTEX_COLUMNS = range(14)
# bits of NOTED; the last two: its step is far from the linearisation point; has changed much since the last search
IS_SHIFTED, IS_STALE, IS_FAR, IS_MUCH = 1, 2, 4, 8

# edge: how many vertices, 0 where it is not known yet; its first link, the others follow, one for each vertex in the
# order of its slots; degrees of freedom of the vertices; where its block begins; 1 where it is in the structure; which
# of its vertices is eliminated first; scratch
COUNT, LINKED, WIDTH, BLOCK, ACTIVE, OWNER, MARKED, EDGE_COLUMNS = range(8)

# link: an edge, one of its vertices, and that vertex's next link
LINK_EDGE, LINK_END, LINK_NEXT, LINK_COLUMNS = range(4)

# clique: its place in the tree; where its members begin, how many are frontal, how many there are; the same in
# degrees of freedom
PARENT, CHILD, SIBLING, MEMBERS, FRONTALS, SIZE, FRONT_DOF, FULL_DOF = range(8)
# where its front begins; its size class; 1 where an update has marked it; whether the magnitudes of its subtree are
# known (``numeric``); the number of its last solution (``substitution``); 1 where it is listed
FRONT, CLASS, MARK, MAGNITUDES, SEEN, IN_DEFERRED, CLIQUE_COLUMNS = range(8, 15)

# list: vertices whose step has changed since all were searched for large ones; whose estimate is not computed yet;
# cliques that may have to be solved. ``state`` has how many there are
SHIFTED, STALE, DEFERRED, LIST_COLUMNS = range(4)

# region of the nested dissection: its place in the binary tree; vertices in its subtree, now and when it was made;
# the first vertex of its own
R_PARENT, R_DEPTH, R_LEFT, R_RIGHT, R_COUNT, R_MADE, R_FIRST, REGION_COLUMNS = range(8)

# state: tops of the pools; what is free to be used again, and in use now and when all was dissected last
LINKS, CLIQUES, MEMBERS_TOP, FRONTS_TOP, REGIONS, BLOCKS_TOP, FREE_REGION, FREE_CLIQUE, LIVE, LIVE_MADE = range(10)
# the tail; what decides how long it is kept
TAIL_FIRST, TAIL_END, TAIL_KEPT, RESTRUCTURED, FLOPS, FLOPS_SEEN, RESTRUCTURED_SEEN, FLOPS_USUAL = range(10, 18)
# how long the pools must be
CLIQUES_WANTED, MEMBERS_WANTED, FRONTS_WANTED, FORMS_WANTED = range(18, 22)
# what is counted, and the typical length of a motion
AFFECTED, CHECKED, SOLUTIONS, SUBSTITUTED, ENTERED, SHIFTED_COUNT, STALE_COUNT, DEFERRED_COUNT = range(22, 30)
MOTION_MM, STATE_COLUMNS = range(30, 32)

Limits = tuple[float, float, float]
"""Limits of a step: of any component [m, rad], of the turn of a pose [rad], and of the square of the largest component.

The last is in standard deviations of the strongest measurement.
"""

TAIL_LEAST = 8  # newest vertices that stay in the tail in any case
RECENT = 32  # closures that are looked at
FAR = 1 << 40  # vertices: further than any closure reaches

_REFERENCES = 3  # to an array that is about to grow: its owner's, an argument, and another
_LEAST = 16384  # bytes by which an array grows
_UNCOUNTED = (3, 14)  # from then on references may be borrowed, so that a count says nothing of views

_STEPS = np.array([4, 5, 6, 7])
CAPACITIES = np.concatenate([[1, 2, 3], *(_STEPS * 2**k for k in range(13))]).astype(np.int64)


class Tree(NamedTuple):
    """All of it; every pool may be longer than what is used.

    Attributes
    ----------
    members : vertices of the cliques, frontal ones first in order of elimination; fronts : their fronts
    forms : quadratic forms of separators (``numeric``), each at the place of its front; empty until one is needed
    blocks : of each edge, packed as a front: its share of the information matrix, J'J, and of the gradient, J'r
    diagonal : of the information matrix, all edges together
    step : of each unknown, from its linearisation point ``value``; ``estimate`` is ``value [+] step``
    reference : the step when a search for large ones last found the vertex
    listed : lists of vertices and cliques, a column each
    tail : the newest vertices, eliminated last and in order of time
    reach : how far back the recent closures reached, in vertices
    vacant : by size class, the first of the cliques that may be used again
    """

    vertex: Index
    edge: Index
    link: Index
    clique: Index
    region: Index
    members: Index
    tail: Index
    reach: Index
    vacant: Index
    state: Index
    listed: Index
    fronts: Array
    forms: Array
    blocks: Array
    diagonal: Array
    step: Array
    reference: Array
    value: Array
    estimate: Array


@inner
def front_of(clique: Index, fronts: Array, c: int) -> Array:
    """The packed front of a clique: an upper triangle, and the right side as its last column."""
    return fronts[clique[c, FRONT] : clique[c, FRONT] + packed_size(clique[c, FULL_DOF])]


@jitable
def packed_size(rows: int) -> int:
    """Return the count of numbers in a packed front of so many rows."""
    return rows * (rows + 3) // 2


@jitable
def row_of(row: int, rows: int) -> int:
    """Return the offset of a row in a packed front: entry (row, column), column >= row, is at this offset + column."""
    return row * (2 * rows + 1 - row) // 2


@inner
def with_children(clique: Index, c: int, cliques: Index, count: int) -> tuple[Index, int]:
    """Append the children of a clique to the first ``count`` of a list; returns it, perhaps longer, and the count."""
    k = clique[c, CHILD]
    while k != NOTHING:
        if count == len(cliques):
            cliques = lengthened(cliques, count)
        cliques[count] = k
        count += 1
        k = clique[k, SIBLING]
    return cliques, count


def empty_tree() -> Tree:
    """A tree without a vertex."""
    region = np.full((16, REGION_COLUMNS), NOTHING, dtype=np.int64)
    region[0] = [NOTHING, 0, NOTHING, NOTHING, 0, 0, NOTHING]
    state = np.zeros(STATE_COLUMNS, dtype=np.int64)
    state[REGIONS], state[FREE_REGION], state[TAIL_KEPT], state[FREE_CLIQUE] = 1, NOTHING, TAIL_LEAST, NOTHING
    state[MOTION_MM] = 1000
    return Tree(
        vertex=np.zeros((0, VERTEX_COLUMNS), dtype=np.int64),
        edge=np.zeros((0, EDGE_COLUMNS), dtype=np.int64),
        link=np.zeros((0, LINK_COLUMNS), dtype=np.int64),
        clique=np.zeros((0, CLIQUE_COLUMNS), dtype=np.int64),
        region=region,
        members=np.zeros(0, dtype=np.int64),
        tail=np.zeros(0, dtype=np.int64),
        reach=np.full(RECENT, FAR),
        vacant=np.full(len(CAPACITIES), NOTHING, dtype=np.int64),
        state=state,
        listed=np.zeros((0, LIST_COLUMNS), dtype=np.int64),
        fronts=np.zeros(0),
        forms=np.zeros(0),
        blocks=np.zeros(0),
        diagonal=np.zeros(0),
        step=np.zeros(0),
        reference=np.zeros(0),
        value=np.zeros(0),
        estimate=np.zeros(0),
    )


def with_room(tree: Tree, **lengths: int) -> Tree:
    """Return the tree with arrays of at least so many rows."""
    short = [name for name, count in lengths.items() if len(getattr(tree, name)) < count]
    return tree._replace(**{name: longer(getattr(tree, name), lengths[name]) for name in short}) if short else tree


def longer(array: NDArray[Any], count: int) -> NDArray[Any]:
    """Return the array with at least so many rows and room for more; added rows are zero."""
    if count <= len(array):
        return array
    of_row = array.itemsize * math.prod(array.shape[1:])
    shape = (max(count, len(array) + max(len(array) // 16, _LEAST // of_row)), *array.shape[1:])
    if version_info < _UNCOUNTED and getrefcount(array) <= _REFERENCES:
        # no view of it: the system need not copy it, nor hand out its memory anew
        array.resize(shape, refcheck=False)
        return array
    grown = np.zeros(shape, dtype=array.dtype)
    grown[: len(array)] = array
    return grown


# -- the tree by its pointers ------------------------------------------------------------------------------------------

# behind those of the tree, the arrays of the problem: the estimate that the last call left; which vertices are in it,
# which are held, which edges are in it; the shapes of the graph's kinds (degrees of freedom, stored numbers, kind)
KEPT, INSIDE, HELD, EDGE_INSIDE, SHAPES = range(2 * len(Tree._fields), 2 * len(Tree._fields) + 10, 2)
SHAPE_DOF, SHAPE_SIZE, SHAPE_KIND, SHAPE_COLUMNS = range(4)


def pointers_of(tree: Tree, *more: NDArray[Any]) -> Index:
    """Return where each array begins, and how many rows it has; then those of more arrays."""
    numbers = [number for array in (*tree, *more) for number in (address_of(array), len(array))]
    return np.array(numbers, dtype=np.int64)


@inner
def kept_of(p: Index) -> Array:
    """Return the estimate that the last call left."""
    return reals(p[KEPT], p[KEPT + 1])


@inner
def shapes_of(p: Index) -> Index:
    """Return the shapes of the graph's kinds."""
    return table(p[SHAPES], p[SHAPES + 1], SHAPE_COLUMNS)


@kernel
def tree_of(p: Index) -> Tree:
    """Return the tree whose ``pointers_of`` these are."""
    return Tree(
        table(p[0], p[1], VERTEX_COLUMNS),
        table(p[2], p[3], EDGE_COLUMNS),
        table(p[4], p[5], LINK_COLUMNS),
        table(p[6], p[7], CLIQUE_COLUMNS),
        table(p[8], p[9], REGION_COLUMNS),
        integers(p[10], p[11]),
        integers(p[12], p[13]),
        integers(p[14], p[15]),
        integers(p[16], p[17]),
        integers(p[18], p[19]),
        table(p[20], p[21], LIST_COLUMNS),
        reals(p[22], p[23]),
        reals(p[24], p[25]),
        reals(p[26], p[27]),
        reals(p[28], p[29]),
        reals(p[30], p[31]),
        reals(p[32], p[33]),
        reals(p[34], p[35]),
        reals(p[36], p[37]),
    )


# -- arrays of indices: NumPy's own functions take several seconds to compile in each kernel ---------------------------

RUN = 16  # numbers that are sorted by insertion


@kernel
def ascending(numbers: Index) -> Index:
    """Return the indices that sort some numbers; equal ones keep their order. Short runs are merged."""
    n, width = len(numbers), RUN
    order = np.empty(n, np.int64)
    merged = np.empty(n, np.int64) if n > width else order
    for low in range(0, n, width):
        for k in range(low, min(low + width, n)):
            i = k
            while i > low and numbers[order[i - 1]] > numbers[k]:
                order[i] = order[i - 1]
                i -= 1
            order[i] = k
    while width < n:
        for low in range(0, n, 2 * width):
            middle, high = min(low + width, n), min(low + 2 * width, n)
            i, j = low, middle
            for k in range(low, high):
                if i < middle and (j == high or numbers[order[i]] <= numbers[order[j]]):
                    merged[k] = order[i]
                    i += 1
                else:
                    merged[k] = order[j]
                    j += 1
        order, merged = merged, order
        width *= 2
    return order


@kernel
def in_order(numbers: Index) -> Index:
    """Return the numbers in ascending order."""
    return chosen(numbers, ascending(numbers))


@kernel
def chosen(numbers: Index, places: Index) -> Index:
    """Return the numbers at some indices."""
    out = np.empty(len(places), np.int64)
    for k in range(len(places)):
        out[k] = numbers[places[k]]
    return out


@kernel
def joined(first: Index, then: Index) -> Index:
    """Return two arrays joined into one."""
    out = np.empty(len(first) + len(then), np.int64)
    for k in range(len(first)):
        out[k] = first[k]
    for k in range(len(then)):
        out[len(first) + k] = then[k]
    return out


@kernel
def lengthened(numbers: Index, count: int) -> Index:
    """Return the numbers followed by free room for more."""
    out = np.empty(len(numbers) + count, np.int64)
    for k in range(len(numbers)):
        out[k] = numbers[k]
    return out


# -- pools of cliques by size class: a place that is left is taken again while it is in the cache ----------------------

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
