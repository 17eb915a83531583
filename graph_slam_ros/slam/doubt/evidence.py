"""The evidence: the likelihood of what was seen along a stretch of odometry, under hypotheses on its errors.

An extended Kalman filter of the pose and of all that was seen follows the stretch. It begins with the joint covariance
that the solver has without these observations. An observation that does not fit costs the same whatever the errors are,
and changes nothing. So observations that the pipeline holds back are evidence, too, and wrong ones decide nothing.

A hypothesis is that odometry is as stated, that its errors are larger over a part of the stretch (it slipped), or that
the robot was moved at a keyframe: the generalized likelihood ratio test of Willsky and Jones ("A generalized likelihood
ratio approach to the detection and estimation of jumps in linear systems", 1976).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph import Edge, EdgeType, Graph, VertexKind
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.levels import BY_CHANCE, GATE, PRIOR_DOF
from graph_slam_ros.slam.noise.scale import LARGEST
from graph_slam_ros.typing import Array, Index, Numbers

LOG_ODDS = float(np.log(BY_CHANCE))  # of a slip within a stretch of odometry, before anything is seen
LOG_ODDS_MOVED = float(np.log(1e-2))  # of a robot that was moved, relative to one that slipped
_LEAST_FITTING = 0.6  # part of what was seen since then that a slip must explain
_LINEAR_RAD = 0.1  # by which an observation turns the pose: beyond, it is linearised again
_MOST_LINEARIZATIONS = 5  # of one observation
UNKNOWN, _KNOWN = 1.5, 1.2  # all noise may be larger by this factor, where it is not measured and where it is


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """An assumption on the errors of odometry along a stretch.

    Attributes
    ----------
    variances : (n, dof) that are added to the noise of n edges
    log_odds : before anything is seen, relative to odometry as it is stated
    kind : of a slip
    first : place of the first edge of odometry that it concerns
    there : pose in map of the keyframe after that edge, where the robot was moved
    """

    variances: Array
    log_odds: float = 0.0
    kind: str = ""
    first: int = 0
    there: Numbers | None = None


@dataclass(frozen=True, slots=True)
class _Observed:
    """An observation: what it is of, its edge type and measurement, its noise, and where its vertices are.

    ``at`` is where their stored numbers begin, ``columns`` are those of their errors. ``constant`` is the part of the
    cost that its noise is.
    """

    what: int | str
    type: EdgeType
    at: Index
    columns: Index
    measured: Array
    noise: Array
    constant: float
    limit: float


@dataclass(slots=True)
class _State:
    """The newest pose and all that was seen: stored numbers and the joint covariance of errors.

    The cost is minus twice the logarithm of the likelihood so far. Observations that do not fit are counted.
    """

    x: Array
    covariance: Array
    cost: float = 0.0
    unfit: int = 0

    def copy(self) -> "_State":
        return _State(self.x.copy(), self.covariance.copy(), self.cost, self.unfit)


_OfKind = tuple[VertexKind, Index, Index]
Prior = Callable[[Sequence[int]], tuple[Array, Array]]


class Stretch:
    """A chain of odometry edges, and what was seen from its keyframes.

    Parameters
    ----------
    links : the edges of odometry, in order
    seen : of each keyframe but the first, by its vertex, edges and what they are of
    prior : stored values of vertices, one after the other, and their joint covariance, without these observations
    factors : (dof,) by which odometry's sigmas are larger than stated
    noise_factor : all noise may be so many times larger
    """

    def __init__(
        self,
        space: Geometry,
        graph: Graph,
        links: Sequence[Edge],
        seen: Mapping[int, Sequence[tuple[int, int | str]]],
        prior: Prior,
        factors: Array,
        noise_factor: float,
    ) -> None:
        group, self._space, self._scale = space.group, space, noise_factor**2
        self._motions = [tuple(link.measured.tolist()) for link in links]
        self._turns = [group.adjoint(group.inverse(motion)) for motion in self._motions]
        self._noises = [covariance_of(link) * np.outer(factors, factors) for link in links]
        first, ends = links[0].vertices[0], [link.vertices[1] for link in links]
        edges = [[(what, graph.edge(edge)) for edge, what in seen.get(vertex, ())] for vertex in ends]
        others = list(
            dict.fromkeys(v for every in edges for _, one in every for v in one.vertices if v not in {first, *ends})
        )
        self._kinds, places = _layout(graph, [first, *others])
        # what is between two keyframes of the stretch is left out
        self._seen = [
            [
                _observed(what, one, [places[first if v == end else v] for v in one.vertices])
                for what, one in every
                if {*one.vertices} <= {end, *others}
            ]
            for end, every in zip(ends, edges, strict=True)
        ]
        # before each edge, and at the end: odometry as stated
        self._states = [_State(*prior([first, *others]))]
        stated = self.as_stated
        for k in range(len(links)):
            self._states.append(self._followed(self._states[k].copy(), k, stated, None))

    @property
    def size(self) -> int:
        """The number of edges."""
        return len(self._motions)

    @property
    def as_stated(self) -> Hypothesis:
        """The hypothesis that odometry has its own noise."""
        return Hypothesis(np.zeros((self.size, self._space.dof)), first=self.size)

    def likeliest(self, hypotheses: Sequence[Hypothesis]) -> tuple[Hypothesis, float]:
        """The hypothesis of highest probability, and the logarithm of its likelihood ratio to odometry as stated."""
        ratios = [0.5 * (self._states[-1].cost - self._end(one).cost) for one in hypotheses]
        k = max(range(len(ratios)), key=lambda k: ratios[k] + hypotheses[k].log_odds)
        return hypotheses[k], ratios[k]

    def voters(self, one: Hypothesis, log_ratio: float) -> int:
        """The number of landmarks, and of other classes of edges, without which a slip is less likely.

        0 where it is not likelier than none without any one of them, or leaves too much of what was seen unexplained.
        """
        since = [seen for of_keyframe in self._seen[one.first :] for seen in of_keyframe]
        unfit = self._end(one).unfit - self._states[one.first].unfit
        if unfit > (1.0 - _LEAST_FITTING) * len(since):
            return 0
        stated, without = self.as_stated, list[float]()
        for what in dict.fromkeys(seen.what for seen in since):
            without.append(0.5 * (self._end(stated, what).cost - self._end(one, what).cost))
        return sum(ratio < log_ratio for ratio in without) if min(without, default=0.0) > 0.0 else 0

    def _end(self, one: Hypothesis, without: int | str | None = None) -> _State:
        """The state at the end of the stretch."""
        begin = one.first if without is None else 0
        state = self._states[begin].copy()
        for k in range(begin, self.size):
            self._followed(state, k, one, without)
        return state

    def _followed(self, state: _State, k: int, one: Hypothesis, without: int | str | None) -> _State:
        """Follow an edge, and all that was seen after it, in place."""
        dof, p, turn = self._space.dof, state.covariance, self._turns[k]
        state.x[: len(self._motions[k])] = self._space.group.compose(
            tuple(state.x[: len(self._motions[k])]), self._motions[k]
        )
        if one.there is not None and k == one.first:
            state.x[: len(one.there)] = one.there
        p[:dof] = turn @ p[:dof]
        p[:, :dof] = p[:, :dof] @ turn.T
        p[:dof, :dof] += self._noises[k] + np.diag(one.variances[k]) / self._scale
        for seen in self._seen[k]:
            if seen.what != without:
                self._observe(state, seen)
        return state

    def _observe(self, state: _State, seen: _Observed) -> None:
        """Add an observation: the state follows it if it fits.

        Where it turns the pose far, it is linearised again at the state to which it leads (an iterated filter).
        """
        columns, turns, dof = seen.columns, slice(self._space.dimensions, self._space.dof), self._space.dof
        point, step, into = state.x, np.zeros(len(state.covariance)), None
        for _ in range(_MOST_LINEARIZATIONS):
            residual, jacobian = seen.type.linearize(point, seen.at, seen.measured)
            slope = jacobian[0] if into is None else jacobian[0] @ into[np.ix_(columns, columns)]
            innovation, rows = residual[0] - slope @ step[columns], slope @ state.covariance[columns]
            root, failed = dpotrf(rows[:, columns] @ slope.T + seen.noise, lower=True)
            if failed:
                raise np.linalg.LinAlgError("the covariance of an innovation is not positive definite")
            gain = dpotrs(root, rows, lower=True)[0]
            before, step = step, -innovation @ gain
            point = self._stepped(state.x, step)
            if np.abs(step[turns] - before[turns]).max() <= _LINEAR_RAD:
                break
            into = np.eye(len(step))  # from errors of the state to those of where it leads
            into[:dof, :dof] = self._space.group.right_jacobian(tuple(step[:dof].tolist()))
        statistic = float(innovation @ dpotrs(root, innovation, lower=True)[0]) / self._scale
        if statistic > seen.limit:
            state.cost += seen.limit
            state.unfit += 1
            return
        state.x = point
        state.covariance -= rows.T @ gain
        if into is not None:
            state.covariance = into @ state.covariance @ into.T
        state.cost += statistic + 2.0 * float(np.log(root.diagonal()).sum()) + seen.constant

    def _stepped(self, x: Array, step: Array) -> Array:
        """Stored numbers after a step of all errors."""
        out = np.empty_like(x)
        for kind, stored, columns in self._kinds:
            out[stored] = kind.retract(x[stored], step[columns])
        return out


def _observed(what: int | str, one: Edge, places: Sequence[tuple[int, Index]]) -> _Observed:
    """Lay out an observation of vertices that are at these places."""
    covariance, constant = covariance_of(one), 2.0 * float(np.linalg.slogdet(one.sqrt_information)[1])
    at, columns = np.array([[stored for stored, _ in places]]), np.concatenate([columns for _, columns in places])
    limit = quantile(GATE, len(covariance))
    return _Observed(what, one.type, at, columns, one.measured[None], covariance, constant, limit)


def measured_noise(space: Geometry, backend: Backend) -> tuple[Array, float]:
    """Factors (dof,) by which odometry's sigmas are larger than stated, at least 1, and by which all noise may be."""
    n, of_odometry, others = space.dimensions, np.ones(space.dof), list[float]()
    for one in backend.noise_scale(("odometry", "landmarks")):
        if one.label == "odometry" and one.dof > 0.0:
            variance = (one.per_dof * one.dof + PRIOR_DOF) / (one.dof + PRIOR_DOF)
            part = slice(n) if one.part == "position" else slice(n, None)
            of_odometry[part] = np.maximum(of_odometry[part], np.sqrt(np.clip(variance, 1.0, LARGEST**2)))
        elif one.label == "landmarks" and not one.reason:
            others.append(one.factor)
    return of_odometry, _KNOWN * max([1.0, *others]) if others else UNKNOWN


def covariance_of(one: Edge) -> Array:
    """The covariance (m, m) of the noise of an edge."""
    return np.asarray(np.linalg.inv(one.sqrt_information.T @ one.sqrt_information))


def _layout(graph: Graph, vertices: Sequence[int]) -> tuple[list[_OfKind], dict[int, tuple[int, Index]]]:
    """Where the stored numbers and the errors of vertices are that come one after the other.

    Returns them for all vertices of each kind, and where the numbers of each vertex begin, with its columns.
    """
    stored, column, of_kind = 0, 0, dict[VertexKind, tuple[list[Index], list[Index]]]()
    places = dict[int, tuple[int, Index]]()
    for vertex in vertices:
        kind = graph.kind_of(vertex)
        columns = np.arange(column, column + kind.dof)
        places[vertex] = stored, columns
        numbers, errors = of_kind.setdefault(kind, ([], []))
        numbers.append(np.arange(stored, stored + kind.size))
        errors.append(columns)
        stored, column = stored + kind.size, column + kind.dof
    return [(kind, np.stack(numbers), np.stack(errors)) for kind, (numbers, errors) in of_kind.items()], places
