"""An update in one compiled call: what arrives enters, is linearised and solved, and what is far is moved.

Where Python is needed the call ends early, and is made again from the next stage on. Compiled code gets the graph and
the problem by their pointers: ``Graph.pointers``, and the tree's (``pointers_of``) with the arrays of the problem
behind them.
"""

from graph_slam_ros.graph import records
from graph_slam_ros.graph.records import flags, integers, reals, table_at
from graph_slam_ros.lie.jit import inner, kernel
from graph_slam_ros.solver.clique_tree import storage as its
from graph_slam_ros.solver.clique_tree.incremental import DISSECT, advance_tree, enter, reach_back
from graph_slam_ros.solver.clique_tree.storage import (
    NOTHING,
    ZERO,
    Limits,
    Tree,
    kept_of,
    packed_size,
    shapes_of,
    tree_of,
)
from graph_slam_ros.solver.linearization import linearize_edges
from graph_slam_ros.solver.relinearization import MAYBE, SURELY
from graph_slam_ros.typing import Index, Mask

RECORDED, UNFIT_VERTEX, UNFIT_EDGE, WITHOUT_VERTEX, NO_ROOM = range(5)  # how ``record`` ends
ANCHORED, FLOATING, LEFT_OUT = range(3)  # how ``anchorage`` ends
FEW = 64  # new vertices whose anchorage is looked for; more are said to be loose, which is then looked into


@inner
def flags_at(pointers: Index, k: int) -> Mask:
    """Return an array of the problem."""
    return flags(pointers[k], pointers[k + 1])


@kernel
def record(
    graph: Index, pointers: Index, counts: tuple[int, int, int, int], new: Index, edges: Index
) -> tuple[int, int, int]:
    """Follow the growth of the graph, and record vertices and edges that enter the problem, all or none.

    Parameters
    ----------
    counts : vertices of the graph that have a record; vertices, their stored numbers, and edges that there are now

    Returns
    -------
    How it ends, then: whether one of the vertices is in the order of the tree still; the index of one, or of an edge,
    that does not exist, is in the problem already or is repeated; a vertex that an edge needs and that was not added;
    how many links and numbers of blocks there must be room for.
    """
    known, vertices, numbers, edge_count = counts
    t, inside, edge_inside = tree_of(pointers), flags_at(pointers, its.INSIDE), flags_at(pointers, its.EDGE_INSIDE)
    _append_vertices(t, graph, pointers, known, vertices, numbers)
    bad = _unfit(new, inside, vertices)
    if bad != NOTHING:
        return UNFIT_VERTEX, bad, 0
    bad = _unfit(edges, edge_inside, edge_count)
    if bad != NOTHING:
        return UNFIT_EDGE, bad, 0
    table_of, row_of = (
        integers(graph[records.TABLE_OF_EDGE], edge_count),
        integers(graph[records.ROW_OF_EDGE], edge_count),
    )
    missing = _outside(graph, table_of, row_of, edges, inside, new)
    if missing != NOTHING:
        return WITHOUT_VERTEX, missing, 0
    links, blocks, there = t.state[its.LINKS], t.state[its.BLOCKS_TOP], 0
    for e in edges:
        table = table_at(graph, table_of[e])
        links += table[records.ENDS]
        blocks += packed_size(table[records.WIDTH])
    if links > len(t.link) or blocks > len(t.blocks):
        return NO_ROOM, links, blocks
    for code in range(len(graph) - records.TABLES):
        for e in edges:
            if table_of[e] == code:
                _append_edge(t, table_at(graph, code), e, row_of[e])
    for v in new:
        there = max(there, t.vertex[v, its.KEY] != NOTHING)
    return RECORDED, there, 0


