"""A check of an edge type that a user has written: the solver's assumptions about it must hold."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph.edge_type import EdgeType, numeric_jacobian
from graph_slam_ros.graph.vertices import GROUPS, VertexKind
from graph_slam_ros.typing import Array

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
        numeric = numeric_jacobian(edge, values, z)
        off = np.abs(jacobian[0] - numeric)
        if off.max() > tolerance * max(1.0, float(np.abs(numeric).max())):
            row, column = np.unravel_index(int(off.argmax()), off.shape)
            raise GraphSlamError(
                f"{edge.name}: Jacobian[{row}, {column}] is {jacobian[0, row, column]:.6g}, the residual's derivative"
                f" {numeric[row, column]:.6g} {at}"
            )
    together = _linearized(edge, trials)
    for e, one in enumerate(alone):
        if not all(np.allclose(a[e], b[0], rtol=1e-9, atol=1e-12) for a, b in zip(together, one, strict=True)):
            raise GraphSlamError(f"{edge.name}: edges linearised in one call are not what each is alone")


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
    if (residual.shape, jacobian.shape) != expected:
        raise GraphSlamError(
            f"{edge.name}: shapes {residual.shape} and {jacobian.shape}, not {expected[0]} and {expected[1]}"
        )
    return residual, jacobian
