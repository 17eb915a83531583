"""Losses in stages: an edge that has just arrived is held to the first of its loss, one update later to the last."""

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.batch import Settings
from graph_slam_ros.solver.linearization import Losses, chi2_of, rows_of
from graph_slam_ros.solver.pending import NONE
from graph_slam_ros.typing import Array, Index


@kernel
def _differ(kind: Index, scale: Array, other_kind: Index, other_scale: Array, square: Array) -> NDArray[np.bool_]:
    """Return whether two losses give squared residuals (n,) different weights."""
    out = np.zeros(len(square), dtype=np.bool_)
    for k in range(len(square)):
        one, _ = weight_and_cost(kind[k], scale[k], square[k])
        other, _ = weight_and_cost(other_kind[k], other_scale[k], square[k])
        out[k] = one != other
    return out


class LossStages:
    """The present stage of each edge's loss.

    Attributes
    ----------
    young : edges that have had only one update
    """

    def __init__(self, graph: Graph) -> None:
        self.young = NONE
        self._graph = graph
        self._losses: list[Losses] = []
        self._made_for: tuple[int, int, Settings | None] = 0, 0, None  # so many labels and sources, and their settings

    def losses(self, settings: Settings) -> list[Losses]:
        """The losses of each stage."""
        labels, sources, made_for = self._made_for
        graph = self._graph
        if len(graph.labels) != labels or len(graph.sources) != sources or made_for is not settings:
            self._made_for = len(graph.labels), len(graph.sources), settings
            self._losses = [Losses(self._graph, given) for given in settings.stages()]
        return self._losses

    def begin(self, edges: Index, settings: Settings) -> None:
        """Begin the first stage of new edges; earlier young edges are no longer young."""
        self.young = edges if len(self.losses(settings)) > 1 else NONE

    def mature(self, values: Array, settings: Settings) -> None:
        """Keep as young only edges whose weight differs between the first and the last stage of their loss."""
        if not len(self.young):
            return
        first, *_, last = self.losses(settings)
        chi2, _ = chi2_of(self._graph, values, self.young)
        square, code = np.empty(self._graph.edge_count), np.zeros(self._graph.edge_count, dtype=np.int64)
        square[self.young] = chi2
        for table, rows in rows_of(self._graph, self.young).items():
            ids = table.id.values[rows]
            square[ids] *= table.weight.values[rows]
            code[ids] = last.codes(table, rows)
        of = code[self.young]
        losses = first.kind[of], first.scale[of], last.kind[of], last.scale[of]
        self.young = self.young[_differ(*losses, square[self.young])]
