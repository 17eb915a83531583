"""One map from two sessions: common landmarks align the second with the first, then everything is solved together.

The drive of the second follows as a new segment, as after a jump of time. Only landmarks link it to the first drive.
Visits of the first map may be condensed. Where those of the second are, its drive is repeated from its journal first:
then the merged map has all of its keyframes, and condenses them as its configuration says.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.maps.alignment import Alignment, align, positions
from graph_slam_ros.measurements.edits import ACTIONS, AppliedEdit, Argument
from graph_slam_ros.runs.condensed_map import WholePath
from graph_slam_ros.runs.folder import check_room
from graph_slam_ros.runs.journal import CONDENSED, parts_of
from graph_slam_ros.runs.restore import config_to_go_on, record_run, restored_and_solved, stopwatch
from graph_slam_ros.slam import Control, MapView
from graph_slam_ros.slam.association.assignments import NAME, last_number
from graph_slam_ros.slam.doubt.record import Doubt
from graph_slam_ros.slam.edits import HAND_MADE
from graph_slam_ros.slam.frontend.odometry_selector import JUMP_SIGMA_M, JUMP_SIGMA_RAD
from graph_slam_ros.slam.landmarks.landmark import Landmark, LandmarkEdge
from graph_slam_ros.slam.robust.landmark_support import landmark_of
from graph_slam_ros.slam.robust.ledger import Ledger, Reason, Verdict
from graph_slam_ros.slam.snapshot import MapSnapshot

_ABSOLUTE = ("fixes", "surveyed")  # in the axes of map


def refuse_other_space(one: MapView, two: MapView, a: Path, b: Path) -> None:
    """Raise GraphSlamError if one is in the plane and one in space."""
    if one.space is not two.space:
        raise GraphSlamError(f"world.dimensions differ ({a}: {one.space.dimensions} and {b}: {two.space.dimensions})")


def shared_landmarks(one: MapView, two: MapView) -> list[str]:
    """The landmarks with the same id in both, without unnamed ones."""
    named = [{name for name, mark in view.landmarks.items() if not mark.is_unnamed} for view in (one, two)]
    return [name for name in one.landmarks if name in named[0] & named[1]]


def aligned_for_merge(one: MapView, two: MapView, a: Path, b: Path) -> tuple[list[str], Alignment]:
    """Return the landmarks that both maps share, and how the second map lies on the first.

    Raises GraphSlamError: they cannot become one map.
    """
    if one.datum and two.datum and one.datum != two.datum:
        raise GraphSlamError(
            f"fixes of {a} are from {one.datum}, of {b} from {two.datum}: configure one datum for both"
        )
    driven, again = (
        {(stamp, pose.tobytes()) for stamp, pose in zip(path.stamps_ns.tolist(), path.odometry, strict=True)}
        for path in (WholePath.of(one, a), WholePath.of(two, b))
    )
    same = len(driven & again)
    if same > 1:  # two robots may begin at one time
        raise GraphSlamError(f"{same} keyframes are of the same drive in {a} and {b}: nothing new is in one of them")
    shared = _shared(one, two, a, b)
    return shared, _aligned(one, two, shared)


def merge_trouble(one: MapView, two: MapView, a: Path, b: Path) -> str:
    """Return why two maps cannot become one; empty where they can."""
    try:
        aligned_for_merge(one, two, a, b)
    except GraphSlamError as error:
        return str(error)
    return ""


def _shared(one: MapView, two: MapView, a: Path, b: Path) -> list[str]:
    """Landmarks in both maps. Raises GraphSlamError if a pair cannot be the same landmark."""
    for name, mark in two.landmarks.items():
        other = one.landmarks.get(name)
        if other is None or (mark.is_unnamed and other.is_unnamed):
            continue
        if mark.is_unnamed is not other.is_unnamed:
            raise GraphSlamError(f"landmark {name} has an identity in one of {a} and {b}, and none in the other")
        if one.graph.kind_of(other.vertex) is not two.graph.kind_of(mark.vertex):
            raise GraphSlamError(f"landmark {name} is a point in one of {a} and {b}, and a pose in the other")
    for label in absolute_classes(two):
        if not absolute_classes(one):
            raise GraphSlamError(f"{b} has {label}, which say where its map is, and {a} has none: merge {b} {a}")
    return shared_landmarks(one, two)


def absolute_classes(view: MapView) -> list[str]:
    """The classes of edges that are absolute in the map."""
    return [label for label in _ABSOLUTE if len(view.graph.edges_of(label))]


def _aligned(one: MapView, two: MapView, shared: list[str]) -> Alignment:
    needed, robust = one.space.dimensions, one.config.robust
    if len(shared) < needed:
        raise GraphSlamError(f"{len(shared)} landmarks are in both maps: it takes {needed} to lay one on the other")
    found = align(one.space, positions(one, shared), positions(two, shared), robust.gate, robust.noise_factor)
    agree = 0 if found is None else int(found.fits.sum())
    if found is None or 2 * agree < len(shared):
        why = f"{agree} of them agree" if agree else "too few agree, or they stand too close together"
        raise GraphSlamError(f"{len(shared)} landmarks are in both maps, and {why} on how one lies on the other")
    return found


@dataclass(frozen=True, slots=True)
class Merged:
    """The outcome of a merge.

    Attributes
    ----------
    shared : landmarks that both know
    left_out : what B saw of those of them that have moved, by name in metres and standard deviations
    is_repeated : whether the drive of B was repeated from its journal, because its visits are condensed
    """

    summary: dict[str, Any]
    losses: list[str]
    shared: int
    left_out: dict[str, tuple[float, float]]
    is_repeated: bool


def merge(a: Path, b: Path, out: Path, *, force: bool = False) -> Merged:
    """Write the run folder of one map of two runs, with the configuration of the first.

    Raises GraphSlamError: they cannot be laid on one another.
    """
    took = stopwatch()
    for folder in (a, b):
        check_room(out, folder, force=force)
    losses: list[str] = []
    mine, theirs = restored_and_solved(a, losses), restored_and_solved(b, losses, whole=True)
    one, two = mine.view, theirs.view
    refuse_other_space(one, two, a, b)
    shared, aligned = aligned_for_merge(one, two, a, b)
    state = one.snapshot(a)
    first_edge = state.graph.edge_ids.next
    two.backend.use_noise(one.backend.noise.factors)  # the merged map has one factor for each group
    _Second(one, two, aligned, shared).add_to(state)
    left_out = {name: aligned.distance(k) for k, name in enumerate(shared) if not aligned.fits[k]}
    chi2 = {one.landmarks[name].vertex: float(aligned.chi2[k]) for k, name in enumerate(shared) if name in left_out}
    _leave_out(state, first_edge, chi2, aligned.limit)
    _, summary = record_run(out, config_to_go_on(mine, a), [Control("optimize")], losses, state, took=took, force=force)
    return Merged(summary, summary["losses"], len(shared), left_out, bool(parts_of(b, CONDENSED)))


def _leave_out(state: MapSnapshot, first_edge: int, chi2: Mapping[int, float], limit: float) -> None:
    """Remove the second session's sightings of landmarks that are elsewhere in it. Those that fit come back later."""
    last, inside = len(state.keyframes) - 1, state.ledger.inside
    for edge in inside[inside >= first_edge].tolist():
        statistic = chi2.get(landmark_of(state.graph, edge) or 0)
        if statistic is not None:
            state.graph.set_weights(np.array([edge]), 0.0)
            state.ledger.note(edge, last, Verdict.REJECTED, Reason.OUTVOTED, statistic, limit)


