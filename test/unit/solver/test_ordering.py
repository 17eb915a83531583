"""Vertex separators of random graphs and grids, and the clique tree after random changes."""

import numpy as np
from online import check_tree
from rows import each

from graph_slam_ros.graph import POSE_PRIOR, RELATIVE_POSE, SE2, Gaussian, Graph
from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.solver.clique_tree.separator import HEAVIEST, separate
from graph_slam_ros.solver.clique_tree.storage import (
    CLIQUE,
    FRONTS_TOP,
    FULL_DOF,
    LIVE,
    NOTHING,
    PARENT,
)
from graph_slam_ros.tools.simulation import city_graph


def arrays(n, pairs, weight=None):
    """The arrays that ``separate`` takes."""
    pairs = np.array(sorted({(min(p), max(p)) for p in pairs if p[0] != p[1]}), dtype=np.int64).reshape(-1, 2)
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    order = np.argsort(i, kind="stable")
    start = np.zeros(n + 1, dtype=np.int64)
    np.cumsum(np.bincount(i, minlength=n), out=start[1:])
    weights = np.full(n, 3, dtype=np.int64) if weight is None else np.asarray(weight, dtype=np.int64)
    return pairs, (start, j[order].copy(), np.ones(len(i), dtype=np.int64), weights)


def weights_of(side, weight):
    return [int(weight[side == s].sum()) for s in range(3)]


def grid(width, depth):
    at = np.arange(width * depth).reshape(width, depth)
    return [
        *zip(at[1:].ravel(), at[:-1].ravel(), strict=True),
        *zip(at[:, 1:].ravel(), at[:, :-1].ravel(), strict=True),
    ]


