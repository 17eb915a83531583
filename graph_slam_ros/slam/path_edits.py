"""Edits of the drive by hand: closures between keyframes, a map that is moved; and the keyframes that a plan names."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.graph.tables import Edge
from graph_slam_ros.slam.anchor import TIGHT, Anchor
from graph_slam_ros.slam.edit_tools import BY_HAND, HAND_MADE, EditTools
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.robust.ledger import INSIDE
from graph_slam_ros.typing import Index, Numbers

_FOLLOWS = ("anchor", "initialpose", "range_offset")  # what is moved with the map, or does not say where it lies
_SAME = 1e-6  # of chi2
_AROUND_NS = 10**9  # a stamp may be so far outside the drive


class PathEdits:
    """Adds closures and moves the map; each raises GraphSlamError where that cannot be done.

    Parameters
    ----------
    on_moved : all are called when the map has moved

    Attributes
    ----------
    numbered : the vertices of all keyframes that a plan can name, in the order of their numbers
    """

    def __init__(
        self,
        space: Geometry,
        tools: EditTools,
        frontend: KeyframeFrontend,
        anchor: Anchor,
        on_moved: Sequence[Callable[[], None]],
    ) -> None:
        self._space, self._tools, self._frontend = space, tools, frontend
        self._backend, self._anchor, self._on_moved = tools.backend, anchor, on_moved
        self.numbered: list[int] = []

    # -- keyframes by number or stamp --------------------------------------------------------------------------------

    def at(self, place: int | str) -> int:
        """The index of the keyframe of a number, or of that nearest to a stamp."""
        if isinstance(place, int):
            return self._numbered(place)
        stamps, stamp_ns = self._ascending(place), _nanoseconds(place)
        if not stamps[0] - _AROUND_NS <= stamp_ns <= stamps[-1] + _AROUND_NS:
            raise GraphSlamError(f"no keyframe at {place} s")
        return int(np.abs(stamps - stamp_ns).argmin())

    def between(self, first: int | str, last: int | str) -> tuple[int, int]:
        """The indices of the first and last keyframe of a part of the drive, both included."""
        a = first if isinstance(first, str) else self._numbered(first)
        b = last if isinstance(last, str) else self._numbered(last)
        if isinstance(a, str):
            a = int(np.searchsorted(self._ascending(a), _nanoseconds(a), side="left"))
        if isinstance(b, str):
            b = int(np.searchsorted(self._ascending(b), _nanoseconds(b), side="right")) - 1
        if a > b:
            raise GraphSlamError(f"no keyframe from {first} until {last}")
        return a, b

    def _numbered(self, number: int) -> int:
        ids, first = self._frontend.path.keyframes.ids, self._frontend.path.keyframes.first
        if first:  # of a map with condensed visits no part can be cut out
            if number < first:
                raise GraphSlamError(f"keyframe {number}: {self._tools.refusal('condensed_in_map')}")
            if number - first >= len(ids):
                raise GraphSlamError(f"no keyframe {number}: the map has {first} to {first + len(ids) - 1}")
            return number - first
        known = set(self.numbered)
        self.numbered += [vertex for vertex in ids.tolist() if vertex not in known]
        if number >= len(self.numbered):
            raise GraphSlamError(f"no keyframe {number}: the map has 0 to {len(self.numbered) - 1}")
        at = np.flatnonzero(ids == self.numbered[number])
        if not len(at):
            raise GraphSlamError(f"keyframe {number} was cut out by an earlier edit")
        return int(at[0])

    def _ascending(self, place: str) -> Index:
        stamps = self._frontend.path.keyframes.stamps_ns
        if (np.diff(stamps) < 0).any():
            raise GraphSlamError(f"the stamp {place} may be of several drives: name the keyframe by its number")
        return stamps

    # -- closures ----------------------------------------------------------------------------------------------------

    def add_closure(self, ends: tuple[int, int], pose: Numbers, sigmas: tuple[float, float], keyframe: int) -> None:
        """Add a loop closure between two keyframes, by index: the pose of the second in the frame of the first."""
        vertices = [self._vertex(end) for end in ends]
        if vertices[0] == vertices[1]:
            raise GraphSlamError("both are one keyframe")
        noise = Gaussian.from_sigmas(*self._space.sigmas(*sigmas))
        if all(map(self._backend.solver.is_held, vertices)):
            raise GraphSlamError(self._tools.refusal("held_in_map"))
        self._tools.add(self._space.relative_pose, vertices, self._pose(pose), noise, keyframe)
        self._tools.counters.count("edit", "closed_by_hand")

    # -- the anchor --------------------------------------------------------------------------------------------------

    def anchor_at(self, index: int, pose: Numbers, sigmas: tuple[float, float], keyframe: int) -> None:
        """Move the map rigidly, so that a keyframe has a pose, and anchor it there."""
        vertex, T_map_base = self._vertex(index), self._pose(pose)
        before = tuple(self._backend.solver.estimate([vertex])[0].tolist())
        T_new_old = self._space.group.compose(T_map_base, self._space.group.inverse(before))
        self._move(T_new_old, vertex, T_map_base, sigmas, keyframe)

    def move(self, pose: Numbers, sigmas: tuple[float, float], keyframe: int) -> None:
        """Move the map rigidly, so that its origin has a pose; it stays anchored at the same keyframe."""
        self._backend.hand_over()
        T_new_old, anchors = self._pose(pose), self.anchors()
        first = int(self._frontend.path.keyframes.ids[0])
        vertex = self._backend.graph.edge(anchors[-1]).vertices[0] if anchors else first
        before = tuple(self._backend.solver.estimate([vertex])[0].tolist())
        self._move(T_new_old, vertex, self._space.group.compose(T_new_old, before), sigmas, keyframe)

    def anchors(self) -> list[int]:
        """The edges that anchor the map: that of its beginning, and those that were added by hand."""
        graph, ledger = self._backend.graph, self._backend.ledger
        by_hand = [edge for edge in graph.edges_of(BY_HAND).tolist() if is_hand_made_anchor(graph.edge(edge))]
        return [edge for edge in [*graph.edges_of("anchor").tolist(), *by_hand] if not ledger.is_withdrawn(edge)]

    def _move(self, T_new_old: Numbers, vertex: int, at: Numbers, sigmas: tuple[float, float], keyframe: int) -> None:
        backend, graph, tools = self._backend, self._backend.graph, self._tools
        backend.hand_over()
        if len(backend.solver.held):
            raise GraphSlamError(tools.refusal("held_in_map"))
        poses = [edge for edge in graph.edges_of("initialpose").tolist() if not backend.ledger.is_withdrawn(edge)]
        anchors = self.anchors()
        self._refuse_located({*anchors, *poses}, T_new_old)
        backend.move(T_new_old, self._space)
        tools.withdraw(anchors, keyframe)
        noise = Gaussian.from_sigmas(*self._space.sigmas(*(sigma or TIGHT for sigma in sigmas)))
        tools.add(self._space.pose_prior, [vertex], tuple(map(float, at)), noise, keyframe)
        pulling = [edge for edge in poses if backend.ledger.verdict_of(edge) in INSIDE]
        tools.replace({edge: self._moved(edge, T_new_old) for edge in poses}, pulling, keyframe)
        tools.withdraw(poses, keyframe)
        self._anchor.restore()
        for call in self._on_moved:
            call()
        tools.counters.count("edit", "moved_by_hand")

    def _moved(self, edge: int, T_new_old: Numbers) -> int:
        """Add a given pose again, in the axes that the map gets."""
        graph = self._backend.graph
        one = graph.edge(edge)
        measured = self._space.group.compose(T_new_old, tuple(one.measured.tolist()))
        return graph.add_edge(one.type, one.vertices, measured, Gaussian(one.sqrt_information), one.label, one.source)

    def _refuse_located(self, moved: set[int], T_new_old: Numbers) -> None:
        """Raise GraphSlamError where measurements say where the map lies."""
        graph, solver = self._backend.graph, self._backend.solver
        edges = np.array([edge for edge in solver.edges.tolist() if edge not in moved], dtype=np.int64)
        edges = edges[~graph.has_label(edges, _FOLLOWS)]
        before, _ = solver.chi2_of(edges)
        values = solver.values
        self._backend.move(T_new_old, self._space)
        after, _ = solver.chi2_of(edges)
        solver.start_at(values)
        rounding = _SAME * (1.0 + math.hypot(*T_new_old[: self._space.dimensions]))
        other = np.flatnonzero(np.abs(after - before) > rounding * np.maximum(1.0, before))
        if len(other):
            first = int(edges[other[0]])
            which = f"the first is edge {first} ({graph.label_of(first)})"
            raise GraphSlamError(
                f"{len(other)} measurements say where the map lies, {which}: the map would move back;"
                " take them out, or correct what they measure"
            )

    def _vertex(self, index: int) -> int:
        return int(self._frontend.path.keyframes.ids[index])

    def _pose(self, pose: Numbers) -> Numbers:
        space = self._space
        if len(pose) != space.pose.size:
            has = f"in {space.dimensions} dimensions it has {space.pose.size}"
            raise GraphSlamError(f"pose: {len(pose)} numbers; {has}")
        return space.normalized(pose)


def is_hand_made_anchor(edge: Edge) -> bool:
    """Return whether an edge anchors the map, and somebody added it by hand."""
    return edge.source == HAND_MADE and len(edge.vertices) == 1


def _nanoseconds(stamp: str) -> int:
    seconds, _, fraction = stamp.partition(".")
    return int(seconds) * 10**9 + int(fraction.ljust(9, "0") or 0)
