"""Vertex separators of random graphs and grids, and the clique tree after random changes."""

import numpy as np
from online import check_tree
from rows import each

from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.solver.clique_tree.ordering import HEAVIEST, separate
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


@each("n", [2, 3, 41, 1500])
@each("kind", ["sparse", "tree", "path", "star", "whole", "pieces", "drive"])
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
    first, second, between = np.bincount(separate(*graph), weights=graph[3], minlength=3)
    assert between <= 1.5 * 3 * min(width, depth)
    assert max(first, second) <= HEAVIEST * 3 * width * depth


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


def test_moving_cliques_together_in_memory_changes_nothing_else():
    graph, _ = city_graph(3, poses=300)
    ends = np.concatenate([table.vertices.max(axis=1) for table in graph.tables.values()])
    ids = np.concatenate([table.ids for table in graph.tables.values()])
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
    everything = range(graph.vertex_count)
    assert np.array_equal(solvers[0].estimate(everything), solvers[1].estimate(everything))
    assert np.array_equal(solvers[0].joint_marginal([7, 250]), solvers[1].joint_marginal([7, 250]))
