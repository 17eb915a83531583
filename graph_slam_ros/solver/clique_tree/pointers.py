"""The clique tree as one array of pointers (``lie/addresses``)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.lie.addresses import address_of, integers, reals, table
from graph_slam_ros.lie.jit import inner, kernel
from graph_slam_ros.solver.clique_tree.storage import (
    CLIQUE_COLUMNS,
    EDGE_COLUMNS,
    LINK_COLUMNS,
    LIST_COLUMNS,
    REGION_COLUMNS,
    VERTEX_COLUMNS,
    Tree,
)
from graph_slam_ros.typing import Array, Index

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
