"""The explanation of all scans of a drive at once: poses, landmarks, odometry's two scales, clocks, and its cost.

The method is Gauss-Newton with Levenberg's damping. Odometry is tight or has slipped, whichever costs less. Clusters
have Cauchy's loss. The first stage has no slip and a wide loss, because a local minimum looks like a wrong association.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.slam.association.beam import BeamSettings
from graph_slam_ros.slam.association.bordered import BorderedEquations, Rows
from graph_slam_ros.slam.association.scans import Motion, Scan, interpolated_nearby
from graph_slam_ros.slam.landmarks.rotations import applied, lever, product, rotation, rotation_vector
from graph_slam_ros.typing import Array, Mask

UNUSED = -1
SCALES = ("distance", "turn")
"""Names of odometry's scales, as calibration has them."""
Ids = NDArray[np.int64]

_LEAST_SLIP = 0.25  # of a slip, of how long it takes
_HELD = 1e8  # information on the first pose
_WEAK_PRIOR = 1e-6  # on a landmark
_NEVER = 1e9  # the cost of a slip where none may be
_DAMPED_AT_MOST = 1e6  # with more, a step moves nothing
_MOST_WORK = 5_000_000  # rows that are linearised for moves: half a minute, ten times what 15 minutes of driving need


@dataclass(frozen=True, slots=True)
class Costs:
    """Costs, as chi2.

    Attributes
    ----------
    landmark : each
    unused : each cluster that is of none
    ambiguous : by less than that two explanations are both possible
    loss_scale : of Cauchy's loss
    """

    landmark: float
    unused: float
    ambiguous: float
    loss_scale: float = 3.0


@dataclass(frozen=True, slots=True)
class Estimate:
    """An explanation.

    Attributes
    ----------
    position, turn : (N, n), (N, n, n) of the scans
    landmarks : (J, n)
    scales : (2,) by which ways and turns are longer than odometry says
    clocks : (T,) [s] to add to the stamps of each input
    which : (M,) the landmark of each cluster, or ``UNUSED``
    cost : without that of the landmarks
    volume : log determinant of the information of all unknowns, less what its dimension adds (Laplace)
    """

    position: Array
    turn: Array
    landmarks: Array
    scales: Array
    clocks: Array
    which: Ids
    cost: float = np.inf
    volume: float = 0.0