@inner
def _append_vertices(t: Tree, graph: Index, pointers: Index, first: int, end: int, numbers: int) -> None:
    """Append the records of new vertices with their initial values. They are not unknowns yet."""
    if first == end:
        return
    vertex, t_step, value, estimate = t.vertex, t.step, t.value, t.estimate
    kept, shapes = kept_of(pointers), shapes_of(pointers)
    kinds, offset = integers(graph[records.KIND], end), integers(graph[records.OFFSET], end)
    initial = reals(graph[records.INITIAL], numbers)
    step = 0 if first == 0 else vertex[first - 1, its.STEP] + vertex[first - 1, its.DOF]
    for v in range(first, end):
        for k in range(vertex.shape[1]):
            vertex[v, k] = NOTHING
        vertex[v, its.FREE] = vertex[v, its.CHANGED] = vertex[v, its.NOTED] = 0
        at, of = offset[v], kinds[v]
        dof = shapes[of, its.SHAPE_DOF]
        vertex[v, its.DOF], vertex[v, its.KIND] = dof, shapes[of, its.SHAPE_KIND]
        vertex[v, its.STEP], vertex[v, its.VALUE] = step, at
        for i in range(step, step + dof):
            t_step[i] = 0.0
        for i in range(at, at + shapes[of, its.SHAPE_SIZE]):
            value[i] = estimate[i] = kept[i] = initial[i]
        step += dof


@inner
def _unfit(ids: Index, inside: Mask, count: int) -> int:
    """Return the index in ``ids`` of an id that is too large, already in the problem or repeated; or NOTHING."""
    found, marked = NOTHING, 0
    for k in range(len(ids)):
        if ids[k] < 0 or ids[k] >= count or inside[ids[k]]:
            found = k
            break
        inside[ids[k]] = True
        marked += 1
    for k in range(marked):
        inside[ids[k]] = False
    return found


@inner
def _outside(graph: Index, table_of: Index, row_of: Index, edges: Index, inside: Mask, new: Index) -> int:
    """Return a vertex that weighted edges need and that is neither in the problem nor new; or NOTHING."""
    found = NOTHING
    for v in new:
        inside[v] = True
    for code in range(len(graph) - records.TABLES):
        table = table_at(graph, code)
        slots, room = table[records.ENDS], table[records.ROOM]
        ends, weight = integers(table[records.VERTICES], room * slots), reals(table[records.WEIGHT], room)
        for e in edges:
            if table_of[e] != code or weight[row_of[e]] == 0.0:
                continue
            for s in range(row_of[e] * slots, (row_of[e] + 1) * slots):
                if found == NOTHING and not inside[ends[s]]:
                    found = ends[s]
    for v in new:
        inside[v] = False
    return found


@inner
def _append_edge(t: Tree, table: Index, e: int, row: int) -> None:
    """Append the record of an edge, and link it to its vertices. It is not in the structure yet."""
    vertex, edge, t_link, state, blocks = t.vertex, t.edge, t.link, t.state, t.blocks
    if edge[e, its.COUNT] > 0:  # by a call that was interrupted
        return
    slots, width = table[records.ENDS], table[records.WIDTH]
    ends = integers(table[records.VERTICES], table[records.ROOM] * slots)
    edge[e, its.COUNT], edge[e, its.LINKED] = slots, state[its.LINKS]
    for s in range(row * slots, (row + 1) * slots):
        v, link = ends[s], state[its.LINKS]
        state[its.LINKS] += 1
        t_link[link, its.LINK_EDGE], t_link[link, its.LINK_END], t_link[link, its.LINK_NEXT] = e, v, vertex[v, its.LINK]
        vertex[v, its.LINK] = link
    edge[e, its.BLOCK] = state[its.BLOCKS_TOP]
    state[its.BLOCKS_TOP] += packed_size(width)
    edge[e, its.WIDTH], edge[e, its.ACTIVE], edge[e, its.OWNER], edge[e, its.MARKED] = width, 0, NOTHING, 0
    for i in range(edge[e, its.BLOCK], state[its.BLOCKS_TOP]):
        blocks[i] = 0.0