def random_pairs(kind, n, rng):
    if kind == "sparse":
        return rng.integers(0, n, (3 * n // 2, 2)).tolist()
    if kind == "tree":
        return [(int(rng.integers(0, k)), k) for k in range(1, n)]
    if kind == "path":
        return [(k, k + 1) for k in range(n - 1)]
    if kind == "star":
        return [(0, k) for k in range(1, n)]
    if kind == "whole":
        return [(i, j) for i in range(min(n, 60)) for j in range(i)]
    if kind == "pieces":
        return [(k, k + 1) for k in range(n - 1) if k % 7]
    return [(k, k + 1) for k in range(n - 1)] + rng.integers(0, n, (n // 5, 2)).tolist()  # a drive with closures


KINDS = ["sparse", "tree", "path", "star", "whole", "pieces", "drive"]


@each("n", [2, 3, 41, 1500])
@each("kind", KINDS)
def test_what_a_separator_separates_is_never_adjacent(kind, n):
    rng = np.random.default_rng(n)
    pairs, graph = arrays(n, random_pairs(kind, n, rng), rng.choice([1, 2, 3, 6], n))
    side = separate(*graph)
    assert set(side.tolist()) <= {0, 1, 2}
    ends = side[pairs]
    assert not ((ends == [0, 1]).all(axis=1) | (ends == [1, 0]).all(axis=1)).any()


@each("width, depth", [(8, 8), (30, 30), (70, 70), (20, 60)])
@each("shuffled", [False, True])
def test_a_grid_is_separated_about_as_well_as_by_a_straight_line(width, depth, shuffled):
    pairs = np.array(grid(width, depth))
    if shuffled:
        pairs = np.random.default_rng(1).permutation(width * depth)[pairs]
    _, graph = arrays(width * depth, pairs.tolist())
    first, second, between = weights_of(separate(*graph), graph[3])
    assert between <= 1.5 * 3 * min(width, depth)
    assert max(first, second) <= HEAVIEST * 3 * width * depth


NOISE = Gaussian.from_sigmas(0.1, 0.1, 0.05)


@each("seed", range(2))
def test_the_tree_and_its_regions_hold_after_every_update_of_a_growing_graph(seed):
    rng = np.random.default_rng(seed)
    graph = Graph()
    solver = Solver(graph, Settings(relinearize_above=10.0))
    poses = 0
    for _ in range(60):
        vertices, edges = [], []
        for _ in range(int(rng.integers(1, 9))):
            v = graph.add_vertex(SE2, [poses, 0.0, 0.0])
            vertices.append(v)
            if poses == 0:
                edges.append(graph.add_edge(POSE_PRIOR, [v], [0.0, 0.0, 0.0], NOISE, "anchor"))
            else:
                edges.append(graph.add_edge(RELATIVE_POSE, [v - 1, v], [1.0, 0.0, 0.0], NOISE, "odometry"))
            while poses > 3 and rng.random() < 0.3:
                i = int(rng.integers(0, v - 1))
                edges.append(graph.add_edge(RELATIVE_POSE, [i, v], [v - i, 0.0, 0.0], NOISE, "closures"))
            poses += 1
        solver.add(vertices, edges)
        solver.update()
        check_tree(solver, regions_separate=True)


@each("seed", range(2))
def test_the_tree_holds_after_edges_between_old_vertices_and_without_some(seed):
    rng = np.random.default_rng(seed)
    graph, _ = city_graph(seed=seed, poses=250, blocks=6)
    solver = Solver(graph, Settings(relinearize_above=10.0))
    solver.hold(0)
    solver.add(range(250), range(249))
    late = rng.permutation(np.arange(249, graph.edge_count))
    for k in range(0, len(late), 5):
        solver.add([], late[k : k + 5])
        if k:
            solver.set_weight(int(late[rng.integers(0, k)]), float(rng.integers(0, 2)))
        solver.update()
        check_tree(solver)


def test_a_batch_and_growth_leave_trees_that_are_alike_in_depth_and_width():
    graph, _ = city_graph(seed=2, poses=900, blocks=12)
    whole = Solver(graph)
    whole.hold(0)
    whole.add(range(900), range(graph.edge_count))
    whole.optimize()
    check_tree(whole, regions_separate=True)
    grown = Solver(graph)
    newest = next(iter(graph.tables.values())).vertices.values.max(axis=1)
    for k in range(900):
        grown.add([k], np.flatnonzero(newest == k))
        if k == 0:
            grown.hold(0)
        grown.update()
    check_tree(grown, regions_separate=True)
    (deep, wide), (grown_deep, grown_wide) = shape(whole), shape(grown)
    assert grown_deep <= 2 * deep
    assert grown_wide <= 2 * wide


def shape(solver):
    """How many cliques lie between the root and the farthest leaf, and the degrees of freedom of the largest."""
    clique = solver._tree.clique
    cliques = set(solver._tree.vertex[1 : solver._vertices, CLIQUE].tolist())

    def depth(c):
        count = 0
        while c != NOTHING:
            c, count = int(clique[c, PARENT]), count + 1
        return count

    return max(map(depth, cliques)), max(int(clique[c, FULL_DOF]) for c in cliques)


def test_moving_cliques_together_in_memory_changes_nothing_else():
    graph, _ = city_graph(3, poses=300)
    ends = np.concatenate([table.vertices.values.max(axis=1) for table in graph.tables.values()])
    ids = np.concatenate([table.id.values for table in graph.tables.values()])
    solvers = Solver(graph), Solver(graph)
    for pose in range(graph.vertex_count):
        for solver in solvers:
            solver.add([pose], ids[ends == pose])
            if pose == 0:
                solver.hold(0)
            solver.update()
        if pose % 10 == 9:
            solvers[1].compact()
            check_tree(solvers[1])
            assert solvers[1]._tree.state[FRONTS_TOP] == solvers[1]._tree.state[LIVE]
    everything = range(graph.vertex_count)
    assert np.array_equal(solvers[0].estimate(everything), solvers[1].estimate(everything))
    assert np.array_equal(solvers[0].joint_marginal([7, 250]), solvers[1].joint_marginal([7, 250]))
