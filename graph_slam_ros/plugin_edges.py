"""Edge types of plugins: each is tested once, and what it raises names the plugin."""

from dataclasses import replace
from typing import Any

import numpy as np

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.graph import EdgeType
from graph_slam_ros.graph.check_edge import random_value
from graph_slam_ros.graph.edge_type import numeric_jacobian
from graph_slam_ros.plugins import in_one_line
from graph_slam_ros.typing import Array, Index

_TRIALS = 20  # at random values
_TOLERANCE = 1e-4  # of the largest number of a Jacobian


def fault_of(edge: EdgeType) -> str:
    """Try an edge type at random values, which also compiles it; return what is wrong with it, or nothing.

    A residual may raise at values that it is not made for: only what it returns is judged.
    """
    rng, tried, wrong = np.random.default_rng(0), 0, list[str]()
    for _ in range(_TRIALS):
        values = tuple(random_value(kinds[0], rng) for kinds in edge.accepts)
        measured = edge.whole(rng.standard_normal(edge.measured_size - len(edge.tail)))
        at = np.cumsum([0, *(value.size for value in values[:-1])])[None]
        try:
            residual, jacobian = edge.linearize(np.concatenate(values), at, measured[None])
            numeric = numeric_jacobian(edge, values, measured)
        except Exception:  # whatever another's function does
            continue
        if fault := _shape_fault(edge, residual, jacobian, 1):
            return fault
        if np.isfinite(jacobian).all() and np.isfinite(numeric).all():
            tried += 1
            off = np.abs(jacobian[0] - numeric)
            row, column = np.unravel_index(int(off.argmax()), off.shape)
            if off[row, column] > _TOLERANCE * max(1.0, float(np.abs(numeric).max())):
                ours, true = jacobian[0, row, column], numeric[row, column]
                wrong.append(f"Jacobian[{row}, {column}] is {ours:.6g}, the residual's derivative {true:.6g}")
    return wrong[0] if 2 * len(wrong) > tried else ""


def named(edge: EdgeType, plugin: str) -> EdgeType:
    """The same edge type, whose faults are a ConfigError that names the plugin."""

    def linearize(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
        try:
            out = edge.linearize(x, at, measured)
            fault = _shape_fault(edge, *out, len(at))
        except Exception as error:  # whatever another's function does
            fault = in_one_line(error)
        if fault:
            raise ConfigError(f"edge {edge.name!r}, {plugin}: {fault}")
        return out

    return replace(edge, linearize=linearize)


def _shape_fault(edge: EdgeType, residual: Any, jacobian: Any, count: int) -> str:
    due = (count, edge.residual_size), (count, edge.residual_size, sum(edge.dofs))
    shapes = np.shape(residual), np.shape(jacobian)
    return "" if shapes == due else f"shapes {shapes[0]} and {shapes[1]}, not {due[0]} and {due[1]}"
