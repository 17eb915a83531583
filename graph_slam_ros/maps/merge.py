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

from graph_slam_ros.edge_tags import tag_of
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.maps.alignment import Alignment, align, positions
from graph_slam_ros.measurements.edits import AppliedEdit, Argument, kind_of
from graph_slam_ros.runs.condensed_map import CONDENSED, WholePath
from graph_slam_ros.runs.folder import check_room
from graph_slam_ros.runs.journal import parts_of
from graph_slam_ros.runs.map_journal import MapGrowth, Record, extend, state_of
from graph_slam_ros.runs.restore import config_to_go_on, record_run, restored_and_solved, stopwatch
from graph_slam_ros.slam import Control, GraphSlam
from graph_slam_ros.slam.doubt.record import Alarm
from graph_slam_ros.slam.edits import HAND_MADE
from graph_slam_ros.slam.frontend.odometry_selector import JUMP_SIGMA_M, JUMP_SIGMA_RAD
from graph_slam_ros.slam.landmarks.assignments import NAME, last_number
from graph_slam_ros.slam.robust.landmark_support import landmark_of
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.slam.snapshot import MapSnapshot

_ABSOLUTE = ("fixes", "surveyed")  # in the axes of map
_ONCE = ("surveyed",)  # what both sessions were told is told once


def refuse_other_space(one: GraphSlam, two: GraphSlam, a: Path, b: Path) -> None:
    """Raise GraphSlamError if one is in the plane and one in space."""
    if one.space is not two.space:
        dimensions = (slam.space.dimensions for slam in (one, two))
        counts = " and ".join(f"{folder}: {n}" for folder, n in zip((a, b), dimensions, strict=True))
        raise GraphSlamError(f"world.dimensions differ ({counts})")


def shared_landmarks(one: GraphSlam, two: GraphSlam) -> list[str]:
    """The landmarks with the same id in both, without unnamed ones."""
    named = [{name for name, mark in slam.landmarks.items() if not mark.is_unnamed} for slam in (one, two)]
    return [name for name in one.landmarks if name in named[0] & named[1]]


def aligned_for_merge(one: GraphSlam, two: GraphSlam, a: Path, b: Path) -> tuple[list[str], Alignment]:
    """Return the landmarks that both maps share, and how the second map lies on the first.

    Raises GraphSlamError: they cannot become one map.
    """
    _refuse_other_datum(one, two, a, b)
    _refuse_same_drive(one, two, a, b)
    shared = _shared(one, two, a, b)
    return shared, _aligned(one, two, shared)


def merge_trouble(one: GraphSlam, two: GraphSlam, a: Path, b: Path) -> str:
    """Return why two maps cannot become one; empty where they can."""
    try:
        aligned_for_merge(one, two, a, b)
    except GraphSlamError as error:
        return str(error)
    return ""


def _refuse_other_datum(one: GraphSlam, two: GraphSlam, a: Path, b: Path) -> None:
    if one.datum and two.datum and one.datum != two.datum:
        raise GraphSlamError(
            f"fixes of {a} are from {one.datum}, of {b} from {two.datum}: configure one datum for both"
        )


def _refuse_same_drive(one: GraphSlam, two: GraphSlam, a: Path, b: Path) -> None:
    driven, again = (_driven(WholePath.of(slam, folder)) for slam, folder in ((one, a), (two, b)))
    same = len(driven & again)
    if same > 1:  # two robots may begin at one time
        raise GraphSlamError(f"{same} keyframes are of the same drive in {a} and {b}: nothing new is in one of them")


def _driven(path: WholePath) -> set[tuple[int, bytes]]:
    return {(stamp, pose.tobytes()) for stamp, pose in zip(path.stamps_ns.tolist(), path.odometry, strict=True)}


def _shared(one: GraphSlam, two: GraphSlam, a: Path, b: Path) -> list[str]:
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


def absolute_classes(slam: GraphSlam) -> list[str]:
    """The classes of edges that are absolute in the map."""
    return [label for label in _ABSOLUTE if len(slam.graph.edges_of(label))]


