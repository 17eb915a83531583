"""The clique tree as one array of pointers.

Numba unpacks a tuple of arrays at each call of a kernel, which costs more than a small update computes. Kernels that an
update calls get the places of the arrays in memory instead, and make the tuple themselves.
"""

from collections.abc import Callable
from ctypes import POINTER, c_double, c_int64, cast
from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined]
from numba.extending import intrinsic, overload

from graph_slam_ros.lie.jit import kernel
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


def pointers_of(tree: Tree) -> Index:
    """Return where each array begins, and how many rows it has. An array that is replaced or grows is elsewhere."""
    return np.array([number for array in tree for number in (array.ctypes.data, len(array))], dtype=np.int64)


def _integers(address: int, count: int) -> Index:
    """Return the integers at an address."""
    return np.ctypeslib.as_array(cast(int(address), POINTER(c_int64)), (int(count),))


def _reals(address: int, count: int) -> Array:
    """Return the numbers at an address."""
    return np.ctypeslib.as_array(cast(int(address), POINTER(c_double)), (int(count),))


@intrinsic
def _pointer(_: Any, address: Any) -> tuple[Any, Callable[..., Any]]:
    def generated(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generated


@overload(_integers, jit_options={"error_model": "numpy"})
def _compiled_integers(address: Any, count: Any) -> Callable[..., Any]:
    def compiled(address: Any, count: Any) -> Any:
        return carray(_pointer(address), count, np.int64)  # type: ignore[call-arg]

    return compiled


@overload(_reals, jit_options={"error_model": "numpy"})
def _compiled_reals(address: Any, count: Any) -> Callable[..., Any]:
    def compiled(address: Any, count: Any) -> Any:
        return carray(_pointer(address), count, np.float64)  # type: ignore[call-arg]

    return compiled


@kernel
def _table(p: Index, k: int, columns: int) -> Index:
    return _integers(p[2 * k], p[2 * k + 1] * columns).reshape(p[2 * k + 1], columns)


@kernel
def tree_of(p: Index) -> Tree:
    """Return the tree whose ``pointers_of`` these are."""
    return Tree(
        _table(p, 0, VERTEX_COLUMNS),
        _table(p, 1, EDGE_COLUMNS),
        _table(p, 2, LINK_COLUMNS),
        _table(p, 3, CLIQUE_COLUMNS),
        _table(p, 4, REGION_COLUMNS),
        _integers(p[10], p[11]),
        _integers(p[12], p[13]),
        _integers(p[14], p[15]),
        _integers(p[16], p[17]),
        _integers(p[18], p[19]),
        _table(p, 10, LIST_COLUMNS),
        _reals(p[22], p[23]),
        _reals(p[24], p[25]),
        _reals(p[26], p[27]),
        _reals(p[28], p[29]),
        _reals(p[30], p[31]),
        _reals(p[32], p[33]),
        _reals(p[34], p[35]),
    )
