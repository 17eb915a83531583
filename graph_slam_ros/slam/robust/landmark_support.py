"""The edges that determine each landmark: whether one can be taken out."""

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Index

_TOGETHER = 8  # sightings that tell but a part each determine a landmark, wherever they are from


class LandmarkSupport:
    """Counts the accepted edges of each landmark.

    Parameters
    ----------
    inside : the edges that are in
    """

    def __init__(self, graph: Graph, solver: Solver, inside: Index) -> None:
        self._graph, self._solver = graph, solver
        self._holds: dict[int, int] = {}  # of each landmark, edges that are in of which one alone determines it
        self._helps: dict[int, int] = {}  # and those that do so only with others
        inside = inside[graph.has_label(inside, ("landmarks",))]
        for table, rows in graph.by_table(inside).items() if len(inside) else ():
            several = table.at(rows).vertices[:, 1]
            for landmark, times in zip(*map(np.ndarray.tolist, np.unique(several, return_counts=True)), strict=True):
                of = self._among(landmark, table.type.residual_size)
                of[landmark] = of.get(landmark, 0) + times
        for edge in graph.edges_of(PLACES).tolist():
            if (one := graph.edge(edge)).weight:
                for landmark in one.vertices[1:]:
                    self._holds[landmark] = self._holds.get(landmark, 0) + 1

    def count(self, edge: int, more: int) -> None:
        """Count an edge that comes in (1) or goes out (-1)."""
        if found := self._of(edge):
            found[1][found[0]] = found[1].get(found[0], 0) + more

    def is_needed(self, edge: int) -> bool:
        """Return whether a landmark may be undetermined without the edge: it is the last, or one of very few."""
        found = self._of(edge)
        if found is None:
            return False
        landmark, of = found
        return not self.is_determined(landmark, int(of is self._holds), int(of is self._helps))

    def is_determined(self, landmark: int, fewer_holds: int = 0, fewer_helps: int = 0) -> bool:
        """Return whether accepted edges determine a landmark, also with so many fewer."""
        if self._solver.is_held(landmark):
            return True
        holds, helps = self._holds.get(landmark, 0) - fewer_holds, self._helps.get(landmark, 0) - fewer_helps
        return holds >= 1 or helps >= _TOGETHER

    def _of(self, edge: int) -> tuple[int, dict[int, int]] | None:
        """The landmark of an edge, and the counts that it is in."""
        landmark = landmark_of(self._graph, edge)
        return (
            None if landmark is None else (landmark, self._among(landmark, self._graph.row(edge)[0].type.residual_size))
        )

    def _among(self, landmark: int, numbers: int) -> dict[int, int]:
        """The counts that an edge of a landmark is in, which measures so many numbers."""
        return self._holds if numbers >= self._graph.kind_of(landmark).dof else self._helps


def landmark_of(graph: Graph, edge: int) -> int | None:
    """The vertex of an edge's landmark."""
    return graph.ends_of(edge)[1] if graph.label_of(edge) == "landmarks" else None
