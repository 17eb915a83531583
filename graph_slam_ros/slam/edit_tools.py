"""Tools of edits by hand: the edges of a vertex, edges that are withdrawn or added by hand."""

from collections.abc import Sequence

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import EdgeType, Gaussian
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.landmarks.landmark_map import Landmarks
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.typing import Numbers

BY_HAND = "by_hand"
"""The class of edges that were let in or added by hand: they have no loss and are never judged."""
HAND_MADE = "by hand"
"""The input of edges that nobody measured: somebody added them by hand."""
_OUT = (Verdict.PENDING, Verdict.REJECTED)


class EditTools:
    """The parts of a map that edits change.

    Attributes
    ----------
    backend, landmarks
    counters : whatever is done or refused is counted under ``edit``
    """

    def __init__(self, backend: Backend, landmarks: Landmarks, counters: Counters) -> None:
        self.backend, self.landmarks, self.counters = backend, landmarks, counters

    def edges_of(self, *vertices: int) -> list[int]:
        """Edges of some vertices that have not been withdrawn, whether or not they are believed."""
        tables = self.backend.graph.tables.values()
        found = [table.at(np.flatnonzero(np.isin(table.vertices.values, vertices).any(axis=1))).ids for table in tables]
        edges = sorted(int(edge) for ids in found for edge in ids)
        return [edge for edge in edges if not self.backend.ledger.is_withdrawn(edge)]

    def determining(self, vertex: int) -> list[int]:
        """The edges of a landmark without those that are out or do not determine where it is."""
        graph, ledger = self.backend.graph, self.backend.ledger
        edges = [edge for edge in self.edges_of(vertex) if graph.label_of(edge) != "custom"]
        return [edge for edge in edges if ledger.verdict_of(edge) not in _OUT]

    def determines(self, edges: Sequence[int], vertex: int) -> bool:
        """Return whether edges measure as many numbers as a vertex has."""
        graph = self.backend.graph
        numbers = sum(graph.edge(edge).type.residual_size for edge in edges)
        return numbers >= graph.kind_of(vertex).dof

    def withdraw(self, edges: Sequence[int], keyframe: int) -> None:
        """Take edges out by hand, also those that are out for good for another reason."""
        ledger = self.backend.ledger
        for edge in edges:
            if ledger.is_withdrawn(edge):
                ledger.note(edge, keyframe, Verdict.REJECTED, Reason.BY_HAND, float(ledger.statistic.values[edge]))
        self.backend.withdraw(edges, keyframe, Reason.BY_HAND)

    def add(
        self,
        edge_type: EdgeType,
        vertices: Sequence[int],
        measured: Numbers,
        noise: Gaussian,
        keyframe: int,
        source: str = HAND_MADE,
    ) -> int:
        """Add an edge without a loss, which is never judged."""
        backend = self.backend
        edge = backend.graph.add_edge(edge_type, vertices, measured, noise, BY_HAND, source)
        backend.gate_new(keyframe)
        backend.ledger.put(edge, Verdict.NOT_EVALUATED, Reason.BY_HAND)
        return edge

    def copied(self, edge: int, vertex: int, other: int) -> int | None:
        """Add an edge again with another vertex; None for a survey of the vertex, or where its ends would be one."""
        graph = self.backend.graph
        one = graph.edge(edge)
        ends = tuple(other if end == vertex else end for end in one.vertices)
        if one.label == "surveyed" or len(set(ends)) < len(ends):
            return None
        return graph.add_edge(one.type, ends, one.measured, Gaussian(one.sqrt_information), one.label, one.source)

    def replace(self, copies: dict[int, int], pulling: Sequence[int], keyframe: int) -> None:
        """Judge copies of edges as the edges were: those that pulled do so until they are judged."""
        backend = self.backend
        backend.gate_new(keyframe)
        for copy in copies.values():
            if backend.graph.label_of(copy) == BY_HAND:
                backend.ledger.put(copy, Verdict.NOT_EVALUATED, Reason.BY_HAND)
        backend.decisions.exchange([copies[edge] for edge in pulling if edge in copies], [], keyframe)

    def refuse_held(self, vertex: int) -> None:
        """Raise GraphSlamError where a vertex is part of a frozen map."""
        if self.backend.solver.is_held(vertex):
            raise GraphSlamError(self.refusal("held_in_map"))

    def refusal(self, reason: str) -> str:
        """Count a reason; returns it in words."""
        self.counters.count("edit", reason)
        return _WHY[reason]


_WHY = {
    "unknown_edge": "it is not in the graph, or was taken out for good before",
    "needed_edge": "it is odometry or a prior, which is not judged: without it poses are undetermined",
    "held_in_map": "it is part of a frozen map, which never changes",
    "condensed_in_map": (
        "it is condensed, or not possible in a map with condensed visits: graph_slam replay RUN --out WHOLE --set "
        "map.condense=false makes the map of all keyframes, which can be edited"
    ),
}
