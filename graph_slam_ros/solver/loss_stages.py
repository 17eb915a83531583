"""Losses in stages: an edge that has just arrived is held to the first of its loss, one update later to the last."""

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.solver.batch import Settings
from graph_slam_ros.solver.linearization import Losses, chi2_of
from graph_slam_ros.solver.pending import NONE
from graph_slam_ros.typing import Array, Index


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
        key = len(self._graph.labels), len(self._graph.sources), settings
        if self._made_for[:2] != key[:2] or self._made_for[2] is not settings:
            self._made_for = key
            self._losses = [Losses(self._graph, given) for given in settings.stages()]
        return self._losses

    def of(self, edges: Index, settings: Settings) -> list[tuple[Index, Losses]]:
        """Return the edges grouped by their present loss."""
        stages = self.losses(settings)
        if not len(self.young):
            return [(edges, stages[-1])]
        known = np.sort(self.young)
        young = known[np.minimum(np.searchsorted(known, edges), len(known) - 1)] == edges  # faster than ``isin``
        return [(edges[young], stages[0]), (edges[~young], stages[-1])]

    def begin(self, edges: Index, settings: Settings) -> None:
        """Begin the first stage of new edges; earlier young edges are no longer young."""
        self.young = edges if len(self.losses(settings)) > 1 else NONE

    def mature(self, values: Array, settings: Settings) -> None:
        """Keep as young only edges whose weight differs between the first and the last stage of their loss."""
        if not len(self.young):
            return
        first, *_, last = self.losses(settings)
        chi2, _ = chi2_of(self._graph, values, self.young)
        changes = []
        for edge, fit in zip(self.young.tolist(), chi2.tolist(), strict=True):
            table, row = self._graph.row(edge)
            s, (code,) = fit * float(table.weight.values[row]), last.codes(table, np.array([row])).tolist()
            before, after = (weight_and_cost(one.kind[code], one.scale[code], s)[0] for one in (first, last))
            changes.append(before != after)
        self.young = self.young[changes]
