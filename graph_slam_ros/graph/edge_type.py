"""What an edge type is: residual and Jacobian of one kind of measurement, a whole array of edges at a time.

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
from numpy.typing import NDArray

from graph_slam_ros.graph.vertices import VertexKind

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class EdgeType:
    """What was measured, between which vertices, and how it is linearised.

    Attributes
    ----------
    accepts : for each slot the vertex kinds it takes, all of the same dof
    """

    name: str
    accepts: tuple[tuple[VertexKind, ...], ...]
    measured_size: int
    residual_size: int
    linearize: Callable[[Array, Index, Array], tuple[Array, Array]]

    @property
    def dofs(self) -> tuple[int, ...]:
        """Degrees of freedom of each slot."""
        return tuple(kinds[0].dof for kinds in self.accepts)


def numeric_jacobian(edge: EdgeType, values: tuple[Array, ...], measured: Array, step: float = 1e-6) -> Array:
    """Jacobian (m, D) of one edge by central differences through ``retract``: the check of every analytic one.

    Parameters
    ----------
    values : the stored numbers of each of the edge's vertices, of the kinds ``edge.accepts`` names first
    measured : (p,)
    """
    kinds = [accepted[0] for accepted in edge.accepts]
    at = np.cumsum([0, *(k.size for k in kinds[:-1])]).astype(np.int64)[None, :]

    def residual(slot: int, d: Array) -> Array:
        moved = [np.asarray(v, dtype=float) for v in values]
        moved[slot] = kinds[slot].retract(moved[slot][None, :], d[None, :])[0]
        return edge.linearize(np.concatenate(moved), at, np.asarray(measured, dtype=float)[None, :])[0][0]

    columns = []
    for slot, kind in enumerate(kinds):
        for d in step * np.eye(kind.dof):
            columns.append((residual(slot, d) - residual(slot, -d)) / (2.0 * step))
    return np.stack(columns, axis=1)