@kernel
def anchorage(t: Tree, graph: Index, pointers: Index, vertices: Index, edges: Index) -> int:
    """Return ANCHORED if edges join each vertex, by a chain, to an older one or to an edge on one vertex alone.

    LEFT_OUT is returned if one of the vertices is no unknown, or one of the edges has no weight: without these it is to
    be asked again.
    """
    inside, held = flags_at(pointers, its.INSIDE), flags_at(pointers, its.HELD)
    for v in vertices:
        if held[v] or not inside[v]:
            return LEFT_OUT
    rooms = graph[records.EDGE_ROOM]
    table_of, row_of = integers(graph[records.TABLE_OF_EDGE], rooms), integers(graph[records.ROW_OF_EDGE], rooms)
    for e in edges:
        table = table_at(graph, table_of[e])
        if reals(table[records.WEIGHT], table[records.ROOM])[row_of[e]] == 0.0:
            return LEFT_OUT
    return ANCHORED if _are_anchored(t.vertex, t.edge, t.link, vertices, edges) else FLOATING


@inner
def _are_anchored(vertex: Index, edge: Index, link: Index, new: Index, edges: Index) -> bool:
    """Return whether edges join each new vertex, by a chain, to an older one or to an edge on one vertex alone."""
    for v in new:
        vertex[v, its.LOCAL] = 0
    for e in edges:
        edge[e, its.MARKED] = 1
    count, gained = 0, len(new) <= FEW
    while gained and count < len(new):
        gained = False
        for v in new:
            a = vertex[v, its.LINK]
            while a != NOTHING and vertex[v, its.LOCAL] == 0:
                e = link[a, its.LINK_EDGE]
                a = link[a, its.LINK_NEXT]
                if edge[e, its.MARKED] == 0:
                    continue
                fixed = edge[e, its.COUNT] == 1
                for s in range(edge[e, its.COUNT]):
                    fixed = fixed or vertex[link[edge[e, its.LINKED] + s, its.LINK_END], its.LOCAL] != 0
                if fixed:
                    vertex[v, its.LOCAL] = 1
                    count += 1
                    gained = True
    for v in new:
        vertex[v, its.LOCAL] = NOTHING
    for e in edges:
        edge[e, its.MARKED] = 0
    return count == len(new)


CHECK, LINEARIZE, ORDER, GROUP, END = range(5)  # stages: where the call begins; after the last there is nothing to do
UNSURE, SEARCH, IN_PYTHON = range(DISSECT + 1, DISSECT + 4)  # how it ends where the tree was not advanced


@kernel
def update(
    graph: Index,
    pointers: Index,
    stage: int,
    due: int,
    vertices: Index,
    edges: Index,
    linear: Index,
    again: Index,
    touched: Index,
    unseen: Index,
    young: Index,
    losses: Index,
    tolerance: float,
    sigmas: float,
    far: Limits,
) -> tuple[int, int, int, Index]:
    """Integrate vertices and edges into the solution of a problem.

    Parameters
    ----------
    graph, pointers : those of the graph, and of the problem
    stage : CHECK: all of it; LINEARIZE: they have entered; ORDER: they are linearised; GROUP: their tail is moved
    due : whether all vertices that moved are to be searched for large steps (``RelinearizationSchedule.is_due``)
    vertices, edges : that enter or have changed
    linear : edges to linearise: these, and those ``again`` that are far from where they were linearised
    touched, unseen, tolerance, sigmas, far : see ``advance_tree``
    young, losses : edges held to the first stage of their loss; pointers of the losses of first and last stage

    Returns
    -------
    What ``advance_tree`` returns; or, and the rest says nothing:

    * UNSURE: it may be that nothing fixes a vertex, or one is held, or an edge has no weight. Nothing was changed
    * SEARCH: they have entered, and it is time to search
    * IN_PYTHON: an edge is not compiled, or its cost is not finite; all are to be linearised in Python
    """
    t, nothing = tree_of(pointers), vertices[:0]
    if stage <= CHECK:
        if anchorage(t, graph, pointers, vertices, edges) != ANCHORED:
            return UNSURE, ZERO, ZERO, nothing
        enter(t, vertices, edges)
        if due == SURELY or (due == MAYBE and reach_back(t, edges)):
            return SEARCH, ZERO, ZERO, nothing
    if stage <= LINEARIZE:
        table, _ = linearize_edges(t, graph, linear, losses[4:], young, losses[:4])
        if table != NOTHING:
            return IN_PYTHON, ZERO, ZERO, nothing
    tail = stage <= ORDER
    return advance_tree(t, kept_of(pointers), edges, touched, vertices, tail, again, unseen, tolerance, sigmas, far)
