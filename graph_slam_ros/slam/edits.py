"""Edits by hand: an edge, or a landmark with all of its edges, is taken out of the graph while the robot drives."""

import re
from collections.abc import Mapping

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Control
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.landmarks.landmark_map import Landmarks
from graph_slam_ros.slam.robust.gating import CANDIDATES, landmark_of

SOURCE = "edit"
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
    """Removes edges and landmarks for good; whatever cannot be removed is counted under ``edit``.

    Parameters
    ----------
    backend : has the graph, its solver and the ledger
    landmarks : the landmarks of the graph, by name
    """

    def __init__(self, backend: Backend, landmarks: Landmarks, counters: Counters) -> None:
        self._backend, self._landmarks, self._counters = backend, landmarks, counters

    def remove(self, what: Mapping[str, bool | int | float | str], keyframe: int) -> bool:
        """Remove what a control event names, an edge or a landmark; returns whether it was there."""
        is_removed = "edge" in what and self.remove_edge(int(what["edge"]), keyframe)
        return ("landmark" in what and self.remove_landmark(str(what["landmark"]), keyframe)) or is_removed

    def clear_closures(self, keyframe: int) -> bool:
        """Remove all loop closures, but for those of a frozen map; returns whether there was any."""
        ledger = self._backend.ledger
        self._backend.hand_over()
        closures = [edge for edge in self._backend.graph.edges_of("closures").tolist() if edge >= ledger.final]
        self._backend.withdraw(closures, keyframe)
        if closures:
            self._counters.count("closures", "cleared", len(closures))
        return bool(closures)

    def remove_edge(self, edge: int, keyframe: int) -> bool:
        """Remove a loop closure, a fix or an observation of a landmark, by its id; returns whether it was there.

        A landmark is removed with the last of its edges.
        """
        backend = self._backend
        backend.hand_over()
        if not 0 <= edge < backend.graph.edge_count or backend.ledger.is_withdrawn(edge):
            return self._refuse("unknown_edge")
        if backend.graph.label_of(edge) not in CANDIDATES:
            return self._refuse("needed_edge")
        if edge < backend.ledger.final:
            return self._refuse("held_in_map")
        vertex = landmark_of(backend.graph, edge)
        if vertex is not None and self._determining(vertex) == [edge]:
            return self.remove_landmark(self._name_of(vertex), keyframe)
        backend.withdraw([edge], keyframe)
        self._counters.count(SOURCE, "removed")
        return True

    def remove_landmark(self, name: str, keyframe: int) -> bool:
        """Remove a landmark and its edges, by its name; returns whether it was there.

        What is observed of that name later begins another landmark.
        """
        backend = self._backend
        backend.hand_over()
        landmark = self._landmarks.known.get(name)
        if landmark is None:
            return self._refuse("unknown_landmark")
        if backend.solver.is_held(landmark.vertex):
            return self._refuse("held_in_map")
        backend.withdraw(self._edges_of(landmark.vertex), keyframe)
        backend.solver.remove(landmark.vertex)
        self._landmarks.forget({landmark.vertex})
        self._counters.count(SOURCE, "removed")
        return True

    def _name_of(self, vertex: int) -> str:
        return next((name for name, mark in self._landmarks.known.items() if mark.vertex == vertex), "")

    def _edges_of(self, vertex: int) -> list[int]:
        """Edges of a vertex that have not been withdrawn, whether or not they are believed."""
        tables = self._backend.graph.tables.values()
        found = [table.at(np.flatnonzero((table.vertices.values == vertex).any(axis=1))).ids for table in tables]
        edges = sorted(int(edge) for ids in found for edge in ids)
        return [edge for edge in edges if not self._backend.ledger.is_withdrawn(edge)]

    def _determining(self, vertex: int) -> list[int]:
        """The edges of a landmark without those that do not determine where it is."""
        return [edge for edge in self._edges_of(vertex) if self._backend.graph.label_of(edge) != "custom"]

    def _refuse(self, reason: str) -> bool:
        self._counters.count(SOURCE, reason)
        return False
