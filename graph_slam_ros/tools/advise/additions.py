"""Measurements that nobody has made yet, and the edges that they would add to a run.

What a sensor sees, and how well, is learnt from the run. A keyframe can see a landmark if the run has a sighting by the
same input, of the same type, at nearly the same place relative to the robot. The added sighting gets the noise of that
one.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.graph import POINT_PRIOR, EdgeType, Gaussian, Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import so3
from graph_slam_ros.runs.ledger_file import Entry
from graph_slam_ros.typing import Array, Index, Numbers

_Key = tuple[str, EdgeType]

SIGHTING, SURVEY, CLOSURE, TAG = "sighting", "survey", "closure", "new tag"
NEW = -1  # the vertex of a landmark that is not there yet
_NEAR, _NEAR_M = 0.15, 0.3  # of the distance, and at least: so far from a sighting of the run a landmark is seen, too
_SAME_SIDE = 0.7  # between the directions from which a tag with orientation is seen: 40 degrees
_TEMPLATES = 5000  # sightings of an input and type that are learnt from
_TAG_SIGHTINGS = 24  # of a new tag
_CLOSURE_M, _CLOSURE_RAD = 0.05, 0.01  # sigmas of a closure where the run has none


@dataclass(frozen=True, slots=True)
class PlannedEdge:
    """An edge that would be added.

    Attributes
    ----------
    vertices : its vertices; ``NEW`` for a new landmark
    measured : what would be measured if the present estimate were the truth
    share : part of its information that counts under its loss: the mean of the run's edges of this kind
    """

    type: EdgeType
    vertices: tuple[int, ...]
    measured: Array
    noise: Gaussian
    label: str
    source: str = ""
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class Addition:
    """A measurement that would be added: one edge, or of a new tag all its sightings.

    Attributes
    ----------
    kind : ``sighting``, ``survey``, ``closure`` or ``new tag``
    about : what to do, in words
    value : the stored numbers of the new landmark; empty where there is none
    """

    kind: str
    about: str
    edges: tuple[PlannedEdge, ...]
    value: Numbers = ()


def stored_values(graph: Graph, values: Array, edge: PlannedEdge, value: Numbers) -> tuple[Array, Index]:
    """Return the stored numbers with those of a new landmark at the end, and where each vertex of the edge begins."""
    at = [len(values) if v == NEW else graph.vertex(v).stored.start for v in edge.vertices]
    return np.concatenate([values, value]), np.array(at, dtype=np.int64)[None]


def expected(space: Geometry, edge_type: EdgeType, x: Array, at: Index, like: Array) -> Array:
    """Return what an edge would measure at the stored values x, by a measurement of its type.

    Parameters
    ----------
    at : (1, k) where its vertices begin in x
    like : (p,) another measurement, whose tail (the sensor's place) is kept
    """
    residual, _ = edge_type.linearize(x, at, like[None])
    r, z = residual[0], like.copy()
    if len(r) < space.dof or edge_type is not space.relative_pose:
        z[: len(r)] += r
    elif space.dimensions == 2:
        z[:] = space.group.compose(tuple(z), tuple(r))
    else:
        z[:] = space.group.compose(tuple(z), (*r[:3], *so3.exp(tuple(r[3:]))))
    return z


class SightingGroup:
    """The sightings of a run by one input and of one type, and where the landmark was relative to the robot in each.

    Parameters
    ----------
    entries, places : the sightings, and for each (n,) the landmark's position in the keyframe's frame
    sides : directions (n,) from the landmark to the robot, in the axes of a landmark with orientation; of others empty

    Attributes
    ----------
    share : the mean weight that their loss leaves them
    """

    def __init__(self, edge_type: EdgeType, entries: list[Entry], places: Array, sides: Array) -> None:
        thin = slice(None, None, -(-len(entries) // _TEMPLATES))
        self.type, self.entries, self.places = edge_type, entries[thin], places[thin]
        self.share = float(np.mean([min(entry.weight, 1.0) for entry in self.entries]))
        self._by_place = cKDTree(self.places)
        self._by_side = cKDTree(sides[thin]) if sides.size else None

    def like(self, places: Array, sides: Array) -> list[Entry | None]:
        """The sighting at the nearest place to each of some (k, n); None where the sensor would not see a landmark."""
        away, nearest = self._by_place.query(places)
        sees = away <= np.maximum(_NEAR_M, _NEAR * np.linalg.norm(places, axis=1))
        if self._by_side is not None:
            sees &= self._by_side.query(sides)[0] <= _SAME_SIDE
        return [self.entries[k] if yes else None for k, yes in zip(nearest.tolist(), sees.tolist(), strict=True)]


class Additions:
    """The measurements that could be added to a run.

    Parameters
    ----------
    keyframes : those that may be part of an addition, as indices
    survey_sigma : of each coordinate of a surveyed point [m]
    """

    def __init__(
        self,
        run: SavedGraph,
        keyframes: Sequence[int],
        travelled_m: Array,
        survey_sigma: float,
    ) -> None:
        self._run, self._keyframes, self._travelled_m = run, keyframes, travelled_m
        self._survey_sigma = survey_sigma
        self._space, self._values = run.space, run.solver.values
        self._vertices = [run.keyframes[k] for k in keyframes]
        self._poses = _columns([self._stored(vertex) for vertex in self._vertices])
        self._groups: dict[_Key, SightingGroup] = {}
        self._of_landmark: dict[str, Counter[_Key]] = {}
        self._seen: set[tuple[int, str]] = set()
        self._learn()

    def _learn(self) -> None:
        of_key: dict[_Key, list[Entry]] = {}
        space = self._space
        types = {*space.sightings.values(), space.tag_position}
        for entry in self._run.entries:
            is_known = entry.is_in and entry.landmark in self._run.landmarks
            key = entry.source, self._run.type_of(entry)
            if is_known and key[1] in types and self._run.keyframe(entry.vertices[0]) is not None:
                of_key.setdefault(key, []).append(entry)
                self._of_landmark.setdefault(entry.landmark, Counter())[key] += 1
                self._seen.add((entry.vertices[0], entry.landmark))
        for key, entries in of_key.items():
            poses = _columns([self._stored(e.vertices[0]) for e in entries])
            landmarks = np.array([self._stored(e.vertices[1]) for e in entries])
            self._groups[key] = SightingGroup(key[1], entries, *self._places(poses, tuple(landmarks.T)))

    def _stored(self, vertex: int) -> Numbers:
        return tuple(self._values[self._run.graph.vertex(vertex).stored].tolist())

    def _places(self, poses: tuple[Array, ...], landmark: Any) -> tuple[Array, Array]:
        """Positions (k, n) of a landmark in the frames of poses; of one with orientation, directions to them in its."""
        group, n = self._space.group, self._space.dimensions
        places = np.stack(group.act(group.inverse(poses), tuple(landmark[:n])), axis=-1)
        if len(landmark) == n:
            return places, np.empty((0, n))
        sides = np.stack(group.act(group.inverse(tuple(landmark)), poses[:n]), axis=-1)
        return places, sides / np.maximum(np.linalg.norm(sides, axis=1), 1e-9)[:, None]

    # -- sightings -------------------------------------------------------------------------------------------------

    def sightings(self, landmarks: Sequence[str]) -> Iterator[Addition]:
        """Sightings of landmarks from keyframes that could have seen them, and did not."""
        for name in landmarks:
            vertex, keys = self._run.landmarks[name], self._of_landmark.get(name)
            if not keys:
                continue
            group, landmark = self._groups[keys.most_common(1)[0][0]], self._stored(vertex)
            places, sides = self._places(self._poses, landmark)
            for k, like in enumerate(group.like(places, sides)):
                if like is not None and (self._vertices[k], name) not in self._seen:
                    edge = self._sighting(group, like, self._vertices[k], vertex, ())
                    distance = float(np.linalg.norm(places[k]))
                    number = self._run.numbers[self._keyframes[k]]
                    where = f"keyframe {number} {self._at(self._vertices[k])}, {distance:.1f} m away"
                    yield Addition(SIGHTING, f"see landmark {name} from {where}", (edge,))

    def _sighting(
        self, group: SightingGroup, like: Entry, pose_vertex: int, vertex: int, value: Numbers
    ) -> PlannedEdge:
        vertices, noise = (pose_vertex, vertex, *like.vertices[2:]), Gaussian.from_information(like.information_matrix)
        measured = np.array(like.measured)
        edge = PlannedEdge(group.type, vertices, measured, noise, like.label, like.source, group.share)
        return self._as_expected(edge, value)

    def _as_expected(self, edge: PlannedEdge, value: Numbers) -> PlannedEdge:
        x, at = stored_values(self._run.graph, self._values, edge, value)
        return replace(edge, measured=expected(self._space, edge.type, x, at, edge.measured))

    def _at(self, vertex: int) -> str:
        return _place(self._stored(vertex)[: self._space.dimensions])

    # -- surveys ---------------------------------------------------------------------------------------------------

    def surveys(self, landmarks: Sequence[str]) -> Iterator[Addition]:
        """Surveys of the positions of landmarks that were not surveyed yet."""
        graph, n = self._run.graph, self._space.dimensions
        surveyed = {v for entry in self._run.entries if entry.label == "surveyed" for v in entry.vertices}
        noise = Gaussian.from_sigmas(*[self._survey_sigma] * n)
        for name in landmarks:
            vertex = self._run.landmarks[name]
            if vertex not in surveyed:
                is_pose = graph.kind_of(vertex) is self._space.pose
                edge_type = self._space.fixes["position"] if is_pose else POINT_PRIOR[self._space.point]
                measured = edge_type.whole(self._stored(vertex)[:n])
                edge = PlannedEdge(edge_type, (vertex,), measured, noise, "surveyed")
                about = f"survey landmark {name} {self._at(vertex)} to {self._survey_sigma:g} m"
                yield Addition(SURVEY, about, (edge,))

    # -- closures --------------------------------------------------------------------------------------------------

    def closures(self, reach_m: float, apart: float, most: int) -> Iterator[Addition]:
        """Closures between keyframes near each other in space and far from each other along the path.

        Parameters
        ----------
        reach_m : in space
        apart : along the path, in times of that
        most : pairs; where there are more they are taken evenly
        """
        vertices = self._vertices
        pairs = cKDTree(np.stack(self._poses[: self._space.dimensions], axis=-1)).query_pairs(reach_m)
        far = [(a, b) for a, b in sorted(pairs) if self._apart_m(a, b) > apart * reach_m]
        noise, source, share, assumed = self._closure_noise()
        for a, b in far[:: max(1, -(-len(far) // most))]:
            ends, start = (vertices[a], vertices[b]), np.array(self._space.identity)
            like = PlannedEdge(self._space.relative_pose, ends, start, noise, "closures", source, share)
            names = " and ".join(str(self._run.numbers[self._keyframes[k]]) for k in (a, b))
            about = f"close the loop between keyframes {names} {self._at(vertices[b])}{assumed}"
            yield Addition(CLOSURE, about, (self._as_expected(like, ()),))

    def _apart_m(self, a: int, b: int) -> float:
        return float(abs(self._travelled_m[self._keyframes[b]] - self._travelled_m[self._keyframes[a]]))

    def _closure_noise(self) -> tuple[Gaussian, str, float, str]:
        """The noise of the run's closure of median precision; else that which is assumed."""
        found = [e for e in self._run.entries if e.label == "closures" and e.is_in and e.dof == self._space.dof]
        if found:
            like = sorted(found, key=lambda e: float(np.linalg.slogdet(e.information_matrix)[1]))[len(found) // 2]
            share = float(np.mean([min(e.weight, 1.0) for e in found]))
            return Gaussian.from_information(like.information_matrix), like.source, share, ""
        assumed = f", to {_CLOSURE_M:g} m and {np.degrees(_CLOSURE_RAD):.2g} deg"
        return Gaussian.from_sigmas(*self._space.sigmas(_CLOSURE_M, _CLOSURE_RAD)), "", 1.0, assumed

    # -- new tags --------------------------------------------------------------------------------------------------

    def tags(self, keyframes: Sequence[int]) -> Iterator[Addition]:
        """A new landmark at two usual places, right and left, as seen from each of some keyframes."""
        groups = [one for one in self._groups.values() if one.type is not self._space.tag_position]
        if not groups:
            return
        group = max(groups, key=lambda one: len(one.entries))
        order = np.argsort(np.linalg.norm(group.places, axis=1), kind="stable")
        usual = order[len(order) // 4 : len(order) // 4 + max(1, len(order) // 2)]
        bearings = np.arctan2(group.places[usual, 1], group.places[usual, 0])
        ranked = usual[np.argsort(bearings, kind="stable")]
        likes = {int(ranked[round(q * (len(ranked) - 1))]) for q in (0.1, 0.9)}
        for k in keyframes:
            for like in sorted(likes):
                yield from self._tag(group, self._stored(self._run.keyframes[k]), like)

    def _tag(self, group: SightingGroup, pose: Numbers, like: int) -> Iterator[Addition]:
        """A new landmark where a sighting had its, seen from all keyframes that would see it there."""
        if group.type is self._space.relative_pose:
            value = tuple(map(float, self._space.group.compose(pose, group.entries[like].measured)))
        else:
            value = tuple(map(float, self._space.group.act(pose, tuple(group.places[like].tolist()))))
        found = [(k, one) for k, one in enumerate(group.like(*self._places(self._poses, value))) if one is not None]
        found = found[:: max(1, -(-len(found) // _TAG_SIGHTINGS))]
        if len(found) > 1:
            edges = tuple(self._sighting(group, one, self._vertices[k], NEW, value) for k, one in found)
            about = f"put a new tag at {_place(value[: self._space.dimensions])}: seen from {len(edges)} keyframes"
            yield Addition(TAG, about, edges, value)


def _columns(poses: Sequence[Numbers]) -> tuple[Array, ...]:
    return tuple(np.array(poses).T)


def _place(position: Sequence[float]) -> str:
    return "(" + ", ".join(f"{round(x, 1) + 0.0:.1f}" for x in position) + ")"  # without -0.0
