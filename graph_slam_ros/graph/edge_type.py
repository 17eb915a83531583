"""Edge types: residual and Jacobian of one kind of measurement, a whole array of edges at a time.

An edge type's ``linearize(x, at, measured)`` gets

* ``x`` : the stored numbers of all vertices in one flat array,
* ``at`` : (n, k) where each edge's k vertices begin in ``x``,
* ``measured`` : (n, p),

and returns the residuals (n, m) and their Jacobians (n, m, D) with respect to the right perturbations of the k
vertices, side by side (D is the sum of their degrees of freedom). Nothing here is whitened or weighted.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph.vertices import GROUPS, VertexKind
from graph_slam_ros.typing import Array, Index


@dataclass(frozen=True, slots=True, eq=False)
class EdgeType:
    """A kind of measurement: its vertices, its residual and its Jacobian.

    Attributes
    ----------
    accepts : for each slot, one or more, the vertex kinds it takes, all of the same dof
    tail : what the last numbers of ``measured`` are where they are left out: a sensor's place on the robot
    """

    name: str
    accepts: tuple[tuple[VertexKind, ...], ...]
    measured_size: int
    residual_size: int
    linearize: Callable[[Array, Index, Array], tuple[Array, Array]]
    tail: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        kinds_of_each = tuple(one if isinstance(one, tuple) else (one,) for one in self.accepts)
        object.__setattr__(self, "accepts", kinds_of_each)  # one kind may stand without its tuple
        if not self.accepts:
            raise GraphSlamError(f"{self.name}: 0 vertices; an edge has at least one")
        for slot, kinds in enumerate(self.accepts):
            if len({kind.dof for kind in kinds}) != 1:
                names = ", ".join(kind.name for kind in kinds) or "nothing"
                raise GraphSlamError(f"{self.name}: slot {slot} takes {names}: not kinds of one and the same dof")
        if min(self.residual_size, self.measured_size - len(self.tail)) < 0 or not self.residual_size:
            measured = f"a measurement of {self.measured_size} with a tail of {len(self.tail)}"
            raise GraphSlamError(f"{self.name}: a residual of {self.residual_size} numbers, {measured}")

    @property
    def dofs(self) -> tuple[int, ...]:
        """Degrees of freedom of each slot."""
        return tuple(kinds[0].dof for kinds in self.accepts)

    def whole(self, measured: ArrayLike) -> Array:
        """Return measurements (p,) or (n, p), with ``tail`` appended where it is missing."""
        given = np.asarray(measured, dtype=np.float64)
        if self.tail and given.shape and given.shape[-1] == self.measured_size - len(self.tail):
            return np.concatenate([given, np.broadcast_to(self.tail, (*given.shape[:-1], len(self.tail)))], axis=-1)
        return given


Residual = Callable[[tuple[Array, ...], Array], ArrayLike]


def edge_from_residual(
    name: str,
    accepts: tuple[tuple[VertexKind, ...], ...],
    measured_size: int,
    residual_size: int,
    residual: Residual,
    jacobian: Residual | None = None,
) -> EdgeType:
    """Make an edge type from a function of one edge in plain Python.

    Parameters
    ----------
    residual : the stored numbers of the edge's vertices, and what was measured (p,), to what they disagree by (m,).
        An angle in it must be wrapped to (-pi, pi]
    jacobian : the same to (m, D), over the right perturbations side by side; without it, central differences are used
    """
    accepts = (accepts,) if isinstance(accepts, VertexKind) else accepts
    kinds = tuple(one[0] if isinstance(one, tuple) else one for one in accepts)

    def checked(values: tuple[Array, ...], measured: Array) -> Array:
        found = np.atleast_1d(np.asarray(residual(values, measured), dtype=np.float64))
        if found.shape != (residual_size,):
            raise GraphSlamError(f"{name}: the residual has the shape {found.shape}, not ({residual_size},)")
        return found

    derivative = jacobian or (lambda values, measured: _differences(kinds, values, lambda v: checked(v, measured)))

    def linearize(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
        residuals = np.empty((len(at), residual_size))
        jacobians = np.empty((len(at), residual_size, sum(kind.dof for kind in kinds)))
        for e, begins in enumerate(at.tolist()):
            values = tuple(x[begin : begin + kind.size] for begin, kind in zip(begins, kinds, strict=True))
            residuals[e], jacobians[e] = checked(values, measured[e]), derivative(values, measured[e])
        return residuals, jacobians

    return EdgeType(name, accepts, measured_size, residual_size, linearize)


def numeric_jacobian(edge: EdgeType, values: tuple[Array, ...], measured: Array, step: float = 1e-6) -> Array:
    """Return the Jacobian (m, D) of one edge by central differences through ``retract``, to check analytic ones.

    Parameters
    ----------
    values : the stored numbers of each of the edge's vertices, of the kinds ``edge.accepts`` names first
    measured : (p,)
    """
    kinds = tuple(accepted[0] for accepted in edge.accepts)
    at = np.cumsum([0, *(k.size for k in kinds[:-1])]).astype(np.int64)[None, :]
    z = np.asarray(measured, dtype=float)[None, :]
    return _differences(kinds, values, lambda moved: edge.linearize(np.concatenate(moved), at, z)[0][0], step)


def _differences(
    kinds: tuple[VertexKind, ...],
    values: tuple[Array, ...],
    residual: Callable[[tuple[Array, ...]], ArrayLike],
    step: float = 1e-6,
) -> Array:
    """Return the derivative (m, D) over the right perturbations, also where an angle crosses the cut."""

    def at(slot: int, d: Array) -> Array:
        moved = [np.asarray(v, dtype=float) for v in values]
        moved[slot] = kinds[slot].retract(moved[slot][None, :], d[None, :])[0]
        return np.asarray(residual(tuple(moved)), dtype=float)

    columns = []
    for slot, kind in enumerate(kinds):
        for d in step * np.eye(kind.dof):
            change = at(slot, d) - at(slot, -d)
            columns.append((change - 2.0 * np.pi * np.round(change / (2.0 * np.pi))) / (2.0 * step))
    return np.stack(columns, axis=1)


_SPREAD = 5.0  # of random positions and measurements
_TRIALS = 50


def check_edge(
    edge: EdgeType, measured: Callable[[np.random.Generator], ArrayLike] | None = None, tolerance: float = 1e-5
) -> None:
    """Check an edge type at random values of its vertices.

    Parameters
    ----------
    measured : draws what was measured (p,) where not any numbers will do, e.g. a positive range
    tolerance : of the Jacobian, as a part of its largest number; central differences leave some 1e-9

    Raises
    ------
    GraphSlamError
        Arrays of the wrong shape, a number that is not finite, a Jacobian that is not the derivative of the residual,
        inputs written into, or edges of one call that depend on each other; with the values where it was seen.
    """
    rng = np.random.default_rng(0)
    kinds = [accepted[0] for accepted in edge.accepts]
    trials = [
        (tuple(random_value(kind, rng) for kind in kinds), _measured(edge, measured, rng)) for _ in range(_TRIALS)
    ]
    alone = [_linearized(edge, [trial]) for trial in trials]
    for (values, z), (residual, jacobian) in zip(trials, alone, strict=True):
        at = f"at vertices {[v.tolist() for v in values]} and measured {z.tolist()}"
        if not (np.isfinite(residual).all() and np.isfinite(jacobian).all()):
            raise GraphSlamError(f"{edge.name}: not finite {at}")
        if fault := jacobian_fault(edge, values, z, tolerance):
            raise GraphSlamError(f"{edge.name}: {fault} {at}")
    together = _linearized(edge, trials)
    for e, one in enumerate(alone):
        if not all(np.allclose(a[e], b[0], rtol=1e-9, atol=1e-12) for a, b in zip(together, one, strict=True)):
            raise GraphSlamError(f"{edge.name}: edges linearised in one call are not what each is alone")


def jacobian_fault(edge: EdgeType, values: tuple[Array, ...], measured: Array, tolerance: float) -> str | None:
    """Return where a Jacobian is not the derivative of the residual: empty if it is, None where one is not finite."""
    jacobian, numeric = _linearized(edge, [(values, measured)])[1][0], numeric_jacobian(edge, values, measured)
    off = np.abs(jacobian - numeric)
    if not np.isfinite(off).all():
        return None
    row, column = np.unravel_index(int(off.argmax()), off.shape)
    if off[row, column] <= tolerance * max(1.0, float(np.abs(numeric).max())):
        return ""
    ours, true = jacobian[row, column], numeric[row, column]
    return f"Jacobian[{row}, {column}] is {ours:.6g}, the residual's derivative {true:.6g}"


def random_value(kind: VertexKind, rng: np.random.Generator) -> Array:
    """Return a value some metres and radians from the origin."""
    origin = np.array(GROUPS[kind].IDENTITY if kind in GROUPS else [0.0] * kind.size)
    return kind.retract(origin[None], _SPREAD * rng.standard_normal((1, kind.dof)))[0]


def _measured(
    edge: EdgeType, draw: Callable[[np.random.Generator], ArrayLike] | None, rng: np.random.Generator
) -> Array:
    if draw is None:
        return rng.standard_normal(edge.measured_size)
    value = edge.whole(draw(rng))
    if value.shape != (edge.measured_size,):
        raise GraphSlamError(f"{edge.name}: measured has the shape {value.shape}, not ({edge.measured_size},)")
    return value


def _linearized(edge: EdgeType, trials: list[tuple[tuple[Array, ...], Array]]) -> tuple[Array, Array]:
    """Return residuals and Jacobians of all edges in one call, the numbers of their vertices one after the other."""
    x = np.concatenate([value for values, _ in trials for value in values])
    ends = np.cumsum([value.size for values, _ in trials for value in values])
    at = np.concatenate(([0], ends[:-1])).reshape(len(trials), -1)
    z = np.stack([measured for _, measured in trials])
    before = x.copy(), at.copy(), z.copy()
    residual, jacobian = edge.linearize(x, at, z)
    if not all(np.array_equal(now, then) for now, then in zip((x, at, z), before, strict=True)):
        raise GraphSlamError(f"{edge.name}: linearize writes into what it was given")
    expected = (len(trials), edge.residual_size), (len(trials), edge.residual_size, sum(edge.dofs))
    shapes = np.shape(residual), np.shape(jacobian)
    if shapes != expected:
        raise GraphSlamError(f"{edge.name}: shapes {shapes[0]} and {shapes[1]}, not {expected[0]} and {expected[1]}")
    return residual, jacobian
