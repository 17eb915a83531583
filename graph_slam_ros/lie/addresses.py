"""Arrays by their addresses in memory.

Numba unpacks each array that a kernel gets, and a tuple of arrays is slower still: for a small change that costs more
than the computation. A kernel that needs many arrays gets one array of their addresses instead. Whoever makes it keeps
the arrays alive.
"""

from collections.abc import Callable
from ctypes import POINTER, addressof, c_bool, c_char, c_double, c_int64, cast
from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined]
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from graph_slam_ros.typing import Array, Index, Mask


def address_of(array: NDArray[Any]) -> int:
    """Return where an array begins. An array that is replaced or grows is elsewhere."""
    if array.nbytes:  # NumPy's own way takes three times as long
        return addressof(c_char.from_buffer(array))  # type: ignore[arg-type]
    begin: int = array.__array_interface__["data"][0]
    return begin


def integers(address: int, count: int) -> Index:
    """Return the integers at an address."""
    return np.ctypeslib.as_array(cast(int(address), POINTER(c_int64)), (int(count),))


def reals(address: int, count: int) -> Array:
    """Return the numbers at an address."""
    return np.ctypeslib.as_array(cast(int(address), POINTER(c_double)), (int(count),))


def table(address: int, rows: int, columns: int) -> Index:
    """Return the table of integers at an address."""
    return integers(address, int(rows) * int(columns)).reshape(int(rows), int(columns))


def flags(address: int, count: int) -> Mask:
    """Return the truth values at an address."""
    return np.ctypeslib.as_array(cast(int(address), POINTER(c_bool)), (int(count),)).view(np.bool_)


@intrinsic
def _pointer(_: Any, address: Any) -> tuple[Any, Callable[..., Any]]:
    def generated(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generated


@overload(integers, jit_options={"error_model": "numpy"})
def _compiled_integers(address: Any, count: Any) -> Callable[..., Any]:
    def compiled(address: Any, count: Any) -> Any:
        return carray(_pointer(address), count, np.int64)  # type: ignore[call-arg]

    return compiled


@overload(table, jit_options={"error_model": "numpy"})
def _compiled_table(address: Any, rows: Any, columns: Any) -> Callable[..., Any]:
    def compiled(address: Any, rows: Any, columns: Any) -> Any:
        return carray(_pointer(address), (rows, columns), np.int64)  # type: ignore[call-arg]

    return compiled


@overload(reals, jit_options={"error_model": "numpy"})
def _compiled_reals(address: Any, count: Any) -> Callable[..., Any]:
    def compiled(address: Any, count: Any) -> Any:
        return carray(_pointer(address), count, np.float64)  # type: ignore[call-arg]

    return compiled


@overload(flags, jit_options={"error_model": "numpy"})
def _compiled_flags(address: Any, count: Any) -> Callable[..., Any]:
    def compiled(address: Any, count: Any) -> Any:
        return carray(_pointer(address), count, np.bool_)  # type: ignore[call-arg]

    return compiled
