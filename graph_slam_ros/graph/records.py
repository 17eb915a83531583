"""The records of a graph for compiled code, which gets arrays, and the linearisation of an edge, by their addresses.

Numba unpacks each array that a kernel gets, and a tuple of arrays is slower still: for a small change that costs more
than the computation. A kernel that needs many arrays gets one array of their addresses instead. Whoever makes it keeps
the arrays alive. Rows are written beyond the end of the columns, which have room for them. The graph then counts them,
all or none.
"""

from collections.abc import Callable
from ctypes import POINTER, addressof, c_bool, c_char, c_double, c_int64, cast
from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined]
from numba.core import cgutils
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from graph_slam_ros.lie.jit import inner, kernel
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


def _compiled(dtype: Any) -> Callable[..., Any]:
    def typed(address: Any, count: Any) -> Callable[..., Any]:
        def compiled(address: Any, count: Any) -> Any:
            return carray(_pointer(address), count, dtype)  # type: ignore[call-arg]

        return compiled

    return typed


for _function, _dtype in ((integers, np.int64), (reals, np.float64), (flags, np.bool_)):
    overload(_function, jit_options={"error_model": "numpy"})(_compiled(_dtype))


@overload(table, jit_options={"error_model": "numpy"})
def _compiled_table(address: Any, rows: Any, columns: Any) -> Callable[..., Any]:
    def compiled(address: Any, rows: Any, columns: Any) -> Any:
        return carray(_pointer(address), (rows, columns), np.int64)  # type: ignore[call-arg]

    return compiled


_ARRAYS = types.float64[::1], types.int64[:, ::1], types.float64[:, ::1]
_RETURNED: Any = types.Tuple((types.float64[:, ::1], types.float64[:, :, ::1]))  # type: ignore[no-untyped-call]

_ADDRESSES: dict[Callable[..., Any], int] = {}  # of this process: to ask for one takes a tenth of a millisecond


def native_address(linearize: Callable[..., Any]) -> int:
    """Return where the machine code of ``EdgeType.linearize`` is; 0 if it is not compiled, or was never called."""
    if (known := _ADDRESSES.get(linearize)) is not None:
        return known
    for compiled in getattr(linearize, "overloads", {}).values():
        if tuple(compiled.signature.args) == _ARRAYS and compiled.signature.return_type == _RETURNED:
            address: int = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name)
            _ADDRESSES[linearize] = address
            return address
    return 0


