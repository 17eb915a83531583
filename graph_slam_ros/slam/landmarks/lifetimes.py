"""Landmarks that vanish, move or come back: what each pass of the robot tells, by the rule in ``presence.py``.

A landmark that is gone is retired: its measurements stay in the graph, and nothing without identity is associated with
it. One that is seen elsewhere has moved: the old place gets a name of its own, and its name begins anew at the next
sighting. What is frozen, held or surveyed is reported and stays.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any, Protocol, TypeVar

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.graph.tables import Edge
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.frontend import motion_compensation
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.landmarks.landmark_map import LABEL, Landmarks
from graph_slam_ros.slam.landmarks.presence import Pass, Presence, views_of
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index

Value = TypeVar("Value")
ALL_VOID = -1  # in a record, instead of a vertex: the map was moved, so all records before it are void
OLD = "#"  # in the name of an old place of a landmark that moved, before its number
_LAG = 5  # keyframes after which the verdicts on the sightings from one are visited


def name_of_old(name: str, known: Collection[str]) -> str:
    """Return the name of an old place of a landmark, which is none of those that are known."""
    return next(old for number in count(1) if (old := f"{name}{OLD}{number}") not in known)


def has_identity(landmark: Landmark) -> bool:
    """Return whether its name says which landmark it is; not so of an old place of one that moved."""
    return not (landmark.is_unnamed or (landmark.retired_ns and OLD in landmark.name))


class Verdicts(Protocol):
    """The verdicts on all edges."""

    def __len__(self) -> int:
        """The number of edges that were judged."""

    def are_inside(self, edges: Iterable[int]) -> list[bool]:
        """Return whether each of some edges has a weight."""


@dataclass(frozen=True, slots=True)
class LandmarkEvent:
    """A change of a landmark: it was retired, or seen again, or has moved.

    Attributes
    ----------
    what : ``retired``, ``moved``, ``returned``; ``missing`` or ``elsewhere`` where it is held or surveyed
    name : its name; of one that moved that of the new place
    old : the name of the old place of one that moved
    passes : that did not see it, or that showed it elsewhere
    at, to : where it stood and where it was seen, in map
    remedy : what a person can do about it
    """

    what: str
    name: str
    stamp_ns: int
    passes: int = 0
    at: tuple[float, ...] = ()
    to: tuple[float, ...] = ()
    old: str = ""
    remedy: str = ""

    def __str__(self) -> str:
        where, to = _text(self.at), _text(self.to)
        passes = f"{self.passes} {'pass' if self.passes == 1 else 'passes'}"
        match self.what:
            case "moved":
                text = f"landmark {self.name} moved from {where} to {to} ({passes}): the old place is {self.old}"
            case "returned":
                text = f"landmark {self.name} was seen again at {where}: it is not retired any more"
            case "elsewhere":
                text = f"landmark {self.name} stands at {where} in the map and is seen at {to} ({passes})"
            case "missing":
                text = f"landmark {self.name} at {where} was not seen in {passes}"
            case _:
                text = f"landmark {self.name} at {where} was not seen in {passes}: it is retired"
        return text + (f"; {self.remedy}" if self.remedy else "")


class Lifetimes:
    """Decides which landmarks are gone, after each keyframe.

    Parameters
    ----------
    survey : names of surveyed landmarks; None: nothing is decided
    set_aside : takes edges out for good, since their landmark has moved
    on_retired : called when a landmark was retired

    Attributes
    ----------
    events : in order
    """

    def __init__(
        self,
        space: Geometry,
        landmarks: Landmarks,
        solver: Solver,
        verdicts: Verdicts,
        counters: Counters,
        *,
        survey: Collection[str] | None,
        set_aside: Callable[[Sequence[int]], None],
        on_retired: Callable[[], None],
    ) -> None:
        self._space, self._landmarks, self._solver, self._verdicts = space, landmarks, solver, verdicts
        self._counters, self._survey, self._set_aside, self._on_retired = counters, survey, set_aside, on_retired
        self.events: list[LandmarkEvent] = []
        self._known: dict[int, Presence] = {}  # by vertex
        self._passes: dict[int, Pass] = {}
        self._held: dict[int, list[int]] = {}  # of each landmark, sightings since the last that is accepted
        self._seen: dict[int, list[int]] = {}  # of each keyframe, by vertex, the sightings from it
        self._edge, self._next = 0, 0  # edges and keyframes that were visited
        self._newest = -1  # vertex of the last keyframe that was visited
        self._driven_m, self._at = 0.0, np.zeros(0)
        self._counts: dict[str, tuple[int, int]] = {}  # of each input, sightings that were accepted, and that were not
        self._log: list[list[Any]] = []

    def restore(self, records: Sequence[list[Any]]) -> None:
        """Continue with what a map tells. Its keyframes were visited."""
        for vertex, *record in records:
            if vertex == ALL_VOID:
                self._known.clear()
                continue
            self._known.setdefault(vertex, Presence()).read(record)
        self._log, self._edge, self._next = list(records), self._solver.graph.edge_count, -1

    def renumber(self, vertices: Index, edges: Index) -> None:
        """Take over new ids of vertices and edges, by old ones; -1: it was removed."""
        if self._survey is None:
            return
        self._known, self._passes = _moved(self._known, vertices), _moved(self._passes, vertices)
        self._held, self._seen = _moved(self._held, vertices), _moved(self._seen, vertices)
        for part in (self._held, self._seen):
            for several in part.values():
                several[:] = [new for new in edges[several].tolist() if new >= 0]
        self._edge = self._solver.graph.edge_count
        self._newest = int(vertices[self._newest]) if self._newest >= 0 else -1
        self._log = [[vertex, *one.record()] for vertex, one in self._known.items()]

    def forget(self) -> None:
        """Forget all views, because the map has moved."""
        if self._known:
            self._known.clear()
            self._passes.clear()
            self._log.append([ALL_VOID])

    def records(self, first: int) -> list[list[Any]]:
        """The records for a map after the first so many changes; after none those of all landmarks."""
        if first:
            return self._log[first:]
        return [[vertex, *one.record()] for vertex, one in self._known.items()]

    @property
    def changes(self) -> int:
        """The number of changes."""
        return len(self._log)

    def review(self, keyframes: StampedPoses[Keyframe]) -> None:
        """Look at the keyframes whose sightings were judged."""
        if self._survey is None:
            return
        graph = self._solver.graph
        judged, newest = len(self._verdicts), len(keyframes) - _LAG
        if self._next < 0 or len(keyframes) < self._next:  # of a map that was loaded, or a part was cut out
            self._next = len(keyframes) - 1 if self._next < 0 else max(newest, 0)
        for edge in range(min(self._edge, judged), judged):
            if graph.label_of(edge) == LABEL and (vertex := graph.edge(edge).vertices[0]) > self._newest:
                self._seen.setdefault(vertex, []).append(edge)
        self._edge = judged
        marks = {mark.vertex: mark for mark in self._landmarks.known.values() if not mark.is_tentative}
        for gone in [vertex for vertex in self._known if vertex not in marks]:
            del self._known[gone]
            self._passes.pop(gone, None)
        for k in range(self._next, newest):
            self._visit(keyframes[k], marks)
            self._newest = keyframes[k].vertex
        self._next = max(newest, self._next)

    # -- one keyframe --------------------------------------------------------------------------------------------

    def _visit(self, keyframe: Keyframe, marks: dict[int, Landmark]) -> None:
        """Look at one keyframe: what is in view from there, and what was seen."""
        pose = self._solver.estimate([keyframe.vertex])[0]
        n = self._space.dimensions
        if len(self._at):
            self._driven_m += float(np.linalg.norm(pose[:n] - self._at))
        self._at = pose[:n].copy()
        seen = self._sighted(keyframe, pose, marks)
        live = [vertex for vertex in self._known if vertex in marks]
        if not live:
            return
        forward = self._space.turn(tuple(pose.tolist()))[:, 0]
        points = self._landmarks.positions(live)
        views, distances = views_of(points - pose[:n], float(np.arctan2(forward[1], forward[0])))
        inputs = list(self._counts)
        for vertex, view, distance, point in zip(live, views, distances, points, strict=True):
            self._view(vertex, [(topic, view) for topic in inputs], distance, seen.get(vertex, ((), ())))
            one = self._passes.get(vertex)
            if one is not None and one.has_ended(self._driven_m):
                del self._passes[vertex]
                self._close(marks[vertex], one, point, keyframe.stamp_ns)

    def _view(
        self,
        vertex: int,
        views: list[tuple[str, int]],
        distance_m: float,
        sighted: tuple[Sequence[str], Sequence[Array]],
    ) -> None:
        """Note what one keyframe tells of a landmark."""
        presence, (accepted, places) = self._known[vertex], sighted
        known = [view for view in views if view in presence.views]
        if not (known or accepted or places):
            return
        one = self._passes.get(vertex)
        if one is None:
            one = self._passes[vertex] = Pass(self._driven_m, self._driven_m, distance_m, dict(self._counts))
        if places and not (known or accepted):
            distance_m = one.reach_m
        one.note(self._driven_m, distance_m)
        one.known.update(known)
        one.seen.update(view for view in views if view[0] in accepted)
        one.places += places

    def _sighted(
        self, keyframe: Keyframe, pose: Array, marks: dict[int, Landmark]
    ) -> dict[int, tuple[list[str], list[Array]]]:
        """Return, of each landmark seen from a keyframe, the inputs that are accepted, and places that are not."""
        out: dict[int, tuple[list[str], list[Array]]] = {}
        edges, graph = self._seen.pop(keyframe.vertex, []), self._solver.graph
        for edge, is_in in zip(edges, self._verdicts.are_inside(edges), strict=True):
            vertex, topic = graph.edge(edge).vertices[1], graph.source_of(edge)
            mark = marks.get(vertex)
            if mark is None:
                continue
            presence = self._known.get(vertex)
            if presence is None:
                presence = self._known[vertex] = Presence()
            accepted, places = out.setdefault(vertex, ([], []))
            counts = self._counts.setdefault(topic, (0, 0))
            if presence.views:
                self._counts[topic] = counts[0] + is_in, counts[1] + (not is_in)
            if is_in:
                accepted.append(topic)
                self._held.pop(vertex, None)
                if mark.retired_ns:
                    self._return(mark, keyframe.stamp_ns)
            else:
                self._held.setdefault(vertex, []).append(edge)
                if (point := self._place(edge, pose)) is not None:
                    places.append(point)
        return out

    def _place(self, edge: int, pose: Array) -> Array | None:
        """The position of a landmark by a sighting, in map; None where it does not tell a position."""
        point = _point_of(self._space, self._solver.graph.edge(edge))
        if point is None:
            return None
        return np.array(self._space.group.act(tuple(pose.tolist()), tuple(point.tolist())))

    # -- one pass ------------------------------------------------------------------------------------------------

    def _close(self, mark: Landmark, one: Pass, home: Array, stamp_ns: int) -> None:
        """Judge a pass that has ended."""
        presence = self._known[mark.vertex]
        if one.seen:
            presence.see(one.known, one.seen)
        elif one.places and self._is_sound(one, set(self._counts), mine=len(one.places)):
            place = np.median(np.array(one.places), axis=0)
            presence.show_elsewhere(tuple(place.tolist()), tuple(home.tolist()))
        else:
            known = {view for view in one.known if self._is_sound(one, {view[0]})}
            if not known or mark.retired_ns:
                return
            presence.miss(known)
        if presence.is_gone or (mark.retired_ns and presence.elsewhere):
            self._decide(mark, presence, tuple(home.tolist()), stamp_ns)
        self._log.append([mark.vertex, *presence.record(one.known | one.seen)])

    def _is_sound(self, one: Pass, topics: set[str], mine: int = 0) -> bool:
        """Return whether some inputs saw other landmarks in a pass, most of them where they should be."""
        good = bad = 0
        for topic in topics:
            before, now = one.before.get(topic, (0, 0)), self._counts.get(topic, (0, 0))
            good, bad = good + now[0] - before[0], bad + now[1] - before[1]
        return good > 0 and good >= bad - mine

    # -- what is decided -----------------------------------------------------------------------------------------

    def _decide(self, mark: Landmark, presence: Presence, home: tuple[float, ...], stamp_ns: int) -> None:
        moved, name = presence.elsewhere > 0, mark.name
        passes = presence.elsewhere if moved else presence.missed
        remedy = self._why_kept(name, presence.place)
        if remedy:
            if not presence.is_reported:
                what = "elsewhere" if moved else "missing"
                self._counters.count("landmarks", "elsewhere" if moved else "missing")
                self.events.append(LandmarkEvent(what, name, stamp_ns, passes, home, presence.place, remedy=remedy))
            presence.is_reported = True
        elif not moved:
            self._retire(name, stamp_ns)
            self._counters.count("landmarks", "retired")
            self.events.append(LandmarkEvent("retired", name, stamp_ns, passes, home))
            self._on_retired()
        else:
            self._set_aside(self._held.pop(mark.vertex, []))
            old = self._retire(name, mark.retired_ns or stamp_ns, begins_anew=True)
            place = presence.place
            presence.forget()
            self._counters.count("landmarks", "moved")
            self.events.append(LandmarkEvent("moved", name, stamp_ns, passes, home, place, old))
            self._on_retired()

    def _return(self, mark: Landmark, stamp_ns: int) -> None:
        self._retire(mark.name, 0)
        self._known[mark.vertex].forget()
        self._log.append([mark.vertex, *self._known[mark.vertex].record(set())])
        at = tuple(self._landmarks.positions([mark.vertex])[0].tolist())
        self._counters.count("landmarks", "returned")
        self.events.append(LandmarkEvent("returned", mark.name, stamp_ns, at=at))

    def _retire(self, name: str, stamp_ns: int, *, begins_anew: bool = False) -> str:
        """Note that a landmark is gone, or with 0 that it is there. Returns its name from now on.

        Parameters
        ----------
        begins_anew : whether the next sighting with its name begins another; it gets a name of its own then
        """
        known, touched, to = self._landmarks.known, self._landmarks.touched, name
        landmark = known[name]
        landmark.retired_ns = stamp_ns
        if begins_anew:
            to = name_of_old(name, known)
            landmark.name, known[to] = to, known.pop(name)
            touched.append(name)
        touched.append(to)
        return to

    def _why_kept(self, name: str, place: Sequence[float]) -> str:
        """Return what to do about a landmark that is held or surveyed, and gone; empty for all others.

        Parameters
        ----------
        place : where it is seen now; empty where it is not
        """
        if name in (self._survey or ()):
            row = ",".join([name, *(f"{x:.3f}" for x in place), "SIGMA"])
            return f"landmarks.surveyed is never changed: {f'write {row}' if place else f'remove the line of {name}'}"
        if self._landmarks.is_held(name):
            return f"the map is held: remove it with the edit remove_landmark of {name}, and freeze again"
        return ""


def _moved(part: dict[int, Value], vertices: Index) -> dict[int, Value]:
    """Return values by new vertices, without those that were removed."""
    return {new: value for old, value in part.items() if (new := int(vertices[old])) >= 0}


def _point_of(space: Geometry, edge: Edge) -> Array | None:
    """The position of a landmark in its keyframe, by a sighting; None where that does not tell a position."""
    measured, n = edge.measured, space.dimensions
    if edge.type in (space.relative_pose, space.tag_position, space.sightings["position"]):
        return np.array(measured[:n])
    if edge.type is space.sightings["range_bearing"]:
        point = motion_compensation.point_of(space, tuple(measured[:n].tolist()))
        return np.array(space.group.act(tuple(measured[n:].tolist()), tuple(point.tolist())))
    return None


def _text(place: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{x:.2f}" for x in place) + ")"
