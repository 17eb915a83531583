"""The clique tree (Bayes tree): the records of vertices, edges, cliques and regions, in flat arrays.

Eliminating the information matrix H vertex after vertex leaves cliques: *frontal* vertices that were eliminated
together, given a *separator* of later ones, which the parent clique contains. Each clique keeps one dense front::

    [ U11  U12 | y ]   U11: the factor of the frontal variables, its diagonal inverted; U12: on the separator
    [  .    C  | d ]   C, d: what the whole subtree says of the separator, the contribution to the parent

What is below the diagonal is not stored: a front is packed, row after row, each from its diagonal on.

Because contributions are kept, an update touches only the cliques of changed edges and their ancestors (Kaess et al.,
"iSAM2: incremental smoothing and mapping using the Bayes tree", IJRR 2012).

Records are columns of integer arrays, so that compiled code reaches everything through one tuple.
"""

import math
from sys import getrefcount, version_info
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.lie.jit import inner, jitable
from graph_slam_ros.solver.clique_tree.indices import lengthened
from graph_slam_ros.typing import Array, Index

NOTHING = -1
NEVER = 1 << 62  # later than any solution
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
# degrees of freedom; where its front begins; its size class; 1 where an update has marked it; whether the magnitudes of
# its subtree are known (``rounding``); the number of its last solution (``substitution``); 1 where it is listed
(
    PARENT,
    CHILD,
    SIBLING,
    MEMBERS,
    FRONTALS,
    SIZE,
    FRONT_DOF,
    FULL_DOF,
    FRONT,
    CLASS,
    MARK,
    MAGNITUDES,
    SEEN,
    IN_DEFERRED,
    CLIQUE_COLUMNS,
) = range(15)

# list: vertices whose step has changed since all were searched for large ones; whose estimate is not computed yet;
# cliques that may have to be solved. ``state`` has how many there are
SHIFTED, STALE, DEFERRED, LIST_COLUMNS = range(4)

# region of the nested dissection: its place in the binary tree; vertices in its subtree, now and when it was made;
# the first vertex of its own
R_PARENT, R_DEPTH, R_LEFT, R_RIGHT, R_COUNT, R_MADE, R_FIRST, REGION_COLUMNS = range(8)

# tops of the pools, what decides how long the tail is kept, what updates count, and the typical length of a motion
(
    LINKS,
    CLIQUES,
    MEMBERS_TOP,
    FRONTS_TOP,
    REGIONS,
    FREE_REGION,
    BLOCKS_TOP,
    TAIL_FIRST,
    TAIL_END,
    TAIL_KEPT,
    RESTRUCTURED,
    AFFECTED,
    FLOPS,
    FLOPS_SEEN,
    RESTRUCTURED_SEEN,
    FLOPS_USUAL,
    FREE_CLIQUE,
    LIVE,
    LIVE_MADE,
    CLIQUES_WANTED,
    MEMBERS_WANTED,
    FRONTS_WANTED,
    FORMS_WANTED,
    CHECKED,
    SOLUTIONS,
    SUBSTITUTED,
    SHIFTED_COUNT,
    STALE_COUNT,
    DEFERRED_COUNT,
    MOTION_MM,
    ENTERED,
    STATE_COLUMNS,
) = range(32)

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
    forms : quadratic forms of separators (``rounding``), each at the place of its front; empty until one is needed
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
