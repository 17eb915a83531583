"""The solution without some edges, from the one with them: only the vertices that they are on are solved again.

What these edges say is subtracted, as it was linearised, from the joint information of their vertices and of those
asked for. All other edges stay linearised where they are.
"""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtrs

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.solver.clique_tree.storage import ACTIVE, BLOCK, DOF, FREE, NOTHING, STEP, Tree, row_of
from graph_slam_ros.solver.linearization import rows_of
from graph_slam_ros.typing import Array, Index

_LEAST_PIVOT = 1e-8  # of what is left of the information, in units of all of it: below, rounding would decide


def without_edges(
    graph: Graph, tree: Tree, joint: Callable[[Index], Array], vertices: Index, edges: Index
) -> tuple[Array, Array]:
    """Return stored values of vertices, one after the other, and their joint covariance (D, D); zero for held ones.

    Parameters
    ----------
    tree : with current numbers and steps
    joint : the joint covariance of vertices, with these edges
    edges : that are left out

    Raises
    ------
    SingularError
        The other edges do not determine these vertices, or so weakly that rounding would decide.
    """
    if not tree.vertex[vertices, FREE].any():
        return np.concatenate([tree.value[graph.vertex(v).stored] for v in vertices.tolist()]), joint(vertices)
    rows = rows_of(graph, edges[tree.edge[edges, ACTIVE] == 1])
    every = np.unique(np.concatenate([vertices, *(t.vertices.values[chosen].ravel() for t, chosen in rows.items())]))
    is_free = tree.vertex[every, FREE] == 1
    dof = tree.vertex[every, DOF] * is_free
    begin, free = np.where(is_free, np.cumsum(dof) - dof, NOTHING), every[is_free]
    step = tree.step[_ranges(tree.vertex[free, STEP], dof[is_free])]
    information, gradient = _sums(tree, rows, every, begin, len(step))
    root, left = _roots(joint(free), information)
    # with Sigma = L L', what is left of the information is L'^-1 (1 - L' H L) L^-1
    moved = step + root @ dpotrs(left, root.T @ (gradient + information @ step), lower=True)[0]
    at = np.searchsorted(every, vertices)
    values = [_moved(graph, tree, v, first, moved) for v, first in zip(vertices.tolist(), begin[at], strict=True)]
    is_row = np.repeat(is_free[at], tree.vertex[vertices, DOF])
    white = np.zeros((len(root), len(is_row)))
    white[:, is_row] = dtrtrs(left, root[_ranges(begin[at], dof[at])].T, lower=True)[0]
    return np.concatenate(values), white.T @ white


def _roots(covariance: Array, information: Array) -> tuple[Array, Array]:
    """Return the roots L of the covariance, and of what is left without the information, in its units: 1 - L' H L."""
    root, failed = dpotrf(covariance, lower=True, clean=True)
    if not failed:
        left, failed = dpotrf(np.eye(len(root)) - root.T @ information @ root, lower=True, clean=True)
    if failed or not np.square(left.diagonal()).min() >= _LEAST_PIVOT:  # nor is NaN
        raise SingularError("the other edges do not determine what these edges are on")
    return root, left


def _sums(tree: Tree, rows: Mapping[EdgeTable, Index], every: Index, begin: Index, size: int) -> tuple[Array, Array]:
    """Return information (size, size) and gradient (size,), at the linearisation points, of rows of tables.

    Parameters
    ----------
    every : their vertices, in order; begin : where each begins, NOTHING for held ones
    """
    information, gradient = np.zeros((size + 1, size + 1)), np.zeros(size + 1)  # the last is for held vertices
    for table, chosen in rows.items():
        width, dofs = table.width, np.array(table.type.dofs)
        row, column = np.indices((width, width + 1))
        packed = row_of(np.minimum(row, column), width) + np.maximum(row, column)
        blocks = tree.blocks[tree.edge[table.id.values[chosen], BLOCK][:, None, None] + packed]
        begins = np.repeat(begin[np.searchsorted(every, table.vertices.values[chosen])], dofs, axis=1)
        at = np.where(begins < 0, size, begins + _ranges(np.zeros_like(dofs), dofs))
        np.add.at(information, (at[:, :, None], at[:, None, :]), blocks[:, :, :width])
        np.add.at(gradient, at, blocks[:, :, width])
    return information[:size, :size], gradient[:size]


def _moved(graph: Graph, tree: Tree, vertex: int, first: int, step: Array) -> Array:
    """Return the stored values of a vertex at a step (size,) from its linearisation point; of a held one as it is."""
    kind, value = graph.kind_of(vertex), tree.value[graph.vertex(vertex).stored]
    return value if first < 0 else kind.retract(value[None], step[None, first : first + kind.dof])[0]


def _ranges(begin: Index, count: Index) -> Index:
    """Return the numbers from each begin on, so many, end to end."""
    return np.repeat(begin - np.cumsum(count) + count, count) + np.arange(count.sum())
