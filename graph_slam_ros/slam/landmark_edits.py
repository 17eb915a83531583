"""Edits of landmarks by hand: another name, one of two, two of one."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from graph_slam_ros.errors import GraphSlamError, did_you_mean
from graph_slam_ros.slam.edit_tools import EditTools
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.robust.ledger import INSIDE, Reason


class LandmarkEdits:
    """Renames, merges and splits landmarks; each raises GraphSlamError where that cannot be done."""

    def __init__(self, tools: EditTools, frontend: KeyframeFrontend) -> None:
        self._tools, self._frontend = tools, frontend
        self._backend, self._landmarks = tools.backend, tools.landmarks

    def remove(self, name: str, keyframe: int, reason: Reason = Reason.BY_HAND) -> None:
        """Remove a landmark and its edges; what is observed of that name later begins another."""
        self._backend.hand_over()
        landmark = self._known(name)
        self._tools.refuse_held(landmark.vertex)
        self._backend.withdraw(self._tools.edges_of(landmark.vertex), keyframe, reason)
        self._backend.solver.remove(landmark.vertex)
        self._landmarks.forget({landmark.vertex})
        self._tools.counters.count("edit", "removed")

    def rename_landmark(self, name: str, to: str) -> None:
        """Give a landmark another name."""
        landmark = self._known(name)
        self._refuse_known(to)
        known = self._landmarks.known
        known[to] = known.pop(name)
        landmark.name = to
        self._landmarks.undetermined.pop(to, None)
        self._landmarks.touched += [name, to]
        self._tools.counters.count("edit", "renamed")

    def merge(self, name: str, into: str, keyframe: int) -> None:
        """All edges of a landmark are of another from now on; those that pulled do so until they are judged."""
        backend, known, tools = self._backend, self._landmarks.known, self._tools
        b = self._known(name)
        if into not in known:
            raise GraphSlamError(f"landmark {into} is not in the map{did_you_mean(into, known)}")
        a = known[into]
        tools.refuse_held(b.vertex)
        if fault := self._cannot_be_one(a, b):
            raise GraphSlamError(fault)
        edges = tools.edges_of(b.vertex)
        pulling = [edge for edge in edges if backend.ledger.verdict_of(edge) in INSIDE]
        copies = {edge: copy for edge in edges if (copy := tools.copied(edge, b.vertex, a.vertex)) is not None}
        tools.replace(copies, pulling, keyframe)
        tools.withdraw(edges, keyframe)
        backend.solver.remove(b.vertex)
        self._absorb(a, known.pop(name), copies)
        tools.counters.count("edit", "merged_by_hand")

    def split(self, name: str, to: str, edges: Sequence[int], keyframe: int) -> None:
        """Some edges of a landmark are of a new one from now on."""
        backend, tools = self._backend, self._tools
        landmark = self._known(name)
        self._refuse_known(to)
        tools.refuse_held(landmark.vertex)
        all_edges, chosen = tools.edges_of(landmark.vertex), sorted(edges)
        for edge in chosen:
            if edge not in all_edges or backend.graph.label_of(edge) == "surveyed":
                raise GraphSlamError(f"edge {edge} is no sighting of landmark {name}, or was taken out for good before")
        kept = [edge for edge in tools.determining(landmark.vertex) if edge not in chosen]
        pulling = [edge for edge in chosen if backend.ledger.verdict_of(edge) in INSIDE]
        for of, some in ((name, kept), (to, [edge for edge in tools.determining(landmark.vertex) if edge in chosen])):
            if not tools.determines(some, landmark.vertex):
                raise GraphSlamError(f"what is left of {of} does not determine where it is: {len(some)} sightings")
        at = backend.solver.estimate([landmark.vertex])[0]
        vertex = backend.graph.add_vertex(backend.graph.kind_of(landmark.vertex), at)
        copies = {edge: copy for edge in chosen if (copy := tools.copied(edge, landmark.vertex, vertex)) is not None}
        tools.replace(copies, pulling, keyframe)
        new = Landmark(to, vertex, landmark.is_unnamed, landmark.is_tentative)
        new.seen = [replace(one, edge=copies[one.edge]) for one in landmark.seen if one.edge in copies]
        new.reset_features()
        new.stamps, new.sightings = {one.where.stamp_ns for one in new.seen}, len(chosen)
        new.first_seen_ns, new.last_seen_ns = self.seen_between(landmark, chosen, all_edges)
        self.withdraw_from(landmark, chosen, keyframe)
        self._landmarks.known[to] = new
        self._landmarks.undetermined.pop(to, None)
        self._landmarks.touched.append(to)
        tools.counters.count("edit", "split")

    def withdraw_from(self, landmark: Landmark, edges: Sequence[int], keyframe: int) -> None:
        """Take sightings from a landmark that has others."""
        gone, all_edges = set(edges), self._tools.edges_of(landmark.vertex)
        left = [edge for edge in all_edges if edge not in gone]
        landmark.first_seen_ns, landmark.last_seen_ns = self.seen_between(landmark, left, all_edges)
        landmark.seen = [one for one in landmark.seen if one.edge not in gone]
        landmark.stamps = {one.where.stamp_ns for one in landmark.seen}
        landmark.reset_features()
        landmark.sightings = max(len(landmark.seen), landmark.sightings - len(gone))
        self._tools.withdraw(edges, keyframe)
        self._landmarks.touched.append(landmark.name)

    def seen_between(self, landmark: Landmark, some: Sequence[int], edges: Sequence[int]) -> tuple[int, int]:
        """The stamps of the first and last sighting among some of the edges of a landmark.

        Where the first or last of all is not among them, it is the stamp of the keyframe that another was seen from.
        """
        stamps = self.stamps_of(edges)
        of_some = [stamps[edge] for edge in some if edge in stamps] or [landmark.first_seen_ns]
        first, last = min(stamps.values(), default=0), max(stamps.values(), default=0)
        return (
            landmark.first_seen_ns if min(of_some) == first else min(of_some),
            landmark.last_seen_ns if max(of_some) == last else max(of_some),
        )

    def stamps_of(self, edges: Sequence[int]) -> dict[int, int]:
        """The stamp of the newest keyframe of each edge that has one."""
        keyframes, graph = self._frontend.path.keyframes, self._backend.graph
        stamp_of = dict(zip(keyframes.ids.tolist(), keyframes.stamps_ns.tolist(), strict=True))
        ends = {edge: [stamp_of[end] for end in graph.edge(edge).vertices if end in stamp_of] for edge in edges}
        return {edge: max(stamps) for edge, stamps in ends.items() if stamps}

    def edges_between(self, name: str, first: int, last: int) -> list[int]:
        """The edges of a landmark from some keyframes, by their index, both included."""
        vertices = self._frontend.path.keyframes.ids[first : last + 1]
        graph, of_landmark = self._backend.graph, self._tools.edges_of(self._known(name).vertex)
        edges = [edge for edge in of_landmark if np.isin(graph.edge(edge).vertices, vertices).any()]
        if not edges:
            raise GraphSlamError("it was not seen there")
        return edges

    def _known(self, name: str) -> Landmark:
        if name not in self._landmarks.known:
            self._tools.counters.count("edit", "unknown_landmark")
            raise GraphSlamError(f"it is not in the map{did_you_mean(name, self._landmarks.known)}")
        return self._landmarks.known[name]

    def _refuse_known(self, to: str) -> None:
        if to in self._landmarks.known:
            raise GraphSlamError(f"another landmark is named {to}: merge_landmarks makes one of two")

    def _absorb(self, a: Landmark, b: Landmark, edges: Mapping[int, int]) -> None:
        """One landmark has all edges of another from now on; ``edges`` has the new edge of each."""
        a.seen += [replace(one, edge=edges[one.edge]) for one in b.seen if one.edge in edges]
        a.stamps |= b.stamps
        a.note_features(b.sort, b.size, b.sized)
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
