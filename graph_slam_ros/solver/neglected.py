"""The sum of what linearisation neglects: the estimate is about so far above the optimum in chi2."""

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.solver.blocks import CHUNK, squares
from graph_slam_ros.solver.clique_tree.storage import STEP, Tree
from graph_slam_ros.solver.linearization import rows_of
from graph_slam_ros.typing import Array, Index

_LARGEST = 1.0  # part of a residual [m, rad] that counts: where it is larger, an edge is new or its angle was wrapped


def neglected(graph: Graph, tree: Tree, edges: Index) -> tuple[float, float]:
    """Return the sum of squares of what is neglected of some edges at the estimates of a tree, and their chi2.

    Of an edge it is ``r(x [+] d) - r(x) - J d``, whitened, for the linearisation point x and the step d. The optimum
    is below chi2 by about this sum: by 0.2 to 5 times as much on public graphs. Losses do not count.
    """
    rest_squared = chi2 = 0.0
    for table, of_table in rows_of(graph, edges).items():
        for begin in range(0, len(of_table), CHUNK):
            rows = of_table[begin : begin + CHUNK]
            ends, measured = table.vertices.values[rows], table.measured.values[rows]
            at, root = graph.offset.values[ends], table.sqrt_information.values
            here, _ = table.type.linearize(tree.estimate, at, measured)
            there, jacobian = table.type.linearize(tree.value, at, measured)
            rest = here - there - np.einsum("nij,nj->ni", jacobian, _steps(tree, ends, table.type.dofs))
            rest[np.abs(rest).max(axis=1) > _LARGEST] = 0.0
            weight = table.weight.values[rows]
            rest_squared += float(weight @ squares(root, rows, np.ascontiguousarray(rest)))
            chi2 += float(weight @ squares(root, rows, np.ascontiguousarray(here)))
    return rest_squared, chi2


def _steps(tree: Tree, ends: Index, dofs: tuple[int, ...]) -> Array:
    """Return the steps (n, width) of the vertices of some edges, side by side."""
    first = tree.vertex[ends, STEP]
    return np.concatenate([tree.step[first[:, k, None] + np.arange(dof)] for k, dof in enumerate(dofs)], axis=1)
