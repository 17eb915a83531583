"""A stretch of odometry filtered anew, with larger errors than its own: the likelihood of what was seen along it.

It is an extended Kalman filter of the newest pose and of all that was seen. It begins with the joint covariance that
the solver has without these observations. An observation that does not fit costs the same whatever the errors are, and
changes nothing. So observations that the pipeline holds back are evidence, too, and wrong ones decide nothing.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph import Edge, EdgeType, Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.typing import Array, Index, Numbers

_ROUNDING = 1e-6  # of a cost
_CAP = 0.9999  # an observation beyond this quantile does not fit
_LINEAR_RAD = 0.1  # by which an observation turns the pose: beyond, it is linearised again
_MOST_LINEARIZATIONS = 5

Prior = Callable[[Sequence[int]], tuple[Array, Array]]


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of n edges of odometry that are added to their own noise.

    Attributes
    ----------
    variances : (n, dof) of errors that differ from edge to edge
    shared : (n, dof) sigmas of one error that is the same in all
    jump : the edge, by its place, across which the robot was moved
    there : pose in map of the keyframe after that edge
    jump_variances : (dof,) of that pose
    """

    variances: Array
    shared: Array
    jump: int | None = None
    there: Numbers = ()
    jump_variances: Array | None = None


@dataclass(frozen=True, slots=True)
class Stretch:
    """A chain of odometry edges, and what was seen from its keyframes.

    Attributes
    ----------
    links : the edges, in order
    seen : of each keyframe, by its vertex, edges and what they are of
    factors : (dof,) by which odometry's sigmas are larger than stated
    noise_factor : all noise may be so many times larger
    """

    links: Sequence[int]
    seen: Mapping[int, Sequence[tuple[int, int | str]]]
    factors: Array
    noise_factor: float


@dataclass(slots=True)
class _State:
    """The newest pose, the shared error and all that was seen: stored values, and the joint covariance of errors.

    ``x`` begins with the pose. The cost is minus twice the logarithm of the likelihood so far; ``spread`` is the part
    of it that would be left if all were seen where it was expected. Observations that do not fit are counted.
    """

    x: Array
    shared: float
    covariance: Array
    cost: float = 0.0
    spread: float = 0.0
    unfit: int = 0


@dataclass(frozen=True, slots=True)
class _Step:
    """An edge of odometry: its measurement, the covariance of its noise with the factors, and what it does to errors.

    Attributes
    ----------
    moves : (dof, dof + 1) from errors of the pose before and the shared error to those of the pose after
    """

    measured: Numbers
    covariance: Array
    moves: Array


@dataclass(frozen=True, slots=True)
class _Seen:
    """An observation from the newest pose, which is the same under each hypothesis.

    Attributes
    ----------
    what : it is of
    at : (1, k) where its vertices begin in ``_State.x``
    columns : of its vertices in the covariance
    noise : (m, m) covariance
    log_root : logarithm of the determinant of the square root of the information
    """

    what: int | str
    type: EdgeType
    at: Index
    measured: Array
    columns: Index
    noise: Array
    log_root: float
    cap: float


