"""Edge types of plugins for the running pipeline: each is tested once, and its failure never ends a run."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.graph import SE2, SE3, EdgeType, VertexKind
from graph_slam_ros.graph.edge_type import numeric_jacobian
from graph_slam_ros.graph.vertices import GROUPS
from graph_slam_ros.plugins import in_one_line
from graph_slam_ros.typing import Array, Index, Numbers

_TRIALS, _SPREAD = 20, 3.0  # at random values [m, rad]
_TOLERANCE = 1e-4  # of the largest number of a Jacobian


@dataclass(frozen=True, slots=True)
class FailedEdge:
    """An edge at which its plugin failed.

    Attributes
    ----------
    tag : of its edge type
    at : where its vertices begin in the stored numbers
    measured : what was measured
    fault : what went wrong, in one line that names the plugin
    """

    tag: str
    at: tuple[int, ...]
    measured: Numbers
    fault: str


_failed: ContextVar[dict[tuple[str, tuple[int, ...], Numbers], FailedEdge] | None] = ContextVar("failed", default=None)


@contextmanager
def failed_edges() -> Iterator["dict[tuple[str, tuple[int, ...], Numbers], FailedEdge]"]:
    """Collect the edges of maps at which a plugin fails until the end of the context."""
    found: dict[tuple[str, tuple[int, ...], Numbers], FailedEdge] = {}
    before = _failed.set(found)
    try:
        yield found
    finally:
        _failed.reset(before)


def fault_of(edge: EdgeType) -> str:
    """Try an edge type at random values, which also compiles it; return what is wrong with it, or nothing.

    A residual may raise at values that it is not made for: only what it returns is judged.
    """
    rng, tried, wrong = np.random.default_rng(0), 0, list[str]()
    for _ in range(_TRIALS):
        values = tuple(_random(kinds[0], rng) for kinds in edge.accepts)
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


def measured_at_stamps(edge: EdgeType) -> EdgeType:
    """The same edge type between keyframes: its poses are those of the robot at the stamp of the measurement.

    Behind what is measured come, for each slot of a pose in order, the numbers of ``T_keyframe_base``: the motion from
    the keyframe to the stamp. They may be left out where the robot was at the keyframe, and are the identity for a
    landmark. With ``x Exp(d) T = x T Exp(Ad(T)^-1 d)`` the Jacobian follows.
    """
    slots = {slot: kinds[0] for slot, kinds in enumerate(edge.accepts) if kinds in ((SE2,), (SE3,))}
    sizes, dofs = [kinds[0].size for kinds in edge.accepts], edge.dofs
    first = np.cumsum([0, *dofs])
    identities = [x for kind in slots.values() for x in GROUPS[kind].IDENTITY]

    def one(x: Array, begins: Sequence[int], z: Array) -> tuple[Array, Array]:
        """One edge whose robot has moved since a keyframe."""
        values = [x[begin : begin + size] for begin, size in zip(begins, sizes, strict=True)]
        motions, end = {}, edge.measured_size
        for slot, kind in slots.items():
            motions[slot], end = tuple(z[end : end + kind.size].tolist()), end + kind.size
            values[slot] = np.array(GROUPS[kind].compose(tuple(values[slot].tolist()), motions[slot]))
        at = np.cumsum([0, *sizes[:-1]])[None]
        residual, jacobian = edge.linearize(np.concatenate(values), at, z[None, : edge.measured_size])
        jacobian = np.array(jacobian)
        for slot, T_keyframe_base in motions.items():
            group, columns = GROUPS[slots[slot]], slice(first[slot], first[slot + 1])
            jacobian[..., columns] = jacobian[..., columns] @ group.adjoint(group.inverse(T_keyframe_base))
        return residual, jacobian

    def linearize(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
        moved = (measured[:, edge.measured_size :] != identities).any(axis=1)
        still = np.flatnonzero(~moved)
        if len(still) == len(at):
            return edge.linearize(x, at, np.ascontiguousarray(measured[:, : edge.measured_size]))
        residuals = np.empty((len(at), edge.residual_size))
        jacobians = np.empty((len(at), edge.residual_size, sum(dofs)))
        if len(still):
            z = np.ascontiguousarray(measured[still, : edge.measured_size])
            residuals[still], jacobians[still] = edge.linearize(x, at[still], z)
        for e in np.flatnonzero(moved).tolist():
            r, j = one(x, at[e].tolist(), measured[e])
            residuals[e : e + 1], jacobians[e : e + 1] = r, j
        return residuals, jacobians

    size = edge.measured_size + len(identities)
    return replace(edge, measured_size=size, linearize=linearize, tail=(*edge.tail, *identities))


def named(edge: EdgeType, plugin: str) -> EdgeType:
    """The same edge type, whose faults are a ConfigError that names the plugin."""

    def linearize(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
        out = _linearized(edge, x, at, measured)
        if isinstance(out, str):
            raise ConfigError(f"edge {edge.name!r}, {plugin}: {out}")
        return out

    return replace(edge, linearize=linearize)


def isolated(edge: EdgeType, tag: str, plugin: str) -> EdgeType:
    """The same edge type, where an edge that fails has no residual and no derivative, and is in ``failed_edges``."""

    def linearize(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
        out = _linearized(edge, x, at, measured)
        if not isinstance(out, str) and np.isfinite(out[0].sum() + out[1].sum()):
            return out
        residuals = np.zeros((len(at), edge.residual_size))
        jacobians = np.zeros((len(at), edge.residual_size, sum(edge.dofs)))
        for e in range(len(at)):
            alone = _linearized(edge, x, at[e : e + 1], measured[e : e + 1])
            if not isinstance(alone, str) and not (np.isfinite(alone[0]).all() and np.isfinite(alone[1]).all()):
                alone = "its residual or Jacobian is not finite"
            if isinstance(alone, str):
                _note(tag, at[e].tolist(), measured[e].tolist(), f"edge {edge.name!r}, {plugin}: {alone}")
            else:
                residuals[e], jacobians[e] = alone[0][0], alone[1][0]
        return residuals, jacobians

    return replace(edge, linearize=linearize)


def _note(tag: str, at: Sequence[int], measured: Sequence[float], fault: str) -> None:
    found = _failed.get()
    if found is not None:
        key = tag, tuple(at), tuple(measured)
        found.setdefault(key, FailedEdge(*key, fault))


def _linearized(edge: EdgeType, x: Array, at: Index, measured: Array) -> tuple[Array, Array] | str:
    """Residuals and Jacobians, or what is wrong with them."""
    try:
        residuals, jacobians = edge.linearize(x, at, measured)
        fault = _shape_fault(edge, residuals, jacobians, len(at))
    except Exception as error:  # whatever another's function does
        return in_one_line(error)
    return fault or (residuals, jacobians)


def _shape_fault(edge: EdgeType, residual: Any, jacobian: Any, count: int) -> str:
    due = (count, edge.residual_size), (count, edge.residual_size, sum(edge.dofs))
    shapes = np.shape(residual), np.shape(jacobian)
    return "" if shapes == due else f"shapes {shapes[0]} and {shapes[1]}, not {due[0]} and {due[1]}"


def _random(kind: VertexKind, rng: np.random.Generator) -> Array:
    origin = np.array(GROUPS[kind].IDENTITY if kind in GROUPS else [0.0] * kind.size)
    return kind.retract(origin[None], _SPREAD * rng.standard_normal((1, kind.dof)))[0]