class _Second:
    """The map of the second session, to be added to the first."""

    def __init__(self, one: MapView, two: MapView, aligned: Alignment, shared: list[str]) -> None:
        self._one, self._two, self._T = one, two, aligned.T_a_b
        self._keyframes = len(one.keyframes)
        self._vertex = {two.landmarks[name].vertex: one.landmarks[name].vertex for name in shared}
        self._new = [vertex for vertex in two.graph.vertex_ids.since().tolist() if vertex not in self._vertex]
        self._vertex |= {vertex: one.graph.vertex_ids.next + k for k, vertex in enumerate(self._new)}
        self._shared = set(shared)

    def add_to(self, state: MapSnapshot) -> None:
        """Add it to the first map. Vertices, edges and keyframes follow those that are there."""
        two, first, seen = self._two, self._keyframes, self._two.sighting_poses
        for vertex in self._new:
            state.graph.add_vertex(two.graph.kind_of(vertex), self._value(vertex))
        state.values = np.concatenate((state.values, state.graph.initial.values[len(state.values) :]))
        number = self._add_edges(state)
        self._add_verdicts(state.ledger, number)
        for keyframe in two.keyframes:
            state.keyframes.append(self._vertex[keyframe.vertex], keyframe.stamp_ns, keyframe.T_odom_base)
        state.sighting_poses.extend(seen.ids + first, seen.stamps_ns, seen.poses)
        state.segments += [first + keyframe for keyframe in two.segments]
        state.drives += [first + keyframe for keyframe in two.drives]
        self._add_landmarks(state.landmarks, number)
        state.edits += [self._edit(one, number) for one in two.edits]
        state.displacements = [*state.displacements, *map(self._displacement, two.displacements)]
        state.datum = two.datum or state.datum

    def _value(self, vertex: int) -> tuple[float, ...]:
        space, value = self._one.space, tuple(self._two.solver.estimate([vertex])[0].tolist())
        moved = {space.pose: space.group.compose, space.point: space.group.act}.get(self._two.graph.kind_of(vertex))
        return tuple(moved(self._T, value)) if moved else value

    def _add_edges(self, state: MapSnapshot) -> dict[int, int]:
        """Add its edges, but for what both sessions were told. Returns the new number of each, by its own."""
        mine, number = state.graph, dict[int, int]()
        known = {mine.edge(edge).vertices for edge in mine.edges_of("surveyed").tolist()}
        for edge in map(self._two.graph.edge, self._two.graph.edge_ids.since().tolist()):
            vertices = tuple(self._vertex[vertex] for vertex in edge.vertices)
            if edge.label == "surveyed" and vertices in known:  # both sessions were told
                continue
            measured, noise = edge.measured, Gaussian(edge.sqrt_information)
            if edge.label == "anchor" or (edge.source == HAND_MADE and len(vertices) == 1):
                number[edge.id] = self._add_bridge(mine)
                continue
            if edge.label == "initialpose":  # it was told in the axes of the second
                measured = np.array(self._one.space.group.compose(self._T, tuple(measured.tolist())))
            number[edge.id] = mine.add_edge(edge.type, vertices, measured, noise, edge.label, edge.source)
            mine.set_weights(np.array([number[edge.id]]), edge.weight)
        return number

    def _add_verdicts(self, ledger: Ledger, number: Mapping[int, int]) -> None:
        theirs, first, rows = self._two.ledger, self._keyframes, self._two.ledger.ids.existing(list(number))
        verdict = theirs.verdict.values[rows]
        is_taken = np.isin(theirs.ids.since(), list(number))
        residuals = theirs.residuals.values[np.repeat(is_taken, theirs.numbers.values)]
        of_rows = theirs.statistic.values[rows], theirs.numbers.values[rows], theirs.threshold.values[rows]
        ids = ledger.ids.rows(
            ledger.enter(first + theirs.keyframe.values[rows], *of_rows, residuals, verdict != Verdict.NOT_EVALUATED)
        )
        ledger.verdict.values[ids], ledger.reason.values[ids] = verdict, theirs.reason.values[rows]
        ledger.finish(ledger.final)
        ledger.history += [replace(one, edge=number[one.edge], keyframe=first + one.keyframe) for one in theirs.history]

    def _edit(self, one: AppliedEdit, number: Mapping[int, int]) -> AppliedEdit:
        """An edit of the second map, renamed if the first has that name."""
        names = {other.edit.name for other in self._one.edits}
        free = chain([one.edit.name], (f"{one.edit.name}-{k}" for k in count(2)))
        name = next(name for name in free if name not in names)
        edges, added = (tuple(number[e] for e in ids if e in number) for ids in (one.edges, one.added))
        arguments = {key: self._argument(one.edit.do, key, x, number) for key, x in one.edit.arguments.items()}
        edit = replace(one.edit, name=name, arguments=arguments)
        return AppliedEdit(edit, self._keyframes + one.keyframe, edges, added)

    def _displacement(self, one: dict[str, Any]) -> dict[str, Any]:
        """An alarm of the second map, with the keyframe of the merged map at which its segment begins."""
        if one.get("segment") is None:
            return one
        fields = {key: value for key, value in one.items() if key != "text"}
        alarm = Doubt(**fields | {"segment": self._keyframes + one["segment"]})
        return asdict(alarm) | {"text": str(alarm)}

    def _argument(self, do: str, key: str, value: Argument, number: Mapping[int, int]) -> Argument:
        """A value of an edit, with the ids and keyframes of the merged map."""
        match ACTIONS[do].known[key].kind, value:
            case "edge", int():
                return number.get(value, value)
            case "edges", tuple():
                return tuple(number.get(int(edge), int(edge)) for edge in value)
            case "keyframe", int():
                return self._keyframes + value
        return value

    def _add_bridge(self, graph: Graph) -> int:
        """Add a weak edge from the last keyframe of the first map to the first keyframe of the second."""
        space = self._one.space
        ends = [int(self._one.keyframes.ids[-1]), self._vertex[int(self._two.keyframes.ids[0])]]
        begun = space.group.compose(self._T, tuple(self._two.trajectory()[0].tolist()))
        measured = space.group.between(tuple(self._one.trajectory()[-1].tolist()), begun)
        noise = Gaussian.from_sigmas(*space.sigmas(JUMP_SIGMA_M, JUMP_SIGMA_RAD))
        return graph.add_edge(space.relative_pose, ends, measured, noise, "odometry")

    def _add_landmarks(self, known: dict[str, Landmark], edges: Mapping[int, int]) -> None:
        theirs = self._two.snapshot().landmarks
        number = last_number({*known, *theirs})
        for name, mark in theirs.items():
            if name in self._shared:
                known[name].take_over(mark)
                continue
            if name in known:
                number += 1
                name = f"{NAME}{number}"
            seen = [self._moved(one, edges) for one in mark.seen]
            known[name] = replace(mark, name=name, vertex=self._vertex[mark.vertex], seen=seen)

    def _moved(self, one: LandmarkEdge, edges: Mapping[int, int]) -> LandmarkEdge:
        keyframe, vertex = self._keyframes + one.where.keyframe, self._vertex[one.where.vertex]
        return replace(one, edge=edges[one.edge], where=replace(one.where, keyframe=keyframe, vertex=vertex))
