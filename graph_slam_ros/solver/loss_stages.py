"""Losses in stages: an edge that has just arrived is held to the first of its loss, one update later to the last."""

import numpy as np

from graph_slam_ros.graph import Graph, records
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.graph.records import table_at
from graph_slam_ros.lie.addresses import integers, reals
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.batch import Settings
from graph_slam_ros.solver.linearization import Losses, chi2_of
from graph_slam_ros.solver.pending import NONE
from graph_slam_ros.typing import Array, Index


@kernel
def _differing(graph: Index, edges: Index, chi2: Array, losses: Index, others: Index) -> Index:
    """Return those of some edges that have different weights by two sets of losses (``Losses.pointers``)."""
    room = graph[records.EDGE_ROOM]
    table_of, row_of = integers(graph[records.TABLE_OF_EDGE], room), integers(graph[records.ROW_OF_EDGE], room)
    kind, scale = integers(losses[0], losses[2]), reals(losses[1], losses[2])
    other_kind, other_scale = integers(others[0], others[2]), reals(others[1], others[2])
    out, count = np.empty(len(edges), np.int64), 0
    for k in range(len(edges)):
        table, row = table_at(graph, table_of[edges[k]]), row_of[edges[k]]
        label = integers(table[records.LABEL], table[records.ROOM])[row]
        source = integers(table[records.SOURCE], table[records.ROOM])[row]
        square = chi2[k] * reals(table[records.WEIGHT], table[records.ROOM])[row]
        of, of_other = label * max(losses[3], 1), label * max(others[3], 1)
        of += source if losses[3] else 0
        of_other += source if others[3] else 0
        one, _ = weight_and_cost(kind[of], scale[of], square)
        other, _ = weight_and_cost(other_kind[of_other], other_scale[of_other], square)
        if one != other:
            out[count] = edges[k]
            count += 1
    return out[:count].copy()


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
        self._pointers = NONE
        self._made_for: tuple[int, int, Settings | None] = 0, 0, None  # so many labels and sources, and their settings

    def losses(self, settings: Settings) -> list[Losses]:
        """The losses of each stage."""
        labels, sources, made_for = self._made_for
        graph = self._graph
        if len(graph.labels) != labels or len(graph.sources) != sources or made_for is not settings:
            self._made_for = len(graph.labels), len(graph.sources), settings
            self._losses = [Losses(self._graph, given) for given in settings.stages()]
            self._pointers = np.concatenate((self._losses[0].pointers, self._losses[-1].pointers))
        return self._losses

    def pointers(self, settings: Settings) -> Index:
        """Pointers of the losses of the first stage, then of the last."""
        self.losses(settings)
        return self._pointers

    def of_new(self, edges: Index, settings: Settings) -> Index:
        """Return those of new edges that are held to the first stage: all of them, or none where there is but one."""
        return edges if len(self.losses(settings)) > 1 else NONE

    def mature(self, values: Array, settings: Settings) -> None:
        """Keep as young only edges whose weight differs between the first and the last stage of their loss."""
        if not len(self.young):
            return
        first, *_, last = self.losses(settings)
        chi2, _ = chi2_of(self._graph, values, self.young)
        self.young = _differing(self._graph.pointers, self.young, chi2, first.pointers, last.pointers)
