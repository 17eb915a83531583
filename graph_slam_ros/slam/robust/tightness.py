"""Tightness: by what the gate of a class is smaller, because its residuals are smaller than its noise says.

With a configured noise that is ten times too large, a gate would accept everything. Residuals show that only where
several measurements say the same. A closure of 1 mm after rough odometry fits exactly once it is accepted, whatever its
noise is: nothing else says as much. So residuals are compared with what the edges' redundancy leaves of their noise.
"""

from functools import cache

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.solver import Solver
from graph_slam_ros.solver.linearization import rows_of
from graph_slam_ros.typing import Array, Index

TYPICAL = 30  # residuals tell what all are like
_SLACK = 10.0  # times the residuals that are typical of a class its gate may be, where they are small
TIGHTEST = 0.1  # part of a gate that is left
_REDUNDANT = 0.05  # of a measurement, that others say too: below, its residual says nothing of its noise
_GROWN = 1.5  # times as many edges: their redundancy is computed again


class Tightness:
    """The factor of each class's gate, from 0.1 to 1."""

    def __init__(self, graph: Graph, solver: Solver) -> None:
        self._graph, self._solver = graph, solver
        self.of_class: dict[str, float] = {}
        self._redundancy: dict[str, tuple[int, float]] = {}  # of each class: of so many edges, a median

    def update(self, label: str, edges: Index, chi2: Array, numbers: Index) -> None:
        """Compare the residuals of a class's accepted edges with their noise. False ones do not change a median."""
        if len(edges) < TYPICAL:
            return
        ratio = _SLACK * float(np.median(chi2 / np.array([_median(n) for n in numbers.tolist()])))
        if ratio < 1.0:
            redundancy = self._redundancy_of(label, edges)
            ratio = ratio / redundancy if redundancy >= _REDUNDANT else 1.0
        self.of_class[label] = min(1.0, max(TIGHTEST, ratio))

    def _redundancy_of(self, label: str, edges: Index) -> float:
        """Return the median redundancy of a class, by some of its edges, from 0 to 1; of old ones while it grows."""
        count, known = self._redundancy.get(label, (0, 0.0))
        if len(edges) >= _GROWN * count:
            some = np.linspace(0, len(edges) - 1, TYPICAL).astype(int)
            try:
                found = [self._left_of(*of_table) for of_table in rows_of(self._graph, edges[some]).items()]
            except (GraphSlamError, np.linalg.LinAlgError):
                return known
            known = float(np.median(np.concatenate(found)))
            self._redundancy[label] = len(edges), known
        return known

    def _left_of(self, table: EdgeTable, rows: Index) -> Array:
        """Return the expected chi2 (n,) of the residuals of accepted edges, for each number that they measure."""
        some = table.at(rows)
        ends = some.vertices
        joint = self._solver.edge_marginals(ends)
        _, jacobian = table.type.linearize(self._solver.values, self._graph.offset.values[ends], some.measured)
        white = some.sqrt_information @ jacobian
        return 1.0 - np.einsum("nij,njk,nik->n", white, joint, white) / white.shape[1]


@cache
def _median(numbers: int) -> float:
    return quantile(0.5, numbers)