class Drive:
    """Scans as arrays, and their least squares.

    Attributes
    ----------
    stamps_s : (N,)
    scan : (M,) the scan of each cluster
    points : (M, n) clusters, from their scans
    topics : (T,) inputs
    whiten : (M, n, n)
    times : (M,) how often the robot has seen what a cluster stands for
    work : rows of odometry and clusters that were linearised by now
    """

    def __init__(
        self,
        scans: Sequence[Scan],
        motions: Sequence[Motion],
        nearby: Array,
        settings: BeamSettings,
        costs: Costs,
        times: Array | None = None,
    ) -> None:
        self.settings = settings
        self.stamps_s = np.array([one.at.stamp_ns for one in scans]) * 1e-9
        self.scan = np.array([k for k, one in enumerate(scans) for _ in one.clusters], dtype=np.int64)
        self.points = np.array([c.point for one in scans for c in one.clusters])
        self.n = self.points.shape[1]
        self.times = np.ones(len(self.points)) if times is None or not len(times) else times
        self.sort = np.array([c.sort for one in scans for c in one.clusters])
        self.costs = costs
        self.whiten = _whitening(np.array([c.covariance for one in scans for c in one.clusters]))
        self._set_motions(motions)
        self._set_inputs(scans, nearby)
        self.work = self._free = 0

    @property
    def size(self) -> int:
        """The number of scans."""
        return len(self.stamps_s)

    @property
    def may_move(self) -> bool:
        """Return whether the work limit allows further moves, each of which is solved completely."""
        return self.work - self._free < _MOST_WORK

    def begin_moves(self) -> None:
        """Start to count the work of moves."""
        self._free = self.work

    def _set_motions(self, motions: Sequence[Motion]) -> None:
        n, r, c = self.n, 1 if self.n == 2 else 3, self.settings
        count = len(motions)
        self.way = np.array([m.way for m in motions]).reshape(count, n)
        self.turned = np.array([m.turn for m in motions]).reshape(count, r)
        tight = np.array([m.covariance for m in motions]).reshape(count, n + r, n + r)
        part = np.array([max(m.moving_s / c.slip_every_s, _LEAST_SLIP) for m in motions])
        slipped = tight + part[:, None, None] * np.diag(np.square([c.slip_sigma_m] * n + [c.slip_sigma_rad] * r))
        self._tight, self._slipped = _whitening(tight), _whitening(slipped)
        volumes = np.linalg.slogdet(slipped)[1] - np.linalg.slogdet(tight)[1]
        self.slip_cost = volumes - 2.0 * c.slip_log_prior

    def _set_inputs(self, scans: Sequence[Scan], nearby: Array) -> None:
        """Note of which input each cluster is, and how the robot moved around each scan."""
        of = [[seen.topic for seen in c.seen] for one in scans for c in one.clusters]
        self.topics = tuple(sorted({topic for names in of for topic in names}))
        parts = [[names.count(topic) / max(len(names), 1) for topic in self.topics] for names in of]
        self._part = np.array(parts).reshape(len(of), len(self.topics))
        self._nearby = nearby

    # -- what it costs -----------------------------------------------------------------------------------------------

    def seen_at(self, e: Estimate, clusters: Ids | slice = slice(None)) -> Array:
        """Positions of clusters in map (m, n)."""
        k = self.scan[clusters]
        return e.position[k] + applied(e.turn[k], self.points_at(e, clusters)[0])

    def points_at(self, e: Estimate, clusters: Ids | Mask | slice = slice(None)) -> tuple[Array, Array]:
        """Clusters (m, n), from where the robot was at their scan's stamp, and what a second of clock moves them by.

        A clock says that they were seen from another point on the way, which odometry has.
        """
        points = self.points[clusters]
        after_s = self._part[clusters] @ e.clocks
        moved, rate = interpolated_nearby(self._nearby[self.scan[clusters]], after_s)
        turned = applied(rotation(moved[:, self.n :]), points)
        swung = applied(lever(turned), rate[:, self.n :])
        return turned + moved[:, : self.n], swung + rate[:, : self.n]

    def chi2_with(self, e: Estimate, clusters: Ids | slice = slice(None)) -> Array:
        """chi2 (m, J) of clusters with every landmark."""
        k = self.scan[clusters]
        whiten = product(self.whiten[clusters], e.turn[k].transpose(0, 2, 1))
        away = self.seen_at(e, clusters)[:, None] - e.landmarks[None]
        chi2 = np.square(away @ whiten.transpose(0, 2, 1)).sum(axis=-1)
        return np.asarray(chi2)

    def cost_of(self, e: Estimate, *, loss_scale: float = 0.0, slips: bool = True) -> float:
        """The cost of an estimate."""
        residual = self._odometry(e)[0]
        tight, slipped = self._both(residual, slips=slips)
        used = e.which >= 0
        chi2 = np.square(applied(self.whiten[used], self._residuals(e, used)[0])).sum(axis=1)
        square = (loss_scale or self.costs.loss_scale) ** 2
        scales = float(np.square(e.scales).sum()) / self.settings.scale_sigma**2
        scales += float(np.square(e.clocks).sum()) / self.settings.clock_sigma_s**2
        clusters = square * np.log1p(chi2 / square).sum() + self.costs.unused * np.count_nonzero(~used)
        return float(np.minimum(tight, slipped).sum() + clusters) + scales

    def total(self, e: Estimate) -> float:
        """Minus twice the log evidence of an estimate, up to a constant: its cost, its landmarks, and its volume.

        The evidence is Laplace's. A landmark must be worth more than its prior: what it fits it could also have fitted
        at many other places.
        """
        return e.cost + self.costs.landmark * len(e.landmarks) + e.volume

    def _both(self, residual: Array, *, slips: bool) -> tuple[Array, Array]:
        tight = np.square(applied(self._tight, residual)).sum(axis=1)
        if not slips:
            return tight, tight + _NEVER
        return tight, np.square(applied(self._slipped, residual)).sum(axis=1) + self.slip_cost

    def _odometry(self, e: Estimate) -> tuple[Array, Array, Array]:
        """Residuals (N - 1, dof) of odometry; the motion of the estimate, and of odometry without its scale."""
        a = e.turn[:-1]
        moved = applied(a.transpose(0, 2, 1), e.position[1:] - e.position[:-1])
        local = applied(rotation(0.5 * self.turned * e.scales[1]), self.way)
        back = rotation(-self.turned * (1.0 + e.scales[1]))
        turned = rotation_vector(product(product(back, a.transpose(0, 2, 1)), e.turn[1:]))
        return np.concatenate([moved - (1.0 + e.scales[0]) * local, turned], axis=1), moved, local

    def _residuals(self, e: Estimate, used: Mask) -> tuple[Array, Array, Array]:
        """Residuals of used clusters, their landmarks' positions relative to the scans, and the rate by the clock."""
        k = self.scan[used]
        away = e.landmarks[e.which[used]] - e.position[k]
        seen = applied(e.turn[k].transpose(0, 2, 1), away)
        points, rate = self.points_at(e, used)
        return seen - points, seen, rate

    # -- least squares -----------------------------------------------------------------------------------------------

    def solve(
        self, e: Estimate, iterations: int = 15, *, enough: float = 1e-3, loss_scale: float = 0.0, slips: bool = True
    ) -> Estimate:
        """The estimate at the nearest local minimum of the cost."""
        damping = 1e-6
        e = replace(e, cost=self.cost_of(e, loss_scale=loss_scale, slips=slips))
        for _ in range(iterations):
            normal, floor = self._normal(e, loss_scale or self.costs.loss_scale, slips=slips)
            diagonal = 1.0 + normal.diagonal
            while True:
                try:
                    step = normal.factor(floor + damping * diagonal).solve(normal.b)
                    tried = self._moved(e, step)
                    cost = self.cost_of(tried, loss_scale=loss_scale, slips=slips)
                except np.linalg.LinAlgError:  # rounding: more damping mends it
                    cost = np.inf
                if cost <= e.cost + 1e-9 or damping > _DAMPED_AT_MOST:
                    break
                damping = max(damping, 1e-6) * 10.0
            if not cost <= e.cost:
                break
            gain, e, damping = e.cost - cost, replace(tried, cost=cost), damping / 5.0
            if gain < enough * max(1.0, 1e-4 * cost):
                break
        return replace(e, volume=self._volume(e, loss_scale, slips=slips))

    def landmark_covariances(self, e: Estimate, landmarks: Ids) -> Array | None:
        """The covariance (k, k, n, n) of some landmarks jointly, in blocks; None if rounding leaves none."""
        k, n = len(landmarks), self.n
        covariance = self._border_covariance(e, (n * landmarks[:, None] + np.arange(n)).ravel())
        return None if covariance is None else covariance.reshape(k, n, k, n).transpose(0, 2, 1, 3)

    def _border_covariance(self, e: Estimate, some: Ids) -> Array | None:
        normal, floor = self._normal(e, self.costs.loss_scale, slips=True)
        try:
            return normal.factor(floor).border_covariance(some)
        except np.linalg.LinAlgError:
            return None

    def named(self, e: Estimate) -> dict[str, tuple[float, float]]:
        """Odometry's scales, ``distance`` and ``turn``, and the clock of each input [s], with standard deviations."""
        names, values = (*SCALES, *self.topics), [*e.scales.tolist(), *e.clocks.tolist()]
        covariance = self._border_covariance(e, self.n * len(e.landmarks) + np.arange(len(values)))
        if covariance is None:
            return {}
        sigmas = np.sqrt(covariance.diagonal()).tolist()
        return dict(zip(names, zip(values, sigmas, strict=True), strict=True))

    def _volume(self, e: Estimate, loss_scale: float, *, slips: bool) -> float:
        normal, floor = self._normal(e, loss_scale or self.costs.loss_scale, slips=slips)
        try:
            return normal.factor(floor).log_determinant - self.n * len(e.landmarks) * float(np.log(2.0 * np.pi))
        except np.linalg.LinAlgError:
            return np.inf  # not to be preferred

    def staged(self, e: Estimate) -> Estimate:
        """Solve in stages: first without slip and with a wide loss, then with a narrower one."""
        e = replace(e, landmarks=self.landmarks_of(e))
        e = self.solve(e, 25, enough=0.1, loss_scale=30.0, slips=False)
        e = self.solve(e, 15, enough=0.1, loss_scale=10.0)
        return self.solve(e, 40)

    def counts(self, e: Estimate, which: Mask | slice = slice(None)) -> Array:
        """Return the times that each landmark was seen (J,), in some of the clusters."""
        of, times = e.which[which], self.times[which]
        return np.bincount(of[of >= 0], times[of >= 0], minlength=len(e.landmarks)).astype(np.float64)

    def landmarks_of(self, e: Estimate) -> Array:
        """The median of the observed positions of each landmark."""
        seen = self.seen_at(e)
        return np.array([np.median(seen[e.which == j], axis=0) for j in range(int(e.which.max(initial=-1)) + 1)])

    def _moved(self, e: Estimate, step: Array) -> Estimate:
        n, size = self.n, self.size
        dof = self._dof
        end = dof * size + n * len(e.landmarks)
        poses, landmarks = step[: dof * size].reshape(size, dof), step[dof * size : end].reshape(-1, n)
        turn = e.turn @ rotation(poses[:, n:])
        return replace(
            e,
            position=e.position + poses[:, :n],
            turn=turn,
            landmarks=e.landmarks + landmarks,
            scales=e.scales + step[end : end + 2],
            clocks=e.clocks + step[end + 2 :],
        )

    @cached_property
    def _dof(self) -> int:
        return self.n + self.turned.shape[1]

    def _normal(self, e: Estimate, loss_scale: float, *, slips: bool) -> tuple[BorderedEquations, Array]:
        """The normal equations, and the floor of their diagonal: priors. Scales and clocks are the last unknowns."""
        count, of_landmarks = self._dof * self.size, self.n * len(e.landmarks)
        self.work += self.size + len(self.scan)
        own = np.concatenate([e.scales, e.clocks])
        rows = [self._odometry_rows(e, of_landmarks, slips=slips), self._cluster_rows(e, of_landmarks + 2, loss_scale)]
        normal = BorderedEquations(rows, count, of_landmarks + len(own), 2 * self._dof)
        floor = np.zeros(count + of_landmarks + len(own))
        floor[: self._dof], floor[count : count + of_landmarks] = _HELD, _WEAK_PRIOR
        sigmas = [self.settings.scale_sigma] * 2 + [self.settings.clock_sigma_s] * len(e.clocks)
        floor[count + of_landmarks :] = np.square(sigmas) ** -1.0
        normal.b[count + of_landmarks :] -= own * floor[count + of_landmarks :]
        return normal, floor

    def _odometry_rows(self, e: Estimate, first: int, *, slips: bool) -> Rows:
        n, dof, size = self.n, self._dof, self.size
        r, moved, local = self._odometry(e)
        tight, slipped = self._both(r, slips=slips)
        whiten = np.where((slipped < tight)[:, None, None], self._slipped, self._tight)
        back = e.turn[:-1].transpose(0, 2, 1)
        j, by_scale = np.zeros((size - 1, dof, 2 * dof)), np.empty((size - 1, dof, 2))
        j[:, :n, :n], j[:, :n, n:dof], j[:, :n, dof : dof + n] = -back, -lever(moved), back
        j[:, n:, n:dof] = -e.turn[1:].transpose(0, 2, 1) @ e.turn[:-1] if n == 3 else -1.0
        j[:, n:, dof + n :] = np.eye(dof - n)
        by_scale[:, :n, 0], by_scale[:, n:, 0], by_scale[:, n:, 1] = -local, 0.0, -self.turned
        by_scale[:, :n, 1] = -0.5 * (1.0 + e.scales[0]) * applied(lever(local), self.turned)
        at, border = dof * np.arange(size - 1), np.tile([first, first + 1], (size - 1, 1))
        return Rows(product(whiten, j), product(whiten, by_scale), applied(whiten, r), at, border)

    def _cluster_rows(self, e: Estimate, first_clock: int, loss_scale: float) -> Rows:
        n, dof = self.n, self._dof
        used = e.which >= 0
        r, seen, rate = self._residuals(e, used)
        k, whiten = self.scan[used], self.whiten[used]
        back = e.turn[k].transpose(0, 2, 1)
        by_clock = -rate[..., None] * self._part[used][:, None]
        j = product(whiten, np.concatenate([-back, -lever(seen)], axis=2))
        by_border, r = product(whiten, np.concatenate([back, by_clock], axis=2)), applied(whiten, r)
        weight = 1.0 / np.sqrt(1.0 + np.square(r).sum(axis=1) / loss_scale**2)
        clocks = np.tile(first_clock + np.arange(len(e.clocks)), (len(k), 1))
        border = np.concatenate([n * e.which[used][:, None] + np.arange(n), clocks], axis=1)
        j, by_border = weight[:, None, None] * j, weight[:, None, None] * by_border
        return Rows(j, by_border, weight[:, None] * r, dof * k, border)


def _whitening(covariances: Array) -> Array:
    """``W`` (k, n, n) with ``W' W`` the inverse of each."""
    return np.linalg.cholesky(np.linalg.inv(covariances)).transpose(0, 2, 1)


def compressed(e: Estimate) -> Estimate:
    """The estimate without landmarks that have no cluster."""
    used = np.unique(e.which[e.which >= 0])
    index = np.full(len(e.landmarks) + 1, UNUSED)
    index[used] = np.arange(len(used))
    return replace(e, which=index[e.which], landmarks=e.landmarks[used])
