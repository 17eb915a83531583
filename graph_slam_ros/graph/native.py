"""Calls of an edge type's compiled linearisation by its address, from compiled code that does not know which it is."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from graph_slam_ros.typing import Array, Index

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


def native_or_plain(kernel: Callable[..., Any], linearize: Sequence[Callable[..., Any]]) -> tuple[Any, list[Any]]:
    """Return a kernel and what it calls these linearisations by: addresses, or if one has none, all as plain Python."""
    addresses = [native_address(one) for one in linearize]
    return (kernel, addresses) if all(addresses) else (getattr(kernel, "py_func", kernel), list(linearize))


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
