"""Advice on what to measure next: which single addition makes the weakest pose or landmark of a run better known.

The sigma that an addition leaves is predicted by a low-rank update of the marginals of the solver. With A the whitened
Jacobian of what is added, Sigma the joint covariance of its vertices, and a the direction that counts::

    var' = a' Sigma a - (A Sigma a)' (I + A Sigma A')^-1 (A Sigma a)

One joint covariance of a bounded sample of keyframes and landmarks is computed, so that the time is bounded, too.
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
from graph_slam_ros.tools.advise.weakness import Weakness
from graph_slam_ros.typing import Array, Index, Numbers

_Key = tuple[str, EdgeType]

SIGHTING, SURVEY, CLOSURE, TAG = "sighting", "survey", "closure", "new tag"
NEW = -1  # the vertex of a landmark that is not there yet
_NEAR, _NEAR_M = 0.15, 0.3  # of the distance, and at least: so far from a sighting of the run a landmark is seen, too
_SAME_SIDE = 0.7  # between the directions from which a tag with orientation is seen: 40 degrees
_TEMPLATES = 5000  # sightings of an input and type that are learnt from
_TAG_SIGHTINGS = 24  # of a new tag
_CLOSURE_M, _CLOSURE_RAD = 0.05, 0.01  # sigmas of a closure where the run has none
KINDS = (SIGHTING, SURVEY, CLOSURE, TAG)
_ON_PATH = 60  # keyframes by which the error of the whole path is judged
_COLUMNS = 600  # degrees of freedom of the sampled keyframes, and as many of landmarks
_EVALUATED = 2000  # additions of each kind
_REACH_M, _APART = 2.0, 5.0  # between the ends of a closure; along the path as many times that
_PLACES = 40  # keyframes near which a new tag is tried
_LEAST_GAIN = 0.02  # of the sigma: what gains less is no advice


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

    What a sensor sees, and how well, is learnt from the run. A keyframe can see a landmark if the run has a sighting by
    the same input, of the same type, at nearly the same place relative to the robot. The added sighting gets the noise
    of that one.

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
            key = entry.source, self._run.graph.edge(entry.edge).type
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
        driven = self._travelled_m[list(self._keyframes)]
        far = [(a, b) for a, b in sorted(pairs) if abs(driven[b] - driven[a]) > apart * reach_m]
        noise, source, share, assumed = self._closure_noise()
        for a, b in far[:: max(1, -(-len(far) // most))]:
            ends, start = (vertices[a], vertices[b]), np.array(self._space.identity)
            like = PlannedEdge(self._space.relative_pose, ends, start, noise, "closures", source, share)
            names = " and ".join(str(self._run.numbers[self._keyframes[k]]) for k in (a, b))
            about = f"close the loop between keyframes {names} {self._at(vertices[b])}{assumed}"
            yield Addition(CLOSURE, about, (self._as_expected(like, ()),))

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


@dataclass(frozen=True, slots=True)
class Advice:
    """An addition with what it gains.

    Attributes
    ----------
    predicted : sigma of the weakest direction with the addition [m or rad]
    path_now_m, path_m : root mean square of the position sigmas of the sampled keyframes, as it is and with it
    """

    addition: Addition
    predicted: float
    path_now_m: float
    path_m: float


class Advisor:
    """Predictions for one run.

    Parameters
    ----------
    survey_sigma : as of ``Additions``

    Attributes
    ----------
    weakest : the weakest position, heading and landmark
    keyframes, landmarks : the sample: indices of keyframes, and names
    """

    def __init__(self, weakness: Weakness, survey_sigma: float = 0.02) -> None:
        self._weakness, self._run = weakness, weakness.run
        self._space, self._graph = weakness.run.space, weakness.run.graph
        self.weakest = list(weakness.weakest())
        self.keyframes = self._sampled_keyframes()
        self.landmarks = self._sampled_landmarks()
        self._survey_sigma = survey_sigma
        self._join()

    # -- the sample ------------------------------------------------------------------------------------------------

    def _sampled_keyframes(self) -> list[int]:
        """All keyframes; of a long run those near what is weakest, and the others evenly."""
        count, n = len(self._run.keyframes), self._space.dimensions
        most = _COLUMNS // self._space.dof
        if count <= most:
            return list(range(count))
        chosen = {*np.linspace(0, count - 1, most // 3).astype(int).tolist(), *(one.keyframe for one in self.weakest)}
        share = (most - len(chosen)) // len(self.weakest)
        positions = self._weakness.poses[:, :n]
        for one in self.weakest:
            order = np.argsort(np.linalg.norm(positions - np.array(one.value[:n]), axis=1), kind="stable")
            chosen |= set([k for k in order.tolist() if k not in chosen][:share])
        return sorted(chosen)

    def _sampled_landmarks(self) -> list[str]:
        """The landmarks near what is weakest, the nearest first."""
        n, landmarks = self._space.dimensions, self._run.landmarks
        names = [name for name in landmarks if landmarks[name] not in self._run.held]
        if not names:
            return []
        at = np.array([self._weakness.value(landmarks[name])[:n] for name in names])
        near = np.min([np.linalg.norm(at - np.array(one.value[:n]), axis=1) for one in self.weakest], axis=0)
        dofs = max(self._graph.kind_of(landmarks[name]).dof for name in names)
        return [names[k] for k in np.argsort(near, kind="stable")[: _COLUMNS // dofs].tolist()]

    def _join(self) -> None:
        """Compute the joint covariance of the sample, and that of each weakest direction with it."""
        run = self._run
        vertices = [run.keyframes[k] for k in self.keyframes] + [run.landmarks[name] for name in self.landmarks]
        vertices += [one.vertex for one in self.weakest]
        thirds = {v for e in run.entries if e.is_in and e.landmark for v in e.vertices[2:]}
        unique = list(dict.fromkeys([*vertices, *sorted(thirds)]))
        joint = run.solver.joint_marginal(unique)
        first = np.cumsum([0, *(self._graph.kind_of(v).dof for v in unique)])
        self._columns = {v: np.arange(first[k], first[k + 1]) for k, v in enumerate(unique)}
        n = self._space.dimensions
        self._on_path = self.keyframes[:: -(-len(self.keyframes) // _ON_PATH)]
        at = [self._columns[run.keyframes[k]][:n] for k in self._on_path]
        self._path = np.concatenate(at)  # body axes: the sum over a position is the same in any
        self._joint = joint
        functionals = np.zeros((len(joint), len(self.weakest)))
        for k, one in enumerate(self.weakest):
            functionals[self._columns[one.vertex], k] = one.functional
        self._with_weakest = joint @ functionals
        self._now = np.einsum("ij,ij->j", functionals, self._with_weakest)
        self._path_now = float(np.diag(joint)[self._path].sum())

    # -- predictions -----------------------------------------------------------------------------------------------

    def rows(self, addition: Addition) -> tuple[Array, Array]:
        """The whitened Jacobian (m, c) of an addition, and its columns (c,) in the joint covariance.

        A new landmark is eliminated: what remains is what its sightings together say of the poses.
        """
        width = {v: dof for edge in addition.edges for v, dof in zip(edge.vertices, edge.type.dofs, strict=True)}
        start = dict(zip(width, np.cumsum([0, *width.values()]).tolist(), strict=False))
        rows = []
        for edge in addition.edges:
            x, at = stored_values(self._graph, self._run.solver.values, edge, addition.value)
            _, jacobian = edge.type.linearize(x, at, edge.measured[None])
            own = np.concatenate([start[v] + np.arange(width[v]) for v in edge.vertices])
            wide = np.zeros((jacobian.shape[1], sum(width.values())))
            wide[:, own] = edge.share**0.5 * edge.noise.sqrt_information @ jacobian[0]
            rows.append(wide)
        columns = np.concatenate([self._columns[v] for v in width if v != NEW])
        if NEW not in width:
            return np.vstack(rows), columns
        new = start[NEW] + np.arange(width[NEW])
        left, singular, _ = np.linalg.svd(np.vstack(rows)[:, new])
        rank = int((singular > 1e-9 * singular.max(initial=0.0)).sum())
        return left[:, rank:].T @ np.delete(np.vstack(rows), new, axis=1), columns

    def predict(self, addition: Addition) -> tuple[Array, float]:
        """Predict the sigma of each weakest direction, and the root mean square of the position sigmas on the path."""
        a, columns = self.rows(addition)
        innovation = np.eye(len(a)) + a @ self._joint[np.ix_(columns, columns)] @ a.T
        root = np.linalg.cholesky(innovation)
        gain = np.linalg.solve(root, a @ self._with_weakest[columns])
        of_path = np.linalg.solve(root, a @ self._joint[np.ix_(columns, self._path)])
        left = np.maximum(self._now - (gain**2).sum(axis=0), 0.0)
        path = max(self._path_now - float((of_path**2).sum()), 0.0)
        return np.sqrt(left), float(np.sqrt(path / len(self._on_path)))

    def advise(self, kinds: Sequence[str] = KINDS) -> list[list[Advice]]:
        """Evaluate all additions; returns for each of ``weakest`` what helps, the best first."""
        out: list[list[Advice]] = [[] for _ in self.weakest]
        path_now = float(np.sqrt(self._path_now / len(self._on_path)))
        for addition in self.additions(kinds):
            sigmas, path = self.predict(addition)
            for k, now in enumerate(np.sqrt(self._now)):
                if sigmas[k] < (1.0 - _LEAST_GAIN) * now:
                    out[k].append(Advice(addition, float(sigmas[k]), path_now, path))
        return [sorted(some, key=lambda one: one.predicted) for some in out]

    def additions(self, kinds: Sequence[str] = KINDS) -> Iterator[Addition]:
        """The additions that are possible, of each kind at most a bounded number."""
        known = Additions(self._run, self.keyframes, self._weakness.travelled_m, self._survey_sigma)
        makers = {
            SIGHTING: lambda: known.sightings(self.landmarks),
            SURVEY: lambda: known.surveys(self.landmarks),
            CLOSURE: lambda: known.closures(_REACH_M, _APART, _EVALUATED // 10),
            TAG: lambda: known.tags(self._places()),
        }
        for kind in kinds:
            for _, addition in zip(range(_EVALUATED), makers[kind](), strict=False):
                yield addition

    def why_nothing(self) -> str:
        """Return the reason why nothing may be found that helps, in words."""
        if not self.landmarks:
            return "the run has no landmark, and its path comes back to no place; drive past tags, or back to the start"
        return f"no landmark near it can be seen better, and no tag along the path helps by {_LEAST_GAIN:.0%}"

    def _places(self) -> list[int]:
        """The keyframes at which a new tag is tried: those near what is weakest."""
        n, positions = self._space.dimensions, self._weakness.poses[self.keyframes][:, : self._space.dimensions]
        near = np.min([np.linalg.norm(positions - np.array(one.value[:n]), axis=1) for one in self.weakest], axis=0)
        nearest = np.argsort(near, kind="stable")[: 2 * _PLACES].tolist()
        return sorted(self.keyframes[k] for k in nearest[::2])
