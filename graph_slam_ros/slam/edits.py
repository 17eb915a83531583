"""What a person removes from the map while the robot drives: an edge, a landmark, all loop closures."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Graph
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Control, Value
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.landmarks.landmark_map import Landmarks
from graph_slam_ros.slam.revision import Revision
from graph_slam_ros.slam.robust.gating import CANDIDATES
from graph_slam_ros.slam.robust.landmark_support import landmark_of
from graph_slam_ros.slam.robust.ledger import OUTSIDE, Ledger, Reason

SOURCE = "edit"
BY_HAND = "by_hand"
"""The class of edges that were let in or added by hand: they have no loss and are never judged."""
HAND_MADE = "by hand"
"""The input of edges that nobody measured: somebody added them by hand."""
_EDIT = re.compile(r"\s*(edge|landmark)\s+(\S.{0,127}?)\s*", re.DOTALL)
_ID = re.compile(r"\d{1,18}", re.ASCII)


def removal(text: str) -> Control:
    """The event that a text of ``~/remove`` asks for: ``edge 231`` or ``landmark dock``.

    Raises
    ------
    GraphSlamError
        It is neither.
    """
    found = _EDIT.fullmatch(text[:1000])
    if found and found[1] == "landmark":
        return Control("remove", (("landmark", found[2]),))
    if found and _ID.fullmatch(found[2]):
        return Control("remove", (("edge", int(found[2])),))
    raise GraphSlamError(f"~/remove: {text[:40]!r} is neither 'edge ID' nor 'landmark NAME'")


class Edits:
    """Removes parts of a map; whatever is done or refused is counted under ``edit``."""

    def __init__(self, backend: Backend, frontend: KeyframeFrontend, landmarks: Landmarks, counters: Counters) -> None:
        self._backend, self._frontend, self._landmarks, self._counters = backend, frontend, landmarks, counters

    def remove(self, what: Mapping[str, Value]) -> bool:
        """Remove what a control event names, an edge or a landmark; returns whether that was possible."""
        self._backend.hand_over()
        landmark = what.get("landmark")
        if landmark is None:
            reason = self._remove_edge(int(str(what.get("edge"))))
        elif self._frontend.path.keyframes.first:
            reason = "condensed_in_map"
        else:
            reason = self._remove_landmark(str(landmark))
        if reason:
            self._counters.count(SOURCE, reason)
        return reason == "removed"

    def clear_closures(self) -> bool:
        """Remove all loop closures, but for those of a frozen map; returns whether there was any."""
        ledger = self._backend.ledger
        self._backend.hand_over()
        closures = [edge for edge in self._backend.graph.edges_of("closures").tolist() if edge >= ledger.final]
        if done := bool(closures and self._withdraw(closures)):
            self._counters.count("closures", "cleared", len(closures))
        return done

    def _remove_edge(self, edge: int) -> str:
        """Remove an edge, and a landmark with the last edge that determines it; returns what is counted."""
        graph, ledger = self._backend.graph, self._backend.ledger
        if reason := why_not_removed(graph, ledger, edge):
            return reason
        vertex = landmark_of(graph, edge)
        if vertex is not None and determining(graph, ledger, vertex) == [edge]:
            name = next((name for name, mark in self._landmarks.known.items() if mark.vertex == vertex), "")
            return self._remove_landmark(name)
        return self._withdraw([edge])

    def _remove_landmark(self, name: str) -> str:
        """Remove a landmark and its edges; what is observed of that name later begins another."""
        backend, landmark = self._backend, self._landmarks.known.get(name)
        if landmark is None:
            return "unknown_landmark"
        if backend.solver.is_held(landmark.vertex):
            return "held_in_map"
        edges = standing_edges(backend.graph, backend.ledger, landmark.vertex)
        if done := self._withdraw(edges, landmark.vertex):
            self._landmarks.forget({landmark.vertex})
        return done

    def _withdraw(self, edges: Sequence[int], vertex: int | None = None) -> str:
        """Withdraw edges, and a vertex with all of its edges; returns what is counted, or nothing if that fails."""
        out = Revision(withdrawn=edges, vertex=vertex, reason=Reason.WITHDRAWN, solves="nothing")
        return "removed" if self._backend.apply(SOURCE, lambda: out) is not None else ""


def standing_edges(graph: Graph, ledger: Ledger, vertex: int) -> list[int]:
    """The edges of a vertex that have not been withdrawn, whether or not they are believed."""
    tables = graph.tables.values()
    found = [table.at(np.flatnonzero((table.vertices == vertex).any(axis=1))).ids for table in tables]
    return [edge for edge in sorted(int(e) for ids in found for e in ids) if not ledger.is_withdrawn(edge)]


def determining(graph: Graph, ledger: Ledger, vertex: int) -> list[int]:
    """The edges of a landmark without those that are out or do not determine where it is."""
    edges = standing_edges(graph, ledger, vertex)
    return [edge for edge in edges if ledger.verdict_of(edge) not in OUTSIDE]


def anchors(graph: Graph, ledger: Ledger) -> list[int]:
    """The edges that anchor the map: that of its beginning, and those that were added by hand."""
    by_hand = [edge for edge in graph.edges_of(BY_HAND).tolist() if len(graph.edge(edge).vertices) == 1]
    by_hand = [edge for edge in by_hand if graph.source_of(edge) == HAND_MADE]
    return [edge for edge in [*graph.edges_of("anchor").tolist(), *by_hand] if not ledger.is_withdrawn(edge)]


def why_not_removed(graph: Graph, ledger: Ledger, edge: int) -> str:
    """Return the reason why an edge cannot be removed; empty where it can."""
    if not graph.edge_ids.has(edge):
        return "condensed_in_map" if 0 <= edge < graph.edge_ids.next else "unknown_edge"
    if ledger.is_withdrawn(edge):
        return "unknown_edge"
    if graph.label_of(edge) not in (*CANDIDATES, BY_HAND) or anchors(graph, ledger) == [edge]:
        return "needed_edge"
    return "held_in_map" if edge < ledger.final else ""
