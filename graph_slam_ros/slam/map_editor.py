"""Edits of a saved map by hand: each changes the snapshot. The pipeline that goes on in it solves and judges."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.config.config import Config
from graph_slam_ros.errors import GraphSlamError, did_you_mean
from graph_slam_ros.graph import EdgeType, Gaussian
from graph_slam_ros.measurements.edits import AppliedEdit, Edit
from graph_slam_ros.slam.anchor import TIGHT
from graph_slam_ros.slam.edits import BY_HAND, HAND_MADE, anchors, determining, standing_edges, why_not_removed
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.levels import SINGULAR
from graph_slam_ros.slam.robust.gating import CANDIDATES
from graph_slam_ros.slam.robust.hypotheses import moved_rigidly
from graph_slam_ros.slam.robust.landmark_support import landmark_of
from graph_slam_ros.slam.robust.ledger import OUTSIDE, Reason, Verdict
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.solver.linearization import evaluated
from graph_slam_ros.typing import Array, Numbers

_IF_CONDENSED = ("remove_edge", "let_in_edge", "add_closure", "rename_landmark")  # possible if visits are condensed
_FOLLOWS = ("anchor", "initialpose", "range_offset")  # what is moved with the map, or does not say where it lies
_AROUND_NS = 10**9  # a stamp may be so far outside the drive
_WHY = {
    "unknown_edge": "it is not in the graph, or was taken out for good before",
    "needed_edge": "it is odometry or a prior, which is not judged: without it poses are undetermined",
    "held_in_map": "it is part of a frozen map, which never changes",
    "condensed_in_map": (
        "it is condensed, or not possible in a map with condensed visits: graph_slam replay RUN --out WHOLE --set "
        "map.condense=false makes the map of all keyframes, which can be edited"
    ),
}


class MapEditor:
    """Applies edits to a map, whose edges have all been judged.

    Attributes
    ----------
    state : the map; where an edit has failed it must not be used any more
    """

    def __init__(self, state: MapSnapshot, config: Config) -> None:
        self.state, self._graph, self._ledger, self._marks = state, state.graph, state.ledger, state.landmarks
        self._space, self._gate = config.space, config.robust.gate
        self._newest = len(state.keyframes) - 1
        self._out: list[int] = []  # edges that the present edit has taken out

    def apply(self, edit: Edit) -> None:
        """Apply an edit, and note it in the map.

        Raises
        ------
        GraphSlamError
            It cannot be applied to this map; the text names the edit.
        """
        state, first = self.state, self._graph.edge_ids.next
        self._out = []
        try:
            if any(one.edit.name == edit.name for one in state.edits):
                raise GraphSlamError("the map has an edit of that name already")
            if state.keyframes.first and edit.do not in _IF_CONDENSED:
                raise GraphSlamError(_WHY["condensed_in_map"])
            self._apply(edit.do, dict(edit.arguments))
        except GraphSlamError as error:
            of = [edit.do] * (edit.name != edit.do)
            of += [f"{key} {edit.arguments[key]}" for key in ("edge", "landmark") if key in edit.arguments]
            name = f"{edit.name} ({', '.join(of)})" if of else edit.name
            raise GraphSlamError(f"edit {name}: {error}") from None
        new = tuple(self._graph.edge_ids.since(first).tolist())
        state.edits.append(AppliedEdit(edit, self._newest, tuple(self._out), new))

    def _apply(self, do: str, a: dict[str, Any]) -> None:
        match do:
            case "remove_edge":
                self._remove_edge(a["edge"])
            case "let_in_edge":
                self._let_in(a["edge"])
            case "add_closure":
                self._add_closure(self._at(a["from_keyframe"]), self._at(a["to_keyframe"]), a)
            case "remove_landmark":
                self._remove_landmark(a["landmark"])
            case "rename_landmark":
                self._rename(a["landmark"], a["to"])
            case "merge_landmarks":
                self._merge(a["landmark"], a["into"])
            case "split_landmark":
                self._split(a["landmark"], a["to"], a.get("edges") or self._seen_between(a))
            case "move_anchor":
                vertex, pose = self.state.keyframes[self._at(a["keyframe"])].vertex, self._pose(a["pose"])
                T_new_old = self._space.group.compose(pose, self._space.group.inverse(self._value(vertex)))
                self._move(T_new_old, vertex, a)
            case "move_map":
                anchor = anchors(self._graph, self._ledger)[-1:]
                vertex = self._graph.edge(anchor[0]).vertices[0] if anchor else int(self.state.keyframes.ids[0])
                self._move(self._pose(a["pose"]), vertex, a)

    # -- edges -------------------------------------------------------------------------------------------------------

    def _remove_edge(self, edge: int) -> None:
        graph, ledger = self._graph, self._ledger
        if reason := why_not_removed(graph, ledger, edge):
            raise GraphSlamError(_WHY[reason])
        vertex = landmark_of(graph, edge)
        if vertex is not None and determining(graph, ledger, vertex) == [edge]:
            self._remove_landmark(next(name for name, mark in self._marks.items() if mark.vertex == vertex))
        else:
            self._withdraw([edge])

    def _let_in(self, edge: int) -> None:
        """An edge without a loss, which is never judged, replaces an edge that may be out."""
        if not self._graph.edge_ids.has(edge):
            raise GraphSlamError(_WHY[why_not_removed(self._graph, self._ledger, edge)])
        one = self._graph.edge(edge)
        if one.label not in CANDIDATES or edge < self._ledger.final:
            raise GraphSlamError(_WHY["held_in_map" if one.label in CANDIDATES else "needed_edge"])
        if not np.isin(one.vertices, self.state.vertices).all():
            raise GraphSlamError("its landmark or keyframe is not in the map any more")
        self._add(one.type, one.vertices, tuple(one.measured), Gaussian(one.sqrt_information), one.source)
        self._withdraw([edge])

    def _add_closure(self, first: int, second: int, a: dict[str, Any]) -> None:
        vertices = [self.state.keyframes[k].vertex for k in (first, second)]
        if first == second:
            raise GraphSlamError("both are one keyframe")
        if max(vertices) < self.state.frozen:
            raise GraphSlamError(_WHY["held_in_map"])
        noise = Gaussian.from_sigmas(*self._space.sigmas(a["sigma_m"], a["sigma_rad"]))
        self._add(self._space.relative_pose, vertices, self._pose(a["pose"]), noise)

    def _withdraw(self, edges: Sequence[int]) -> None:
        """Take edges out for good, and the sightings of landmarks that they were made of."""
        self._graph.set_weights(np.array(edges, dtype=np.int64), 0.0)
        for edge in edges:
            statistic = float(self._ledger.statistic.values[self._ledger.ids.row(edge)])
            self._ledger.note(edge, self._newest, Verdict.REJECTED, Reason.BY_HAND, statistic)
        self._out += edges
        gone = set(edges)
        for mark in self._marks.values():
            if any(one.edge in gone for one in mark.seen):
                mark.seen = [one for one in mark.seen if one.edge not in gone]
                mark.stamps = {one.where.stamp_ns for one in mark.seen}

    def _add(
        self, edge_type: EdgeType, ends: Sequence[int], measured: Numbers, noise: Gaussian, source: str = HAND_MADE
    ) -> None:
        """Add an edge without a loss, which is never judged."""
        edge = self._graph.add_edge(edge_type, ends, measured, noise, BY_HAND, source)
        self._judge(edge, Verdict.NOT_EVALUATED, Reason.BY_HAND)

    def _copy(self, edge: int, ends: Sequence[int], measured: Numbers | None = None) -> int:
        """Add an edge again with other ends or another measurement, and the verdict of the first."""
        graph, ledger = self._graph, self._ledger
        one, noise = graph.edge(edge), Gaussian(graph.edge(edge).sqrt_information)
        copy = graph.add_edge(one.type, ends, measured or one.measured, noise, one.label, one.source)
        graph.set_weights(np.array([copy]), one.weight)
        self._judge(copy, ledger.verdict_of(edge), Reason(int(ledger.reason.values[ledger.ids.row(edge)])))
        return copy

    def _judge(self, edge: int, verdict: Verdict, reason: Reason) -> None:
        """Enter the verdict on a new edge, with its residual at the present estimate."""
        residual, chi2, numbers = evaluated(self._graph, self.state.values, self._graph.edge_ids.existing([edge]))
        limit = np.array([quantile(self._gate, int(numbers[0]))])
        is_judged = np.array([verdict is not Verdict.NOT_EVALUATED])
        self._ledger.enter(self._newest, chi2, numbers, limit, residual, is_judged)
        self._ledger.put(edge, verdict, reason)

    # -- landmarks ---------------------------------------------------------------------------------------------------

    def _remove_landmark(self, name: str) -> None:
        mark = self._free(name)
        self._withdraw(standing_edges(self._graph, self._ledger, mark.vertex))
        del self._marks[name]

    def _rename(self, name: str, to: str) -> None:
        mark = self._known(name)
        self._refuse_known(to)
        self._marks[to] = self._marks.pop(name)
        mark.name = to

    def _merge(self, name: str, into: str) -> None:
        """All edges of a landmark are of another from now on."""
        b = self._known(name)
        if into not in self._marks:
            raise GraphSlamError(f"landmark {into} is not in the map{did_you_mean(into, self._marks)}")
        a = self._marks[into]
        self._free(name)
        if self._graph.kind_of(a.vertex) is not self._graph.kind_of(b.vertex):
            raise GraphSlamError("one is a point and the other a pose")
        if a.is_unnamed and not b.is_unnamed:
            raise GraphSlamError(f"{into} has no identity and {name} has one: merge {into} into {name}")
        seen, copies = b.seen, self._transfer(b.vertex, a.vertex, standing_edges(self._graph, self._ledger, b.vertex))
        del self._marks[name]
        a.seen += [replace(one, edge=copies[one.edge]) for one in seen if one.edge in copies]
        a.stamps |= {one.where.stamp_ns for one in seen}
        a.take_over(b)
        a.is_tentative &= b.is_tentative

    def _split(self, name: str, to: str, edges: Sequence[int]) -> None:
        """Some edges of a landmark are of a new one from now on."""
        graph, mark = self._graph, self._free(name)
        self._refuse_known(to)
        known, chosen = standing_edges(graph, self._ledger, mark.vertex), sorted(edges)
        for edge in chosen:
            if edge not in known or graph.label_of(edge) == "surveyed":
                raise GraphSlamError(f"edge {edge} is no sighting of landmark {name}, or was taken out for good before")
        strong, kind = determining(graph, self._ledger, mark.vertex), graph.kind_of(mark.vertex)
        for of, some in ((name, set(strong) - set(chosen)), (to, set(strong) & set(chosen))):
            if sum(graph.edge(edge).type.residual_size for edge in some) < kind.dof:
                raise GraphSlamError(f"what is left of {of} does not determine where it is: {len(some)} sightings")
        value = np.array(self._value(mark.vertex))
        new = Landmark(to, graph.add_vertex(kind, value), mark.is_unnamed, mark.is_tentative)
        self.state.values = np.concatenate((self.state.values, value))
        seen, left = mark.seen, [edge for edge in known if edge not in chosen]
        between = self._seen_from_to(mark, known, chosen), self._seen_from_to(mark, known, left)
        copies = self._transfer(mark.vertex, new.vertex, chosen)
        new.seen = [replace(one, edge=copies[one.edge]) for one in seen if one.edge in copies]
        new.stamps, new.sightings = {one.where.stamp_ns for one in new.seen}, len(chosen)
        mark.sightings = max(len(mark.seen), mark.sightings - len(chosen))
        (new.first_seen_ns, new.last_seen_ns), (mark.first_seen_ns, mark.last_seen_ns) = between
        for one in (mark, new):
            one.reset_features()
        self._marks[to] = new

    def _transfer(self, vertex: int, other: int, edges: Sequence[int]) -> dict[int, int]:
        """Copy edges of a vertex to another, and withdraw them; returns the copy of each that has one."""
        copies = dict[int, int]()
        for edge in edges:
            one = self._graph.edge(edge)
            ends = [other if end == vertex else end for end in one.vertices]
            if one.label != "surveyed" and len(set(ends)) == len(ends):
                copies[edge] = self._copy(edge, ends)
        self._withdraw(edges)
        return copies

    def _seen_from_to(self, mark: Landmark, known: Sequence[int], some: Sequence[int]) -> tuple[int, int]:
        """The stamps of the first and last sighting among some of the known edges of a landmark.

        Where the first or last of all is not among them, it is the stamp of the keyframe that another was seen from.
        """
        keyframes = self.state.keyframes
        stamp_of = dict(zip(keyframes.ids.tolist(), keyframes.stamps_ns.tolist(), strict=True))
        ends = {edge: [stamp_of[end] for end in self._graph.edge(edge).vertices if end in stamp_of] for edge in known}
        stamps = {edge: max(at) for edge, at in ends.items() if at}
        of_some = [stamps[edge] for edge in some if edge in stamps] or [mark.first_seen_ns]
        first, last = min(stamps.values(), default=0), max(stamps.values(), default=0)
        begins, ends_ns = min(of_some), max(of_some)
        return mark.first_seen_ns if begins == first else begins, mark.last_seen_ns if ends_ns == last else ends_ns

    def _seen_between(self, a: dict[str, Any]) -> list[int]:
        """The edges of a landmark from some keyframes, both ends included."""
        first, last = self._at(a["from"]), self._at(a["until"])
        if first > last:
            raise GraphSlamError(f"no keyframe from {a['from']} until {a['until']}")
        vertices = self.state.keyframes.ids[first : last + 1]
        known = standing_edges(self._graph, self._ledger, self._known(a["landmark"]).vertex)
        edges = [edge for edge in known if np.isin(self._graph.edge(edge).vertices, vertices).any()]
        if not edges:
            raise GraphSlamError("it was not seen there")
        return edges

    def _known(self, name: str) -> Landmark:
        if name not in self._marks:
            raise GraphSlamError(f"it is not in the map{did_you_mean(name, self._marks)}")
        return self._marks[name]

    def _free(self, name: str) -> Landmark:
        """A landmark that is not part of a frozen map."""
        mark = self._known(name)
        if mark.vertex < self.state.frozen:
            raise GraphSlamError(_WHY["held_in_map"])
        return mark

    def _refuse_known(self, to: str) -> None:
        if to in self._marks:
            raise GraphSlamError(f"another landmark is named {to}: merge_landmarks makes one of two")

    # -- where the map lies ------------------------------------------------------------------------------------------

    def _move(self, T_new_old: Numbers, vertex: int, a: dict[str, Any]) -> None:
        """Move the map rigidly, and anchor it at a vertex, and nowhere else."""
        state, graph, ledger = self.state, self._graph, self._ledger
        if state.frozen:
            raise GraphSlamError(_WHY["held_in_map"])
        poses = [edge for edge in graph.edges_of("initialpose").tolist() if not ledger.is_withdrawn(edge)]
        fixed, compose = anchors(graph, ledger), self._space.group.compose
        values = moved_rigidly(graph, state.values, T_new_old)
        self._refuse_located(values, {*fixed, *poses}, T_new_old)
        state.values = values
        self._withdraw(fixed)
        noise = Gaussian.from_sigmas(*self._space.sigmas(a["sigma_m"] or TIGHT, a["sigma_rad"] or TIGHT))
        self._add(self._space.pose_prior, [vertex], self._value(vertex), noise)
        for edge in poses:
            one = graph.edge(edge)
            self._copy(edge, one.vertices, tuple(map(float, compose(T_new_old, tuple(one.measured.tolist())))))
        self._withdraw(poses)

    def _refuse_located(self, values: Array, moved: set[int], T_new_old: Numbers) -> None:
        """Raise GraphSlamError where measurements say where the map lies."""
        graph, verdict = self._graph, self._ledger.verdict.values
        edges = np.setdiff1d(self._ledger.ids.since()[~np.isin(verdict, OUTSIDE)], list(moved))
        edges = edges[~graph.has_label(edges, _FOLLOWS)]
        before, after = (evaluated(graph, x, graph.edge_ids.existing(edges))[1] for x in (self.state.values, values))
        rounding = SINGULAR * (1.0 + math.hypot(*T_new_old[: self._space.dimensions]))
        other = edges[np.abs(after - before) > rounding * np.maximum(1.0, before)].tolist()
        if other:
            raise GraphSlamError(
                f"{len(other)} measurements say where the map lies, the first is edge {other[0]}"
                f" ({graph.label_of(other[0])}): the map would move back; take them out, or correct what they measure"
            )

    def _value(self, vertex: int) -> Numbers:
        return tuple(self.state.values[self._graph.vertex(vertex).stored].tolist())

    def _pose(self, pose: Numbers) -> Numbers:
        if len(pose) != self._space.pose.size:
            has = f"in {self._space.dimensions} dimensions it has {self._space.pose.size}"
            raise GraphSlamError(f"pose: {len(pose)} numbers; {has}")
        return self._space.normalized(pose)

    # -- keyframes by number or stamp --------------------------------------------------------------------------------

    def _at(self, place: int | str) -> int:
        """The number of a keyframe that is there, or of that nearest to a stamp."""
        first, end = self.state.keyframes.first, len(self.state.keyframes)
        if isinstance(place, int):
            if place < first:
                raise GraphSlamError(f"keyframe {place}: {_WHY['condensed_in_map']}")
            if place >= end:
                raise GraphSlamError(f"no keyframe {place}: the map has {first} to {end - 1}")
            return place
        stamps = self.state.keyframes.stamps_ns
        if (np.diff(stamps) < 0).any():
            raise GraphSlamError(f"the stamp {place} may be of several drives: name the keyframe by its number")
        seconds, _, fraction = place.partition(".")
        stamp_ns = int(seconds) * 10**9 + int(fraction.ljust(9, "0") or 0)
        if not stamps[0] - _AROUND_NS <= stamp_ns <= stamps[-1] + _AROUND_NS:
            raise GraphSlamError(f"no keyframe at {place} s")
        return first + int(np.abs(stamps - stamp_ns).argmin())
