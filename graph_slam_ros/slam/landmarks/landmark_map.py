"""Landmarks: sightings become vertices and edges. A landmark that is not determined yet is kept with the reason."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.config.survey import Surveyed
from graph_slam_ros.errors import ConfigError, NoiseError
from graph_slam_ros.graph import POINT_PRIOR, Gaussian, VertexKind
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.edge_noise import LEAST_RAD2, edge_noise
from graph_slam_ros.measurements.types import Sighting
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.frontend import motion_compensation
from graph_slam_ros.slam.frontend.motion_compensation import KeyframeMeasurement, PoseAtStamp
from graph_slam_ros.slam.frontend.sighting_edges import SightingEdges
from graph_slam_ros.slam.landmarks.landmark import Landmark, LandmarkEdge, UndeterminedLandmark
from graph_slam_ros.slam.landmarks.triangulation import PartialObservation, possible_places, why_undetermined
from graph_slam_ros.typing import Array, Numbers

LABEL = "landmarks"
_SOMEWHERE_M = 3.0  # away, of what was seen by its bearing alone
_MAX_SIGHTINGS = 60  # sightings of one landmark: every other is forgotten beyond


class Landmarks:
    """Landmarks with identity.

    Attributes
    ----------
    known : those in the graph, by identity
    undetermined : those that are not determined yet
    changes : how often a landmark of the graph has changed
    aliases : the landmark that an identity is of, where somebody has merged two
    origins : when each edge of a sighting was measured, and where from
    begins_new : whether what is not known begins a landmark; not so while the map is held
    """

    def __init__(self, config: Config, backend: Backend, counters: Counters) -> None:
        self.known: dict[str, Landmark] = {}
        self.undetermined: dict[str, UndeterminedLandmark] = {}
        self._config, self._space = config, config.space
        self._backend, self._edges = backend, backend.noise
        self._graph, self._solver = backend.graph, backend.solver
        self._counters, self.begins_new = counters, True
        if config.landmarks.surveyed_file and not config.landmarks.surveyed:
            raise ConfigError(f"landmarks.surveyed_file: {config.landmarks.surveyed_file} has not been read")
        self._survey = config.survey
        for name, known in config.survey.items():
            if known.orientation:
                self._noise_of_pose(name, known)
        self.changes = 0
        self.aliases: dict[str, str] = {}
        self.origins = SightingEdges(self._space)

    def add(self, topic: str, name: str, s: Sighting, where: PoseAtStamp) -> None:
        """Add a sighting of a landmark with this id."""
        name = self.aliases.get(name, name)
        landmark = self.known.get(name)
        if landmark is not None:
            self._add_edge(topic, landmark, s, where)
        elif s.kind == "pose":
            self._begin(topic, name, s, where, motion_compensation.pose(self._space, s, where).measured)
        elif s.kind == "position":
            self._begin(
                topic, name, s, where, self._in_map(where, motion_compensation.position(self._space, s, where).measured)
            )
        elif s.kind == "range_bearing":
            point = motion_compensation.point_of(self._space, s.measured)
            self._begin(topic, name, s, where, tuple(self._from_sensor(s, where, point).tolist()))
        elif name in self._survey:  # there is nothing to wait for
            self._begin(topic, name, s, where, self._survey[name].position)
        else:
            self._note_undetermined(topic, name, s, where)

    def survey_of(self, name: str, s: Sighting, where: PoseAtStamp) -> tuple[Surveyed, Array] | None:
        """The survey of a landmark that was not seen before, and its possible values by a sighting.

        The value is a pose if both the survey and the sighting have the orientation, else a position (n,).
        """
        if name not in self._survey or self.aliases.get(name, name) in self.known:
            return None
        if s.kind == "pose" and self._survey[name].orientation:
            measured = motion_compensation.pose(self._space, s, where).measured
            return self._survey[name], np.array(self._space.group.compose(self._pose(where), measured))
        if s.kind in ("pose", "position"):
            return self._survey[name], np.array(
                self._in_map(where, motion_compensation.position(self._space, s, where).measured)
            )
        measured = s.measured
        if s.kind == "bearing":
            measured = (_SOMEWHERE_M, *measured)
        elif s.kind == "range":
            measured = (*measured, *[0.0] * (self._space.dimensions - 1))
        return self._survey[name], self._from_sensor(s, where, motion_compensation.point_of(self._space, measured))

    def restore(self, known: dict[str, Landmark]) -> None:
        """Continue with these landmarks, whose vertices and edges are in the graph."""
        self.known.update(known)
        self.changes += len(known)

    def copies(self) -> dict[str, Landmark]:
        """Return a copy of each landmark of the graph, as ``restore`` takes them."""
        return {name: replace(mark, seen=list(mark.seen), stamps=set(mark.stamps)) for name, mark in self.known.items()}

    def forget_removed(self) -> None:
        """Forget the sightings whose edges are not in the graph any more.

        Those of landmarks that are not determined yet are forgotten with their keyframe, and counted.
        """
        for landmark in self.known.values():
            landmark.seen = [one for one in landmark.seen if self._graph.edge_ids.has(one.edge)]
            landmark.stamps = {one.where.stamp_ns for one in landmark.seen}
        self.origins.keep(self._graph.edge_ids.since())
        for name, candidate in list(self.undetermined.items()):
            left = [one for one in candidate.seen if self._graph.vertex_ids.has(one[0].vertex)]
            self._counters.count(candidate.topic, "condensed", len(candidate.seen) - len(left))
            candidate.seen = left
            if not left:
                del self.undetermined[name]

    # -- in the graph --------------------------------------------------------------------------------------------

    def _begin(self, topic: str, name: str, s: Sighting, where: PoseAtStamp, value: Numbers) -> None:
        """Add a vertex. ``value`` is in map; a pose is still in the keyframe's frame."""
        kind = self._space.pose if s.kind == "pose" else self._space.point
        if s.kind == "pose":
            value = self._space.group.compose(self._pose(where), value)
        landmark = self.known[name] = Landmark(name, self._graph.add_vertex(kind, value), not s.id, not s.id)
        if name in self._survey:
            self._hold(topic, landmark, self._survey[name])
        self._add_edge(topic, landmark, s, where)

    def _hold(self, topic: str, landmark: Landmark, known: Surveyed) -> None:
        """Add a prior for the survey. It has no loss, because sightings that contradict it are wrong."""
        space, vertices = self._space, [landmark.vertex]
        is_pose = self._graph.kind_of(landmark.vertex) is space.pose
        if is_pose and known.orientation:
            noise = self._noise_of_pose(landmark.name, known)
            self._graph.add_edge(space.pose_prior, vertices, known.pose, noise, "surveyed")
            return
        if known.orientation:
            self._counters.count(topic, "surveyed_orientation_unused")
        edge_type = space.fixes["position"] if is_pose else POINT_PRIOR[space.point]
        noise = Gaussian.from_covariance(known.position_covariance)
        self._graph.add_edge(edge_type, vertices, edge_type.whole(known.position), noise, "surveyed")

    def _noise_of_pose(self, name: str, known: Surveyed) -> Gaussian:
        try:
            return Gaussian.from_covariance(self._space.in_tangent(known.pose, np.array(known.covariance)))
        except NoiseError:
            why = "the sigmas of its axes differ too much, expected less than 1e7 times"
            raise ConfigError(f"landmarks.surveyed: {name!r}: {why}") from None

    def _add_edge(self, topic: str, landmark: Landmark, s: Sighting, where: PoseAtStamp) -> None:
        space = self._space
        is_pose = self._graph.kind_of(landmark.vertex) is space.pose
        vertices, metres = [where.vertex, landmark.vertex], space.dimensions
        if s.kind == "pose" and is_pose:
            edge_type, compensated = space.relative_pose, motion_compensation.pose(space, s, where)
        elif s.kind in ("pose", "position"):
            edge_type = space.tag_position if is_pose else space.sightings["position"]
            compensated = motion_compensation.position(space, s, where)
        elif is_pose:
            self._counters.count(topic, "not_for_a_pose")
            return
        else:
            edge_type, metres = space.sightings[s.kind], 0 if s.kind == "bearing" else 1
            compensated = self._from_sensors(s, where, landmark)
        distance_m = float(np.linalg.norm(compensated.measured[:metres]))
        noise = edge_noise(self._counters, topic, self._blurred(s, compensated), metres, distance_m)
        edge = self._edges.add_edge(edge_type, vertices, compensated.measured, noise, LABEL, topic)
        self.origins.append(edge, s, where)
        if not s.id:
            landmark.seen.append(LandmarkEdge(edge, topic, s, where))
            landmark.stamps.add(where.stamp_ns)
            landmark.note_features(s.sort, s.size)
        landmark.sightings += 1
        self._counters.used[topic] += 1
        self.changes += 1
        landmark.first_seen_ns = min(landmark.first_seen_ns or where.stamp_ns, where.stamp_ns)
        landmark.last_seen_ns = max(landmark.last_seen_ns, where.stamp_ns)

    def _from_sensors(self, s: Sighting, where: PoseAtStamp, landmark: Landmark) -> KeyframeMeasurement:
        at = self._solver.estimate([landmark.vertex])[0]
        group = self._space.group
        seen = np.array(group.act(group.inverse(self._pose(where)), tuple(at.tolist())))
        return motion_compensation.seen_from_sensor(self._space, s, where, seen)

    def _blurred(self, s: Sighting, compensated: KeyframeMeasurement) -> Array:
        """The covariance with errors that messages do not contain: clocks, mounting, size."""
        covariance, added = compensated.covariance.copy(), self._config.landmarks.added_sigma_m**2
        if s.kind in ("pose", "position"):
            n = self._space.dimensions
            covariance[:n, :n] += added * np.eye(n)
        elif s.kind != "bearing":
            covariance[0, 0] += added
        return covariance

    # -- taken back ----------------------------------------------------------------------------------------------

    def prune(self, name: str) -> None:
        """Remove a landmark and its edges from the problem."""
        landmark = self.known.pop(name)
        self.changes += 1
        self._withdraw_sightings(landmark.seen, landmark.vertex)

    def forget(self, vertices: set[int]) -> None:
        """Forget landmarks that were removed from the problem. A new observation begins a new landmark."""
        for name in [name for name, landmark in self.known.items() if landmark.vertex in vertices]:
            self.changes += 1
            del self.known[name]

    def remove_sightings(self, name: str, seen: Set[tuple[int, str, Sighting]]) -> None:
        """Remove sightings from a landmark, by stamp, topic and sighting. Without any it is removed itself."""
        landmark = self.known[name]
        gone = [one for one in landmark.seen if (one.where.stamp_ns, one.topic, one.sighting) in seen]
        edges = {one.edge for one in gone}
        left = [one for one in landmark.seen if one.edge not in edges]
        if not left and len(gone) == landmark.sightings:
            self.prune(name)
            return
        landmark.seen = left
        landmark.stamps = {one.where.stamp_ns for one in left}
        landmark.sightings -= len(gone)
        if left and landmark.sightings == len(left):
            landmark.first_seen_ns, landmark.last_seen_ns = min(landmark.stamps), max(landmark.stamps)
            landmark.reset_features()
        self._withdraw_sightings(gone)
        self.changes += 1

    def withdraw_tentative(self, keyframe: int) -> None:
        """Withdraw what was seen of tentative landmarks before a keyframe, and count it."""
        for name, mark in [both for both in self.known.items() if both[1].is_tentative]:
            old = [one for one in mark.seen if one.where.keyframe < keyframe]
            for one in old:
                self._counters.count(one.topic, "condensed")
            if old:
                self.remove_sightings(name, {(one.where.stamp_ns, one.topic, one.sighting) for one in old})

    def confirm(self, name: str, *, is_sure: bool) -> None:
        """Mark a landmark as accepted, or as tentative again."""
        self.known[name].is_tentative = not is_sure
        self.changes += 1

    def _withdraw_sightings(self, seen: Sequence[LandmarkEdge], vertex: int | None = None) -> None:
        self._counters.used.subtract(one.topic for one in seen)
        self._backend.withdraw([one.edge for one in seen], vertex=vertex)

    def names(self) -> dict[int, str]:
        """Return the names of all landmarks, by their vertices."""
        return {landmark.vertex: name for name, landmark in self.known.items()}

    def positions(self, vertices: Sequence[int]) -> Array:
        """Positions (k, n) of landmarks in map."""
        n = self._space.dimensions
        out, at = np.empty((len(vertices), n)), np.array(vertices, dtype=np.int64)
        is_point = np.array([self.kind_of(v) is self._space.point for v in vertices], dtype=bool)
        for some in (is_point, ~is_point):
            if some.any():
                out[some] = self._solver.estimate(at[some])[:, :n]
        return out

    def seen_from(self, where: PoseAtStamp, points: Array) -> Array:
        """Return points (k, n) of map in the base frame at a stamp."""
        pose = self._space.group.compose(self._pose(where), where.T_keyframe_base)
        return np.asarray((points - np.array(pose[: self._space.dimensions])) @ self._space.turn(pose))

    def axes(self, landmark: Landmark) -> Array:
        """The rotation from a landmark's tangent space to the map's axes, for its position."""
        if self.kind_of(landmark.vertex) is self._space.point:
            return np.eye(self._space.dimensions)
        return self._space.turn(tuple(self._solver.estimate([landmark.vertex])[0].tolist()))

    def placed(self, values: Array, places: Mapping[str, Sequence[float]]) -> Array:
        """Stored numbers of all vertices, with landmarks at these positions."""
        for name, place in places.items():
            if name in self.known:
                begin = self._graph.vertex(self.known[name].vertex).stored.start
                values[begin : begin + len(place)] = place
        return values

    def is_held(self, name: str) -> bool:
        """Return whether a landmark is fixed."""
        return self._solver.is_held(self.known[name].vertex)

    def kind_of(self, vertex: int) -> VertexKind:
        """Return the kind of its vertex: point or pose."""
        return self._graph.kind_of(vertex)

    def chi2_of(self, edges: Sequence[int]) -> tuple[float, int]:
        """Sum of the squared whitened residuals of some edges, without loss, and their number."""
        chi2, numbers = self._solver.chi2_of(edges)
        return float(chi2.sum()), int(numbers.sum())

    def _note_undetermined(self, topic: str, name: str, s: Sighting, where: PoseAtStamp) -> None:
        candidate = self.undetermined.setdefault(name, UndeterminedLandmark(topic))
        is_elsewhere = not candidate.seen or candidate.seen[-1][0].keyframe != where.keyframe
        candidate.seen.append((where, s))
        if is_elsewhere:  # another scan from where the last was taken determines nothing
            self._determine(name, candidate)
        if len(candidate.seen) > _MAX_SIGHTINGS:
            del candidate.seen[1::2]

    def _determine(self, name: str, candidate: UndeterminedLandmark) -> None:
        glances = []
        for where, s in candidate.seen:
            covariance = motion_compensation.as_matrix(s.covariance) + LEAST_RAD2 * np.eye(len(s.measured))
            glances.append(PartialObservation(self._sensor_pose(s, where), s.kind, s.measured, covariance))
        candidate.places = possible_places(self._space, glances)
        candidate.reason = why_undetermined(self._space, self._solver, candidate.seen, glances, candidate.places)
        if not candidate.reason:
            del self.undetermined[name]
            at = tuple(candidate.places[0].position.tolist())
            landmark = self.known[name] = Landmark(name, self._graph.add_vertex(self._space.point, at))
            for where, s in candidate.seen:
                self._add_edge(candidate.topic, landmark, s, where)

    # -- where things are ----------------------------------------------------------------------------------------

    def _pose(self, where: PoseAtStamp) -> Numbers:
        return tuple(self._solver.estimate([where.vertex])[0].tolist())

    def _in_map(self, where: PoseAtStamp, point: Numbers) -> Numbers:
        return tuple(map(float, self._space.group.act(self._pose(where), point)))

    def _sensor_pose(self, s: Sighting, where: PoseAtStamp) -> Numbers:
        group = self._space.group
        T_map_base = group.compose(self._pose(where), where.T_keyframe_base)
        return tuple(map(float, group.compose(T_map_base, s.T_base_sensor or self._space.identity)))

    def _from_sensor(self, s: Sighting, where: PoseAtStamp, point: Array) -> Array:
        return np.array(self._space.group.act(self._sensor_pose(s, where), tuple(point.tolist())))
