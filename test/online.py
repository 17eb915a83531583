"""What the tests of the online solver share: settings, the user's own edge type, and the invariants of the tree."""

import numpy as np

from graph_slam_ros.graph import R1, R2, SE2, EdgeType
from graph_slam_ros.graph.records import TABLES
from graph_slam_ros.solver.clique_tree import storage as t
from graph_slam_ros.solver.clique_tree.storage import pointers_of

# everything is linearised anew until nothing moves: the optimum of all there is
EXACT = {
    "relinearize_above": 0.0,
    "relinearize_every": 1,
    "relinearize_passes": 50,
    "tolerance": 1e-12,
    "tolerance_sigmas": 0.0,
}
BATCH = {"max_iterations": 100, "step_tolerance": 1e-10, "cost_tolerance": 0.0}


def _range_with_bias(x, at, measured):
    """``r = |l - t| + b - z``: a distance between a pose and a point, by a sensor with an offset of its own."""
    residual, jacobian = np.zeros((len(at), 1)), np.zeros((len(at), 1, 6))
    for e, (pose, point, bias) in enumerate(at):
        apart = x[point : point + 2] - x[pose : pose + 2]
        distance = np.hypot(*apart)
        towards = apart / distance
        c, s = np.cos(x[pose + 2]), np.sin(x[pose + 2])
        residual[e, 0] = distance + x[bias] - measured[e, 0]
        jacobian[e, 0, :2] = -towards @ np.array([[c, -s], [s, c]])
        jacobian[e, 0, 3:5] = towards
        jacobian[e, 0, 5] = 1.0
    return residual, jacobian


RANGE_WITH_BIAS = EdgeType("range with bias", ((SE2,), (R2,), (R1,)), 1, 1, _range_with_bias)


def _listed(first, following, most, what):
    """A linked list, which must end and hold nothing twice."""
    out = []
    while first != t.NOTHING:
        out.append(int(first))
        assert len(out) <= most, f"the {what} never ends"
        first = following[first]
    assert len(set(out)) == len(out), f"the {what} holds something twice"
    return out


def check_pointers(graph):
    """Assert that compiled code is given the places where the columns of a graph are."""
    columns = graph.kind, graph.offset, graph.initial, graph.table_of_edge, graph.row_of_edge
    assert graph.pointers[: len(columns)].tolist() == [column.values.ctypes.data for column in columns]
    tables = list(graph.tables.values())
    assert graph.pointers[TABLES:].tolist() == [table.pointers.ctypes.data for table in tables]
    for table in tables:
        assert table.pointers[: len(table.columns)].tolist() == [c.values.ctypes.data for c in table.columns]


def check_tree(solver, *, regions_separate=False):
    """Walk the clique tree and the regions, and assert what must hold between updates.

    ``regions_separate`` may be asked for where each edge came with its newest vertex.
    """
    tree = solver._tree
    vertex, clique, state = tree.vertex, tree.clique, tree.state
    of_problem = solver._kept, solver._inside, solver._held, solver._edge_inside, solver._shapes
    assert np.array_equal(solver._pointers, pointers_of(tree, *of_problem)), "kernels get arrays that are gone"
    check_pointers(solver.graph)
    assert min(map(len, (tree.vertex, tree.listed, solver._inside, solver._held))) >= solver._vertices
    assert min(map(len, (tree.edge, solver._edge_inside))) >= solver.graph.edge_count
    free = np.flatnonzero(vertex[: solver._vertices, t.FREE] == 1).tolist()
    key = vertex[:, t.KEY]
    assert state[t.TAIL_END] <= len(tree.tail)
    in_use = {int(vertex[v, t.CLIQUE]) for v in free}
    assert t.NOTHING not in in_use
    members, frontals = {}, {}
    for c in in_use:
        first, count = clique[c, t.MEMBERS], clique[c, t.FRONTALS]
        members[c] = tree.members[first : first + clique[c, t.SIZE]].tolist()
        frontals[c] = members[c][:count]
    # each unknown is frontal once, in its own clique
    assert sorted(v for f in frontals.values() for v in f) == free
    children = {c: set() for c in in_use}
    for c in in_use:
        own, separator, parent = frontals[c], members[c][len(frontals[c]) :], int(clique[c, t.PARENT])
        assert all(vertex[v, t.CLIQUE] == c for v in own)
        assert (np.diff(key[own]) > 0).all()
        assert all(key[v] > key[own[-1]] for v in separator)
        dof = vertex[members[c], t.DOF]
        assert (clique[c, t.FRONT_DOF], clique[c, t.FULL_DOF]) == (dof[: len(own)].sum(), dof.sum())
        assert clique[c, t.MARK] == 0
        assert bool(separator) == (parent != t.NOTHING)
        if separator:
            assert parent in in_use
            assert set(separator) <= set(members[parent])
            assert vertex[min(separator, key=lambda v: key[v]), t.CLIQUE] == parent
            children[parent].add(c)
    for c in in_use:
        assert set(_listed(clique[c, t.CHILD], clique[:, t.SIBLING], len(in_use), "list of children")) == children[c]
    vacant = [_listed(first, clique[:, t.SIBLING], state[t.CLIQUES], "list of vacant cliques") for first in tree.vacant]
    free_records = _listed(state[t.FREE_CLIQUE], clique[:, t.SIBLING], state[t.CLIQUES], "list of free records")
    assert sorted([*in_use, *(c for group in vacant for c in group), *free_records]) == list(range(state[t.CLIQUES]))
    _check_memory(tree, in_use, [c for group in vacant for c in group])
    for e in np.flatnonzero(tree.edge[:, t.ACTIVE] == 1):
        first = tree.edge[e, t.LINKED]
        ends = tree.link[first : first + tree.edge[e, t.COUNT], t.LINK_END]
        ends = [int(v) for v in ends if vertex[v, t.FREE] == 1]
        if ends:
            owner = int(tree.edge[e, t.OWNER])
            assert owner == min(ends, key=lambda v: key[v])
            assert set(ends) <= set(members[int(vertex[owner, t.CLIQUE])])
    assert (vertex[: solver._vertices, t.LOCAL] == t.NOTHING).all()
    _check_lists(tree, {c: members[c][len(frontals[c]) :] for c in in_use})
    _check_regions(solver, free, separate=regions_separate)