class OdometryFilter:
    """Likelihood of a stretch under hypotheses on its odometry.

    Parameters
    ----------
    prior : stored values of vertices, one after the other, and their joint covariance (D, D), without the observations
        of the stretch

    Raises
    ------
    GaugeError, SingularError
        From the prior.
    """

    def __init__(self, space: Geometry, graph: Graph, prior: Prior, stretch: Stretch) -> None:
        self._space, self._stretch = space, stretch
        self._turns = slice(space.dimensions, space.dof)  # of errors of the newest pose
        links = [graph.edge(link) for link in stretch.links]
        chain = {vertex for link in links for vertex in link.vertices}
        first = links[0].vertices[0]
        edges = [edge for seen in stretch.seen.values() for edge, _ in seen]
        others = sorted({vertex for edge in edges for vertex in graph.edge(edge).vertices} - chain)
        x, joint = prior([first, *others])
        dof, kinds = space.dof, [graph.kind_of(vertex) for vertex in others]
        begins = dof + 1 + np.concatenate(([0], np.cumsum([kind.dof for kind in kinds], dtype=np.int64)))
        stored = space.pose.size + np.concatenate(([0], np.cumsum([kind.size for kind in kinds], dtype=np.int64)))
        self._columns = {v: np.arange(begins[k], begins[k + 1]) for k, v in enumerate(others)}
        self._stored = {v: np.arange(stored[k], stored[k + 1]) for k, v in enumerate(others)}
        self._kinds = [
            (
                kind,
                np.stack([self._stored[v] for v, one in zip(others, kinds, strict=True) if one is kind]),
                np.stack([self._columns[v] for v, one in zip(others, kinds, strict=True) if one is kind]),
            )
            for kind in dict.fromkeys(kinds)
        ]
        covariance = np.zeros((begins[-1], begins[-1]))
        kept = np.r_[0:dof, dof + 1 : begins[-1]]
        covariance[np.ix_(kept, kept)] = joint
        covariance[dof, dof] = 1.0 / stretch.noise_factor**2
        self._start = _State(x, 0.0, covariance)
        scale = np.outer(stretch.factors, stretch.factors)
        noises = _noises(links)
        self._steps = [
            self._step(link, covariance * scale) for link, (covariance, _) in zip(links, noises, strict=True)
        ]
        self._ends = [link.vertices[1] for link in links]
        self._seen = self._observations(graph)
        self._tight = list[_State]()  # before each edge and at the end, with odometry's own noise

    def _step(self, link: Edge, covariance: Array) -> _Step:
        measured = tuple(link.measured.tolist())
        return _Step(measured, covariance, self._moves(measured, np.zeros(self._space.dof)))

    def _moves(self, motion: Numbers, shared: Array) -> Array:
        group = self._space.group
        return np.column_stack((group.adjoint(group.inverse(motion)), shared))

    def _observations(self, graph: Graph) -> list[list[_Seen]]:
        """Return what was seen from each keyframe, without what is between two keyframes of the stretch."""
        dof, seen = self._space.dof, self._stretch.seen
        every = [(k, what, graph.edge(edge)) for k, v in enumerate(self._ends) for edge, what in seen.get(v, ())]
        every = [(k, what, one) for k, what, one in every if {*one.vertices} <= {self._ends[k], *self._columns}]
        out: list[list[_Seen]] = [[] for _ in self._ends]
        for (k, what, one), (noise, log_root) in zip(every, _noises([one for *_, one in every]), strict=True):
            pose = self._ends[k]
            at = np.array([[0 if v == pose else self._stored[v][0] for v in one.vertices]])
            columns = np.concatenate([np.arange(dof) if v == pose else self._columns[v] for v in one.vertices])
            cap = quantile(_CAP, len(noise))
            out[k].append(_Seen(what, one.type, at, one.measured[None], columns, noise, log_root, cap))
        return out

    @property
    def size(self) -> int:
        """The number of edges."""
        return len(self._steps)

    def seen_since(self, first: int) -> list[int | str]:
        """Landmarks, by vertex, and other classes that were seen after an edge, by its place."""
        return sorted({what for v in self._ends[first:] for _, what in self._stretch.seen.get(v, ())}, key=str)

    def log_likelihood(
        self, errors: Errors, first: int, without: int | str | None = None, above: float = -np.inf
    ) -> float:
        """Return the logarithm of the likelihood of what was seen, but for a constant.

        Parameters
        ----------
        first : the first edge that has more errors than its noise, by its place
        without : what is left out
        above : a value up to this is of no interest; it may be returned as minus infinity
        """
        state, begin = self._start, 0
        if without is None and len(self._tight) > first:
            state, begin = self._tight[first], first
            if self._least_cost(first) > -2.0 * above + _ROUNDING:
                return -np.inf
        return -0.5 * self._filtered(state, begin, errors, first, without, -2.0 * above).cost

    def _least_cost(self, first: int) -> float:
        """A bound of the cost if odometry has more errors from an edge on, where all that was seen since then fits.

        At best all was seen where it was expected. The spread of what is expected is not smaller then.
        """
        before, end = self._tight[first], self._tight[-1]
        return before.cost + end.spread - before.spread if end.unfit == before.unfit else -np.inf

    def fitting(self, errors: Errors, first: int) -> float:
        """Return the part of what was seen after an edge that fits."""
        begin = self._tight[first]
        end = self._filtered(begin, first, errors, first)
        count = sum(len(self._stretch.seen.get(vertex, ())) for vertex in self._ends[first:])
        return 1.0 - (end.unfit - begin.unfit) / max(1, count)

    def _filtered(
        self,
        state: _State,
        begin: int,
        errors: Errors,
        first: int,
        without: int | str | None = None,
        most: float = np.inf,
    ) -> _State:
        """Filter what was seen from an edge on. The cost never falls, so one above ``most`` is not followed further."""
        for k in range(begin, len(self._steps)):
            if state.cost > most + _ROUNDING:
                return replace(state, cost=np.inf)
            if without is None and first == len(self._steps):
                self._tight.append(state)
            state = replace(state, x=state.x.copy(), covariance=state.covariance.copy())
            self._move(state, k, errors)
            for one in self._seen[k]:
                if one.what != without:
                    self._observe(state, one)
        if without is None and first == len(self._steps):
            self._tight.append(state)
        return state

    def _move(self, state: _State, k: int, errors: Errors) -> None:
        """Move the pose along one edge of odometry."""
        space, step, dof, scale = self._space, self._steps[k], self._space.dof, self._stretch.noise_factor**2
        shared, motion, moves = errors.shared[k], step.measured, step.moves
        if shared.any():
            motion = space.group.retract(motion, tuple((shared * state.shared).tolist()))
            moves = self._moves(motion, shared)
        pose = space.group.compose(tuple(state.x[: space.pose.size].tolist()), motion)
        variances = errors.variances[k]
        if errors.jump == k and errors.jump_variances is not None:
            pose, variances = errors.there, variances + errors.jump_variances
        covariance = state.covariance
        covariance[:dof] = moves @ covariance[: dof + 1]
        covariance[:, :dof] = covariance[:, : dof + 1] @ moves.T
        covariance[:dof, :dof] += step.covariance
        covariance.ravel()[: dof * (len(covariance) + 1) : len(covariance) + 1] += variances / scale  # the diagonal
        state.x[: space.pose.size] = pose

    def _observe(self, state: _State, one: _Seen) -> None:
        """Add an observation. The state follows it if it fits.

        Where it turns the pose far, it is linearised again at the state to which it leads (an iterated filter).
        """
        x, step, tangent, turns = state.x, np.zeros(len(state.covariance)), None, self._turns
        for _ in range(_MOST_LINEARIZATIONS):
            residuals, jacobians = one.type.linearize(x, one.at, one.measured)
            residual, jacobian = residuals[0], jacobians[0]
            if tangent is not None:
                pose, jacobian = one.columns < len(tangent), jacobian.copy()
                jacobian[:, pose] = jacobian[:, pose] @ tangent
                residual = residual - jacobian @ step[one.columns]
            gain = jacobian @ state.covariance[one.columns]
            factor, failed = dpotrf(gain[:, one.columns] @ jacobian.T + one.noise, lower=True)
            if failed:
                raise np.linalg.LinAlgError("the covariance of an innovation is not positive definite")
            white = dtrtrs(factor, residual, lower=True)[0]
            gain, before = dtrtrs(factor, gain, lower=True)[0], step
            step = -white @ gain
            if np.abs(step[turns] - before[turns]).max() <= _LINEAR_RAD:
                break
            x = self._stepped(state.x, step)
            tangent = self._space.group.right_jacobian(tuple(step[: self._space.dof].tolist()))
        statistic = float(white @ white) / self._stretch.noise_factor**2
        if statistic > one.cap:
            state.cost += one.cap
            state.unfit += 1
            return
        state.x, state.shared = self._stepped(state.x, step), state.shared + float(step[self._space.dof])
        state.covariance -= gain.T @ gain
        if tangent is not None:  # of the pose that it leads to
            dof, covariance = len(tangent), state.covariance
            covariance[:dof] = tangent @ covariance[:dof]
            covariance[:, :dof] = covariance[:, :dof] @ tangent.T
        spread = 2.0 * (log(factor.diagonal().prod()) + one.log_root)
        state.cost += statistic + spread
        state.spread += spread

    def _stepped(self, x: Array, step: Array) -> Array:
        """The values after a step (D,) of errors."""
        out, pose = x.copy(), self._space.pose
        out[: pose.size] = pose.retract(x[None, : pose.size], step[None, : self._space.dof])[0]
        for kind, stored, columns in self._kinds:
            out[stored] = kind.retract(x[stored], step[columns])
        return out


def _noises(edges: Sequence[Edge]) -> list[tuple[Array, float]]:
    """Return the covariance (m, m) of the noise of each edge, and the logarithm of the determinant of its root."""
    out: dict[int, tuple[Array, float]] = {}
    for size in {len(one.sqrt_information) for one in edges}:
        of_size = [k for k, one in enumerate(edges) if len(one.sqrt_information) == size]
        roots = np.stack([edges[k].sqrt_information for k in of_size])
        covariances, logarithms = np.linalg.inv(roots.swapaxes(1, 2) @ roots), np.linalg.slogdet(roots)[1]
        out |= zip(of_size, zip(covariances, logarithms.tolist(), strict=True), strict=True)
    return [out[k] for k in range(len(edges))]
