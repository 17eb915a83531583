"""Edits by hand, while the robot drives or afterwards: edges and landmarks are taken out, let in, renamed or merged."""

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.edits import AppliedEdit, Value, aliases, edit_of
from graph_slam_ros.measurements.types import Control, Event
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.landmarks.landmark_map import Landmark, Landmarks
from graph_slam_ros.slam.robust.gating import CANDIDATES, landmark_of
from graph_slam_ros.slam.robust.ledger import INSIDE, Reason, Verdict

SOURCE = "edit"
BY_HAND = "by_hand"
"""The class of edges that were let in by hand: they have no loss and are never judged."""
_EDIT = re.compile(r"\s*(edge|landmark)\s+(\S.{0,127}?)\s*", re.DOTALL)
_ID = re.compile(r"\d{1,18}", re.ASCII)
_OUT = (Verdict.PENDING, Verdict.REJECTED)
_WHY = {
    "unknown_edge": "it is not in the graph, or was taken out for good before",
    "needed_edge": "it is odometry or a prior, which is not judged: without it poses are undetermined",
    "held_in_map": "it is part of a frozen map, which never changes",
    "unknown_landmark": "it is not in the map",
}


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
    """Changes a map by hand; whatever cannot be done is counted under ``edit``.

    Parameters
    ----------
    backend : has the graph, its solver and the ledger
    landmarks : the landmarks of the graph, by name
    """

    def __init__(self, backend: Backend, landmarks: Landmarks, counters: Counters) -> None:
        self._backend, self._landmarks, self._counters = backend, landmarks, counters
        self._refused = ""
        landmarks.aliases = aliases(backend.edits)

    def change(self, event: Event, values: Mapping[str, Value], keyframe: int) -> bool:
        """Change what a control event asks for; returns whether all is to be solved at once."""
        if event == "edit":
            self.apply(values, keyframe)  # others may follow: ``optimize`` solves
            return False
        return self.remove(values, keyframe)

    def apply(self, values: Mapping[str, Value], keyframe: int) -> None:
        """Apply an edit of a plan, and note it in the map; nothing is solved.

        Raises
        ------
        GraphSlamError
            It cannot be applied to this map: nothing has changed.
        """
        edit, backend = edit_of(values), self._backend
        if any(one.edit.name == edit.name for one in backend.edits):
            raise GraphSlamError(f"edit {edit.name}: the map has an edit of that name already")
        backend.gate_new(keyframe)
        edges, changes = backend.graph.edge_count, len(backend.ledger.history)
        a = edit.arguments
        is_done = {
            "remove_edge": lambda: self.remove_edge(int(a["edge"]), keyframe, Reason.BY_HAND),
            "let_in_edge": lambda: self._add_by_hand(int(a["edge"]), keyframe),
            "remove_landmark": lambda: self.remove_landmark(str(a["landmark"]), keyframe, Reason.BY_HAND),
            "rename_landmark": lambda: self._rename(str(a["landmark"]), str(a["to"])),
            "merge_landmarks": lambda: self._merge(str(a["landmark"]), str(a["into"]), keyframe),
        }[edit.do]()
        if not is_done:
            raise GraphSlamError(f"edit {edit.name}: {edit.text}: {self._refused}")
        decided = [one.edge for one in backend.ledger.history[changes:] if one.reason is Reason.BY_HAND]
        out = tuple(edge for edge in dict.fromkeys(decided) if edge < edges)
        added = tuple(range(edges, backend.graph.edge_count))
        backend.edits.append(AppliedEdit(edit, keyframe, out, added))
        self._landmarks.aliases = aliases(backend.edits)

    def remove(self, what: Mapping[str, Value], keyframe: int) -> bool:
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

    def remove_edge(self, edge: int, keyframe: int, reason: Reason = Reason.WITHDRAWN) -> bool:
        """Remove a loop closure, a fix or an observation of a landmark, by its id; returns whether it was there.

        A landmark is removed with the last of its edges.
        """
        backend = self._backend
        backend.hand_over()
        if not 0 <= edge < backend.graph.edge_count or backend.ledger.is_withdrawn(edge):
            return self._refuse("unknown_edge")
        if backend.graph.label_of(edge) not in (*CANDIDATES, BY_HAND):
            return self._refuse("needed_edge")
        if edge < backend.ledger.final:
            return self._refuse("held_in_map")
        vertex = landmark_of(backend.graph, edge)
        if vertex is not None and self._determining(vertex) == [edge]:
            return self.remove_landmark(self._name_of(vertex), keyframe, reason)
        backend.withdraw([edge], keyframe, reason)
        self._counters.count(SOURCE, "removed")
        return True

    def remove_landmark(self, name: str, keyframe: int, reason: Reason = Reason.WITHDRAWN) -> bool:
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
        backend.withdraw(self._edges_of(landmark.vertex), keyframe, reason)
        backend.solver.remove(landmark.vertex)
        self._landmarks.forget({landmark.vertex})
        self._counters.count(SOURCE, "removed")
        return True

    def _add_by_hand(self, edge: int, keyframe: int) -> bool:
        """An edge without a loss, which is never judged, replaces an edge that may be out."""
        backend, graph = self._backend, self._backend.graph
        if edge >= graph.edge_count:
            return self._refuse("unknown_edge")
        one = graph.edge(edge)
        if one.label not in CANDIDATES:
            return self._refuse("needed_edge")
        if edge < backend.ledger.final:
            return self._refuse("held_in_map")
        if not np.isin(one.vertices, backend.solver.vertices).all():
            return self._fail("its landmark is not in the map any more")
        added = graph.add_edge(
            one.type, one.vertices, one.measured, Gaussian(one.sqrt_information), BY_HAND, one.source
        )
        self._withdraw([edge], keyframe)
        backend.gate_new(keyframe)
        backend.ledger.put(added, Verdict.NOT_EVALUATED, Reason.BY_HAND)
        self._counters.count(SOURCE, "let_in")
        return True

    def _withdraw(self, edges: list[int], keyframe: int) -> None:
        """Take edges out by hand, also those that are out for good for another reason."""
        ledger = self._backend.ledger
        for edge in edges:
            if ledger.is_withdrawn(edge):
                ledger.note(edge, keyframe, Verdict.REJECTED, Reason.BY_HAND, float(ledger.statistic.values[edge]))
        self._backend.withdraw(edges, keyframe, Reason.BY_HAND)

    def _rename(self, name: str, to: str) -> bool:
        known = self._landmarks.known
        if name not in known:
            return self._refuse("unknown_landmark")
        if to in known:
            return self._fail(f"another landmark is named {to}: merge_landmarks makes one of two")
        landmark = known[to] = known.pop(name)
        landmark.name = to
        self._landmarks.undetermined.pop(to, None)
        self._landmarks.touched += [name, to]
        self._counters.count(SOURCE, "renamed")
        return True

    def _merge(self, name: str, into: str, keyframe: int) -> bool:
        """All edges of a landmark are of another from now on; those that pulled do so until they are judged."""
        backend, known = self._backend, self._landmarks.known
        if name not in known:
            return self._refuse("unknown_landmark")
        if into not in known:
            return self._fail(f"landmark {into} is not in the map")
        a, b = known[into], known[name]
        if self._backend.solver.is_held(b.vertex):
            return self._refuse("held_in_map")
        if fault := self._cannot_be_one(a, b):
            return self._fail(fault)
        edges = self._edges_of(b.vertex)
        pulling = [edge for edge in edges if backend.ledger.verdict_of(edge) in INSIDE]
        copies = {edge: copy for edge in edges if (copy := self._copied(edge, b.vertex, a.vertex)) is not None}
        backend.gate_new(keyframe)
        for edge, copy in copies.items():
            if backend.graph.label_of(edge) == BY_HAND:
                backend.ledger.put(copy, Verdict.NOT_EVALUATED, Reason.BY_HAND)
        backend.decisions.exchange([copies[edge] for edge in pulling if edge in copies], [], keyframe)
        self._withdraw(edges, keyframe)
        backend.solver.remove(b.vertex)
        self._absorb(a, known.pop(name), copies)
        self._counters.count(SOURCE, "merged_by_hand")
        return True

    def _absorb(self, a: Landmark, b: Landmark, edges: Mapping[int, int]) -> None:
        """One landmark has all edges of another from now on; ``edges`` has the new edge of each."""
        a.seen += [replace(one, edge=edges[one.edge]) for one in b.seen if one.edge in edges]
        a.stamps |= b.stamps
        a.sightings += b.sightings
        a.first_seen_ns, a.last_seen_ns = min(a.first_seen_ns, b.first_seen_ns), max(a.last_seen_ns, b.last_seen_ns)
        a.is_tentative &= b.is_tentative
        self._landmarks.touched += [b.name, a.name]

    def _cannot_be_one(self, a: Landmark, b: Landmark) -> str:
        """Return why one landmark cannot be merged into another; empty where it can."""
        if self._landmarks.kind_of(a.vertex) is not self._landmarks.kind_of(b.vertex):
            return "one is a point and the other a pose"
        if a.is_unnamed and not b.is_unnamed:
            return f"{a.name} has no identity and {b.name} has one: merge {a.name} into {b.name}"
        return ""

    def _copied(self, edge: int, vertex: int, other: int) -> int | None:
        """Add an edge again with another vertex; None for a survey of the vertex, or where its ends would be one."""
        graph = self._backend.graph
        one = graph.edge(edge)
        ends = tuple(other if end == vertex else end for end in one.vertices)
        if one.label == "surveyed" or len(set(ends)) < len(ends):
            return None
        return graph.add_edge(one.type, ends, one.measured, Gaussian(one.sqrt_information), one.label, one.source)

    def _name_of(self, vertex: int) -> str:
        return next((name for name, mark in self._landmarks.known.items() if mark.vertex == vertex), "")

    def _edges_of(self, vertex: int) -> list[int]:
        """Edges of a vertex that have not been withdrawn, whether or not they are believed."""
        tables = self._backend.graph.tables.values()
        found = [table.at(np.flatnonzero((table.vertices.values == vertex).any(axis=1))).ids for table in tables]
        edges = sorted(int(edge) for ids in found for edge in ids)
        return [edge for edge in edges if not self._backend.ledger.is_withdrawn(edge)]

    def _determining(self, vertex: int) -> list[int]:
        """The edges of a landmark without those that are out or do not determine where it is."""
        graph, ledger = self._backend.graph, self._backend.ledger
        edges = [edge for edge in self._edges_of(vertex) if graph.label_of(edge) != "custom"]
        return [edge for edge in edges if ledger.verdict_of(edge) not in _OUT]

    def _refuse(self, reason: str) -> bool:
        self._counters.count(SOURCE, reason)
        return self._fail(_WHY[reason])

    def _fail(self, why: str) -> bool:
        self._refused = why
        return False