def _check_lists(tree, separators):
    """What has to be solved or shown is in its list, once."""
    vertex, clique, state = tree.vertex, tree.clique, tree.state
    for column, count in ((t.SHIFTED, t.SHIFTED_COUNT), (t.STALE, t.STALE_COUNT), (t.DEFERRED, t.DEFERRED_COUNT)):
        listed = tree.listed[: state[count], column]
        assert len(set(listed.tolist())) == len(listed)
        if column == t.DEFERRED:
            assert (clique[listed, t.IN_DEFERRED] == 1).all()
        else:
            bit = t.IS_SHIFTED if column == t.SHIFTED else t.IS_STALE
            assert set(np.flatnonzero(vertex[:, t.NOTED] & bit)) == set(listed.tolist())
    for c, separator in separators.items():
        assert clique[c, t.SEEN] <= state[t.SOLUTIONS], f"clique {c} was never solved"
        if (vertex[separator, t.CHANGED] > clique[c, t.SEEN]).any():
            while c != t.NOTHING and clique[c, t.IN_DEFERRED] == 0:  # what is above comes first
                c = int(clique[c, t.PARENT])
            assert c != t.NOTHING


def _check_memory(tree, in_use, vacant):
    """No two cliques share memory, and each has as much as its class says."""
    clique, state = tree.clique, tree.state
    held = np.array(sorted([*in_use, *vacant]), dtype=np.int64)
    members = t.CAPACITIES[clique[held, t.CLASS]]
    assert (clique[held, t.FULL_DOF] <= members).all()
    for column, sizes, top in ((t.MEMBERS, members, t.MEMBERS_TOP), (t.FRONT, t.packed_size(members), t.FRONTS_TOP)):
        order = np.argsort(clique[held, column])
        begin, end = clique[held, column][order], clique[held, column][order] + sizes[order]
        assert (end[:-1] <= begin[1:]).all()
        assert end.max(initial=0) <= state[top]
    live = t.CAPACITIES[clique[sorted(in_use), t.CLASS]] if in_use else np.empty(0, dtype=np.int64)
    assert state[t.LIVE] == t.packed_size(live).sum()


def _check_regions(solver, free, *, separate):
    tree = solver._tree
    vertex, region, state = tree.vertex, tree.region, tree.state
    tail = tree.tail[state[t.TAIL_FIRST] : state[t.TAIL_END]].tolist()
    waiting = [v for v in tail if vertex[v, t.FREE] == 1]
    assert len(set(waiting)) == len(waiting), "the tail holds a vertex twice"
    stack, place = [0], {}
    while stack:
        r = stack.pop()
        assert r < state[t.REGIONS] <= len(region)
        for v in _listed(region[r, t.R_FIRST], vertex[:, t.NEXT], solver._vertices, "list of a region"):
            if vertex[v, t.FREE] == 1:
                assert v not in place, f"vertex {v} is in two regions"
                assert vertex[v, t.REGION] == r
                place[v] = r
        sides = [int(s) for s in region[r, [t.R_LEFT, t.R_RIGHT]] if s != t.NOTHING]
        assert len(sides) in (0, 2)
        for s in sides:
            assert (region[s, t.R_PARENT], region[s, t.R_DEPTH]) == (r, region[r, t.R_DEPTH] + 1)
        stack += sides
    assert sorted([*place, *waiting]) == free
    if not separate:
        return

    def upwards(r):
        while r != t.NOTHING:
            yield r
            r = int(region[r, t.R_PARENT])

    above = {r: set(upwards(r)) for r in set(place.values())}
    for e in np.flatnonzero(tree.edge[:, t.ACTIVE] == 1):
        first = tree.edge[e, t.LINKED]
        ends = tree.link[first : first + tree.edge[e, t.COUNT], t.LINK_END]
        there = [place[v] for v in ends.tolist() if v in place]
        for a in there:
            for b in there:
                assert a in above[b] or b in above[a], f"edge {e} joins regions beside each other"