def _aligned(one: GraphSlam, two: GraphSlam, shared: list[str]) -> Alignment:
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
    one, two = restored_and_solved(a, losses), restored_and_solved(b, losses, whole=True)
    refuse_other_space(one, two, a, b)
    shared, aligned = aligned_for_merge(one, two, a, b)
    state = state_of(one, a)
    first_edge = state.graph.edge_count
    two.backend.use_noise(one.noise_factors)  # the merged map has one factor for each group
    extend(state, _Second(one, two, aligned, shared).record())
    left_out = {name: aligned.distance(k) for k, name in enumerate(shared) if not aligned.fits[k]}
    chi2 = {one.landmarks[name].vertex: float(aligned.chi2[k]) for k, name in enumerate(shared) if name in left_out}
    _leave_out(state, first_edge, chi2, aligned.limit)
    config = config_to_go_on(one, a)
    _, summary = record_run(out, config, [Control("optimize")], losses, state, took=took, force=force)
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
    """The map of the second session as growth of the first."""

    def __init__(self, one: GraphSlam, two: GraphSlam, aligned: Alignment, shared: list[str]) -> None:
        self._one, self._two, self._T = one, two, aligned.T_a_b
        self._keyframes = len(one.keyframes)
        same = {two.landmarks[name].vertex: one.landmarks[name].vertex for name in shared}
        self._vertex: dict[int, int] = same
        self._new = [vertex for vertex in range(two.graph.vertex_count) if vertex not in same]
        self._vertex |= {vertex: one.graph.vertex_count + k for k, vertex in enumerate(self._new)}
        self._shared = set(shared)

    def record(self) -> Record:
        """A record with numbers of vertices, edges and keyframes that follow those of the first map."""
        growth, first = MapGrowth().since(self._two), self._keyframes
        others = MapGrowth().since(self._one)["edges"]
        known = {(label, *vertices) for _, vertices, *_, label, _ in others if label in _ONCE}
        edges = [self._edge(edge) for edge in growth["edges"]]
        kept = [k for k, (_, vertices, *_, label, _) in enumerate(edges) if (label, *vertices) not in known]
        number = {edge: self._one.graph.edge_count + k for k, edge in enumerate(kept)}
        ids = {edge: self._one.graph.edge_ids.of(row) for edge, row in number.items()}
        return {
            "vertices": [self._value(vertex, growth["vertices"][vertex][0]) for vertex in self._new],
            "edges": [edges[k] for k in kept],
            "judged": [[first + keyframe, *rest] for keyframe, *rest in (growth["judged"][k] for k in kept)],
            "changes": [[number[edge], first + keyframe, *rest] for edge, keyframe, *rest in growth.get("changes", ())],
            "keyframes": [[self._vertex[vertex], *rest] for vertex, *rest in growth["keyframes"]],
            "segments": [first + keyframe for keyframe in growth["segments"]],
            "drives": [first + keyframe for keyframe in growth["drives"]],
            "sightings": [[first + keyframe, *rest] for keyframe, *rest in growth.get("sightings", ())],
            "landmarks": self._landmarks(growth.get("landmarks", {})),
            "seen": [
                [number[edge], topic, sighting, first + keyframe, self._vertex[vertex], *rest]
                for edge, topic, sighting, keyframe, vertex, *rest in growth.get("seen", ())
            ],
            "edits": [self._edit_record(one, ids) for one in self._two.edits],
            "displacements": [*self._one.displacements, *map(self._displacement, self._two.displacements)],
            "datum": growth.get("datum", self._one.datum),
        }

    def _value(self, vertex: int, kind: str) -> list[Any]:
        space, value = self._one.space, tuple(self._two.solver.estimate([vertex])[0].tolist())
        of = self._two.graph.kind_of(vertex)
        if of is space.pose:
            value = space.group.compose(self._T, value)
        elif of is space.point:
            value = space.group.act(self._T, value)
        return [kind, [float(x) for x in value]]

    def _edge(self, edge: list[Any]) -> list[Any]:
        tag, vertices, measured, root, label, source = edge
        if label == "anchor" or (source == HAND_MADE and len(vertices) == 1):
            return self._bridge()
        if label == "initialpose":  # it was told in the axes of the second
            measured = [float(x) for x in self._one.space.group.compose(self._T, tuple(measured))]
        return [tag, [self._vertex[vertex] for vertex in vertices], measured, root, label, source]

    def _edit_record(self, one: AppliedEdit, number: Mapping[int, int]) -> list[Any]:
        """An edit of the second map, renamed if the first has that name."""
        names = {other.edit.name for other in self._one.edits}
        free = chain([one.edit.name], (f"{one.edit.name}-{k}" for k in count(2)))
        name = next(name for name in free if name not in names)
        edges, added = (tuple(number[e] for e in ids if e in number) for ids in (one.edges, one.added))
        arguments = {key: self._argument(key, x, number) for key, x in one.edit.arguments.items()}
        edit = replace(one.edit, name=name, arguments=arguments)
        return AppliedEdit(edit, self._keyframes + one.keyframe, edges, added).record

    def _displacement(self, one: dict[str, Any]) -> dict[str, Any]:
        """An alarm of the second map, with the keyframe of the merged map at which its segment begins."""
        if one.get("segment") is None:
            return one
        fields = {key: value for key, value in one.items() if key != "text"}
        alarm = Alarm(**fields | {"segment": self._keyframes + one["segment"]})
        return asdict(alarm) | {"text": str(alarm)}

    def _argument(self, key: str, value: Argument, number: Mapping[int, int]) -> Argument:
        """A value of an edit, with the ids and keyframes of the merged map."""
        match kind_of(key), value:
            case "edge", int():
                return number.get(value, value)
            case "edges", tuple():
                return tuple(number.get(int(edge), int(edge)) for edge in value)
            case "keyframe", int():
                return self._keyframes + value
        return value

    def _bridge(self) -> list[Any]:
        """A weak edge from the last keyframe of the first map to the first keyframe of the second."""
        space = self._one.space
        ends = [int(self._one.keyframes.ids[-1]), self._vertex[int(self._two.keyframes.ids[0])]]
        last = tuple(self._one.trajectory()[-1].tolist())
        begun = space.group.compose(self._T, tuple(self._two.trajectory()[0].tolist()))
        measured = [float(x) for x in space.group.between(last, begun)]
        root = Gaussian.from_sigmas(*space.sigmas(JUMP_SIGMA_M, JUMP_SIGMA_RAD)).sqrt_information
        return [tag_of(space.relative_pose), ends, measured, np.ravel(root).tolist(), "odometry", ""]

    def _landmarks(self, landmarks: Mapping[str, Any]) -> dict[str, Any]:
        out: dict[str, Any] = {}
        known = self._one.touched_landmarks(0)
        number = last_number({*known, *landmarks})
        for name, fields in landmarks.items():
            vertex, is_unnamed, is_tentative, sightings, first_ns, last_ns, *features = fields
            if name in self._shared:
                mark = self._one.landmarks[name]
                sightings += mark.sightings
                first_ns, last_ns = min(first_ns, mark.first_seen_ns), max(last_ns, mark.last_seen_ns)
            elif name in known:
                number += 1
                name = f"{NAME}{number}"
            out[name] = [self._vertex[vertex], is_unnamed, is_tentative, sightings, first_ns, last_ns, *features]
        return out