def call_native(linearize: Any, x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """Call a linearisation: compiled code by its address, plain Python the function itself."""
    residual, jacobian = linearize(x, at, measured)
    return np.array(residual, dtype=np.float64), np.array(jacobian, dtype=np.float64)


@overload(call_native, jit_options={"error_model": "numpy"})
def _compiled_call(linearize: Any, x: Any, at: Any, measured: Any) -> Callable[..., Any]:
    def compiled(linearize: Any, x: Any, at: Any, measured: Any) -> Any:
        return _call(linearize, x, at, measured)  # type: ignore[call-arg]

    return compiled


@intrinsic
def _call(_: Any, address: Any, x: Any, at: Any, measured: Any) -> tuple[Any, Callable[..., Any]]:
    def generated(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        convention = context.call_conv
        of = convention.get_function_type(_RETURNED, _ARRAYS).as_pointer()
        function = builder.inttoptr(arguments[0], of)
        status, returned = convention.call_function(builder, function, _RETURNED, _ARRAYS, arguments[1:])
        with cgutils.if_unlikely(builder, status.is_error):  # type: ignore[no-untyped-call]
            convention.return_status_propagate(builder, status)
        return returned

    return _RETURNED(types.int64, x, at, measured), generated


# pointers of a graph: where its columns begin; how many edges there is room for; from TABLES on, where the pointers of
# each table are
KIND, OFFSET, INITIAL, TABLE_OF_EDGE, ROW_OF_EDGE, EDGE_ROOM, TABLES = range(7)
# pointers of a table: where its columns begin; the rows that there is room for
ID, VERTICES, MEASURED, SQRT_INFORMATION, LABEL, SOURCE, WEIGHT, ROOM = range(8)
# the sizes of its edge type; where its compiled linearisation begins, 0 where there is none
ENDS, MEASURED_SIZE, RESIDUAL_SIZE, WIDTH, LINEARIZE, TABLE_COLUMNS = range(8, 14)

FITS, NOT_FINITE, MISSING, ITSELF, OF_ANOTHER_KIND = range(5)


@inner
def table_at(graph: Index, table: int) -> Index:
    """Return the pointers of a table."""
    return integers(graph[TABLES + table], TABLE_COLUMNS)


@kernel
def labels_of(graph: Index, edges: Index) -> Index:
    """Return the codes (n,) of the classes of edges that exist."""
    table_of, row_of = integers(graph[TABLE_OF_EDGE], graph[EDGE_ROOM]), integers(graph[ROW_OF_EDGE], graph[EDGE_ROOM])
    out = np.empty(len(edges), np.int64)
    for k in range(len(edges)):
        table = table_at(graph, table_of[edges[k]])
        out[k] = integers(table[LABEL], table[ROOM])[row_of[edges[k]]]
    return out


@kernel
def weights_of(graph: Index, edges: Index) -> Array:
    """Return the weights (n,) of edges that exist."""
    table_of, row_of = integers(graph[TABLE_OF_EDGE], graph[EDGE_ROOM]), integers(graph[ROW_OF_EDGE], graph[EDGE_ROOM])
    out = np.empty(len(edges))
    for k in range(len(edges)):
        table = table_at(graph, table_of[edges[k]])
        out[k] = reals(table[WEIGHT], table[ROOM])[row_of[edges[k]]]
    return out


@kernel
def append_vertices(pointers: Index, first: int, numbers: int, values: Array, kind: int) -> int:
    """Append vertices of one kind with their values; or none, and return the row of one that is not finite.

    Parameters
    ----------
    first, numbers : vertices, and their stored numbers, that are there
    """
    count, size = values.shape
    kinds, offset = integers(pointers[KIND], first + count), integers(pointers[OFFSET], first + count)
    initial = reals(pointers[INITIAL], numbers + count * size)
    for k in range(count):
        for i in range(size):
            if not np.isfinite(values[k, i]):
                return k
            initial[numbers + k * size + i] = values[k, i]
        kinds[first + k], offset[first + k] = kind, numbers + k * size
    return -1


@kernel
def misfit(at: Index, measured: Array, kind: Index, accepted: Mask) -> tuple[int, int, int]:
    """Return what the first edge that cannot be is refused for, its row, and the slot of the vertex."""
    count, slots = at.shape
    for row in range(count):
        for k in range(measured.shape[1]):
            if not np.isfinite(measured[row, k]):
                return NOT_FINITE, row, 0
        for slot in range(slots):
            if at[row, slot] < 0 or at[row, slot] >= len(kind):
                return MISSING, row, slot
            for other in range(slot):
                if at[row, slot] == at[row, other]:
                    return ITSELF, row, slot
        for slot in range(slots):
            if not accepted[slot, kind[at[row, slot]]]:
                return OF_ANOTHER_KIND, row, slot
    return FITS, 0, 0


@kernel
def append_edges(
    graph: Index,
    pointers: Index,
    counts: tuple[int, int, int],
    at: Index,
    measured: Array,
    root: Array,
    accepted: Mask,
    codes: tuple[int, int, int],
) -> tuple[int, int, int]:
    """Append edges to a table; or none, where one does not fit. Returns that of ``misfit``.

    Parameters
    ----------
    graph, pointers : those of the graph, and of the table
    counts : vertices and edges of the graph, and edges of the table, that are there
    at : (n, k) vertices; measured : (n, p)
    root : the square root information of all, end to end, or one for all
    accepted : (k, kinds) whether a slot takes a kind
    codes : of the table, the class and the input
    """
    (vertices, edges, rows), (table, label, source), p = counts, codes, pointers
    found = misfit(at, measured, integers(graph[KIND], vertices), accepted)
    if found[0] != FITS:
        return found
    n, slots = at.shape
    size, of_root = measured.shape[1], p[RESIDUAL_SIZE] ** 2
    table_of, row_of = integers(graph[TABLE_OF_EDGE], edges + n), integers(graph[ROW_OF_EDGE], edges + n)
    ids, weight = integers(p[ID], rows + n), reals(p[WEIGHT], rows + n)
    labels, sources = integers(p[LABEL], rows + n), integers(p[SOURCE], rows + n)
    ends, seen = integers(p[VERTICES], (rows + n) * slots), reals(p[MEASURED], (rows + n) * size)
    roots = reals(p[SQRT_INFORMATION], (rows + n) * of_root)
    for k in range(n):
        row = rows + k
        table_of[edges + k], row_of[edges + k] = table, row
        ids[row], labels[row], sources[row], weight[row] = edges + k, label, source, 1.0
        for i in range(slots):
            ends[row * slots + i] = at[k, i]
        for i in range(size):
            seen[row * size + i] = measured[k, i]
        begin = k * of_root if len(root) > of_root else 0
        for i in range(of_root):
            roots[row * of_root + i] = root[begin + i]
    return found
