"""A stretch of odometry filtered anew, with larger errors than its own: the likelihood of what was seen along it.

It is an extended Kalman filter of the newest pose and of all that was seen. It begins with the joint covariance that
the solver has without these observations. An observation that does not fit costs the same whatever the errors are, and
changes nothing. So observations that the pipeline holds back are evidence, too, and wrong ones decide nothing.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph import Edge, Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.graph.records import native_or_plain
from graph_slam_ros.graph.vertices import code_of
from graph_slam_ros.solver import stretch_filter
from graph_slam_ros.typing import Array, Index, Numbers

_ROUNDING = 1e-6  # of a cost
_CAP = 0.9999  # an observation beyond this quantile does not fit

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


@dataclass(frozen=True, slots=True)
class _State:
    """The newest pose, the shared error and all that was seen: stored values, and the joint covariance of errors.

    ``x`` begins with the pose. The sums are the shared error, the cost, which is minus twice the logarithm of the
    likelihood so far, its spread, and a count: the spread is the part of the cost that would be left if all were seen
    where it was expected, and observations that do not fit are counted.
    """

    x: Array
    covariance: Array
    sums: Array

    @property
    def cost(self) -> float:
        """The cost so far."""
        return float(self.sums[stretch_filter.COST])

    @property
    def spread(self) -> float:
        """Its part that does not depend on what was seen."""
        return float(self.sums[stretch_filter.SPREAD])

    @property
    def unfit(self) -> int:
        """The number of observations that do not fit."""
        return int(self.sums[stretch_filter.UNFIT])


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
        links = [graph.edge(link) for link in stretch.links]
        self._ends = [link.vertices[1] for link in links]
        chain, first = {vertex for link in links for vertex in link.vertices}, links[0].vertices[0]
        every = [
            (k, what, graph.edge(edge)) for k, v in enumerate(self._ends) for edge, what in stretch.seen.get(v, ())
        ]
        others = dict.fromkeys(  # in the order of their last observation, the last first
            v for _, _, one in reversed(every) for v in one.vertices if v not in chain
        )
        self._start = self._prior(prior, first, list(others))
        self._vertices = self._layout(graph, first, list(others))
        # what is between two keyframes of the stretch is left out
        self._observe([(k, what, one) for k, what, one in every if {*one.vertices} <= {self._ends[k], *others}], others)
        noises = np.stack([covariance for covariance, _ in _noises(links)])
        self._motions = np.stack([link.measured for link in links])
        self._noises = noises * np.outer(stretch.factors, stretch.factors)
        self._tight: _State | None = None  # before each edge and at the end, with odometry's own noise

    def _prior(self, prior: Prior, first: int, others: Sequence[int]) -> _State:
        """Return the state before the stretch, with a shared error that is not known yet."""
        (x, joint), dof = prior([first, *others]), self._space.dof
        covariance, kept = np.zeros((len(joint) + 1, len(joint) + 1)), np.delete(np.arange(len(joint) + 1), dof)
        covariance[np.ix_(kept, kept)] = joint
        covariance[dof, dof] = 1.0 / self._stretch.noise_factor**2
        return _State(np.array(x, dtype=float), covariance, np.zeros(4))

    def _layout(self, graph: Graph, first: int, others: Sequence[int]) -> Index:
        """Return where the stored numbers of the pose and of what is seen begin, their kinds and dofs."""
        kinds = [graph.kind_of(vertex) for vertex in (first, *others)]
        stored = np.cumsum([0, *(kind.size for kind in kinds[:-1])])
        return np.column_stack((stored, [code_of(kind) for kind in kinds], [kind.dof for kind in kinds]))

    def _observe(self, every: Sequence[tuple[int, int | str, Edge]], others: Mapping[int, object]) -> None:
        """Lay out what was seen for the kernel: from which keyframe, by its place, of what, and the edge."""
        dof = self._space.dof
        begins = np.cumsum([0, dof + 1, *self._vertices[1:, stretch_filter.DOF]])
        place = {vertex: k for k, vertex in enumerate(others, start=1)}
        names = self._names = {what: k for k, what in enumerate(dict.fromkeys(what for _, what, _ in every))}
        integers, numbers, rows, limits = list[int](), list[float](), list[list[int]](), list[tuple[float, float]]()
        for (k, what, one), (noise, log_root) in zip(every, _noises([one for *_, one in every]), strict=True):
            places = [0 if v == self._ends[k] else place[v] for v in one.vertices]
            at = self._vertices[places, stretch_filter.STORED].tolist()
            columns = [c for v in places for c in range(begins[v], begins[v] + self._vertices[v, stretch_filter.DOF])]
            begin, seen = [len(integers), len(numbers)], one.measured.tolist()
            integers += [*at, *columns]
            numbers += [*seen, *noise.ravel().tolist()]
            sizes = len(at), begin[1], len(seen), len(noise), begin[0] + len(at), len(columns), begin[1] + len(seen)
            rows.append([begin[0], *sizes, names[what], max(places), 0])
            limits.append((quantile(_CAP, len(noise)), log_root))
        observations = np.array(rows, dtype=np.int64).reshape(-1, stretch_filter.FIELDS)
        kept = np.maximum.accumulate(observations[::-1, stretch_filter.KEPT])[::-1] + 1
        observations[:, stretch_filter.KEPT], observations[:, stretch_filter.KEPT_COLUMNS] = kept, begins[kept]
        self._run, linearize = native_or_plain(stretch_filter.filter_stretch, [one.type.linearize for *_, one in every])
        is_native = self._run is stretch_filter.filter_stretch
        self._seen = (
            np.array(linearize, dtype=np.int64) if is_native else linearize,
            observations,
            np.searchsorted([k for k, *_ in every], np.arange(self.size + 1)),
            np.array(numbers, dtype=float),
            np.array(integers, dtype=np.int64),
            np.array(limits, dtype=float).reshape(-1, 2),
        )

    @property
    def size(self) -> int:
        """The number of edges."""
        return len(self._ends)

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
        if without is not None or self._tight is None:
            begin = 0
        else:
            begin = first
            if self._least_cost(first) > -2.0 * above + _ROUNDING:
                return -np.inf
        is_tight = without is None and first == self.size
        return -0.5 * self._filtered(begin, errors, without, -2.0 * above, is_kept=is_tight).cost

    def _least_cost(self, first: int) -> float:
        """A bound of the cost if odometry has more errors from an edge on, where all that was seen since then fits.

        At best all was seen where it was expected. The spread of what is expected is not smaller then.
        """
        before, end = self._before(first), self._before(self.size)
        return before.cost + end.spread - before.spread if end.unfit == before.unfit else -np.inf

    def fitting(self, errors: Errors, first: int) -> float:
        """Return the part of what was seen after an edge that fits."""
        end = self._filtered(first, errors)
        count = sum(len(self._stretch.seen.get(vertex, ())) for vertex in self._ends[first:])
        return 1.0 - (end.unfit - self._before(first).unfit) / max(1, count)

    def _before(self, edge: int) -> _State:
        """The state before an edge, or at the end, with odometry's own noise."""
        if edge == 0 or self._tight is None:
            return self._start
        return _State(self._tight.x[edge], self._tight.covariance[edge], self._tight.sums[edge])

    def _filtered(
        self,
        begin: int,
        errors: Errors,
        without: int | str | None = None,
        most: float = np.inf,
        *,
        is_kept: bool = False,
    ) -> _State:
        """Filter what was seen from an edge on. The cost never falls, so one above ``most`` is not followed further.

        Parameters
        ----------
        is_kept : whether the states on the way are those of odometry's own noise
        """
        start = self._before(begin)
        state, count = _State(start.x.copy(), start.covariance.copy(), start.sums.copy()), self.size + 1
        every = (state.x, state.covariance, state.sums)
        kept = _State(*(np.empty((count if is_kept else 0, *one.shape)) for one in every))
        jump, there = -1 if errors.jump is None else errors.jump, np.array(errors.there, dtype=float)
        variances = errors.variances
        if errors.jump is not None and errors.jump_variances is not None:
            variances = variances.copy()
            variances[jump] += errors.jump_variances
        hypothesis = variances, errors.shared, jump, there, begin, self._names.get(without, -1), most  # type: ignore[arg-type]
        failed = self._run(
            *self._seen,
            self._vertices,
            self._motions,
            self._noises,
            *hypothesis,
            self._stretch.noise_factor**2,
            *every,
            kept.x,
            kept.covariance,
            kept.sums,
        )
        if failed == stretch_filter.FAILED:
            raise np.linalg.LinAlgError("the covariance of an innovation is not positive definite")
        if failed == stretch_filter.TOO_MUCH:
            state.sums[stretch_filter.COST] = np.inf
        elif is_kept:
            self._tight = kept
        return state


def _noises(edges: Sequence[Edge]) -> list[tuple[Array, float]]:
    """Return the covariance (m, m) of the noise of each edge, and the logarithm of the determinant of its root."""
    out: dict[int, tuple[Array, float]] = {}
    for size in {len(one.sqrt_information) for one in edges}:
        of_size = [k for k, one in enumerate(edges) if len(one.sqrt_information) == size]
        roots = np.stack([edges[k].sqrt_information for k in of_size])
        covariances, logarithms = np.linalg.inv(roots.swapaxes(1, 2) @ roots), np.linalg.slogdet(roots)[1]
        out |= zip(of_size, zip(covariances, logarithms.tolist(), strict=True), strict=True)
    return [out[k] for k in range(len(edges))]
