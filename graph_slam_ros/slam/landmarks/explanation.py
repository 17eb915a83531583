"""The explanation of all scans of a drive at once: poses, landmarks and odometry's two scales, and its cost.

The method is Gauss-Newton with Levenberg's damping. Odometry is tight or has slipped, whichever costs less. Clusters
have Cauchy's loss. The first stage has no slip and a wide loss, because a local minimum looks like a wrong association.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from graph_slam_ros.slam.landmarks.beam import LOG_SIZES, SIZE_CHI2, BeamSettings
from graph_slam_ros.slam.landmarks.rotations import lever, rotation, rotation_vector
from graph_slam_ros.slam.landmarks.scans import Motion, Scan
from graph_slam_ros.typing import Array

UNUSED = -1
Ids = NDArray[np.int64]

_LEAST_SLIP = 0.25  # of a slip, of how long it takes
_HELD = 1e8  # information on the first pose
_WEAK_PRIOR = 1e-6  # on a landmark
_NEVER = 1e9  # the cost of a slip where none may be
_DAMPED_AT_MOST = 1e6
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
    which : (M,) the landmark of each cluster, or ``UNUSED``
    cost : without that of the landmarks
    """

    position: Array
    turn: Array
    landmarks: Array
    scales: Array
    which: Ids
    cost: float = np.inf


class Drive:
    """Scans as arrays, and their least squares.

    Attributes
    ----------
    stamps_s : (N,)
    scan : (M,) the scan of each cluster
    points : (M, n) clusters, from their scans
    whiten : (M, n, n)
    work : rows of odometry and clusters that were linearised by now
    """

    def __init__(self, scans: Sequence[Scan], motions: Sequence[Motion], settings: BeamSettings, costs: Costs) -> None:
        self.settings = settings
        self.stamps_s = np.array([one.at.stamp_ns for one in scans]) * 1e-9
        self.scan = np.array([k for k, one in enumerate(scans) for _ in one.clusters], dtype=np.int64)
        self.points = np.array([c.point for one in scans for c in one.clusters])
        self.n = self.points.shape[1]
        self.sort = np.array([c.sort for one in scans for c in one.clusters])
        self._size = np.array([c.size for one in scans for c in one.clusters])
        self._has_sizes = settings.size_sigma_m > 0.0 and bool(self._size.any())
        self.costs = replace(costs, landmark=costs.landmark + 2.0 * LOG_SIZES) if self._has_sizes else costs
        self.whiten = _whitening(np.array([c.covariance for one in scans for c in one.clusters]))
        self._set_motions(motions)
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

    # -- what it costs -----------------------------------------------------------------------------------------------

    def along_odometry(self, position: Array, turn: Array, scales: Array) -> tuple[Array, Array]:
        """Positions and rotations of the scans by odometry alone, from the first."""
        positions, turns = [position], [turn]
        ways = (rotation(0.5 * self.turned * scales[1]) @ self.way[..., None])[..., 0] * (1.0 + scales[0])
        for way, turned in zip(ways, rotation(self.turned * (1.0 + scales[1])), strict=True):
            positions.append(positions[-1] + turns[-1] @ way)
            turns.append(turns[-1] @ turned)
        return np.array(positions), np.array(turns)

    def seen_at(self, e: Estimate, clusters: Ids | slice = slice(None)) -> Array:
        """Positions of clusters in map (m, n)."""
        k = self.scan[clusters]
        return e.position[k] + (e.turn[k] @ self.points[clusters][..., None])[..., 0]

    def chi2_with(self, e: Estimate, clusters: Ids | slice = slice(None)) -> Array:
        """chi2 (m, J) of clusters with every landmark."""
        k = self.scan[clusters]
        whiten = self.whiten[clusters] @ e.turn[k].transpose(0, 2, 1)
        away = self.seen_at(e, clusters)[:, None] - e.landmarks[None]
        chi2 = np.square(away @ whiten.transpose(0, 2, 1)).sum(axis=-1)
        return np.asarray(chi2 + self.size_chi2(e, clusters))

    def size_chi2(self, e: Estimate, clusters: Ids | slice = slice(None)) -> Array:
        """chi2 (m, J) of the sizes of clusters with the mean size of every landmark; zero where one is not known."""
        size, count = self._size[clusters], len(e.landmarks)
        if not self._has_sizes:
            return np.zeros((len(size), count))
        known = (e.which >= 0) & (self._size > 0.0)
        times = np.bincount(e.which[known], minlength=count)
        mean = np.bincount(e.which[known], self._size[known], minlength=count) / np.maximum(times, 1)
        away = np.where((size[:, None] > 0.0) & (times > 0), size[:, None] - mean, 0.0)
        return np.minimum(np.square(away / self.settings.size_sigma_m), SIZE_CHI2)

    def cost_of(self, e: Estimate, *, loss_scale: float = 0.0, slips: bool = True) -> float:
        """The cost of an estimate."""
        residual = self._odometry(e)[0]
        tight, slipped = self._both(residual, slips=slips)
        used = e.which >= 0
        chi2 = np.square((self.whiten[used] @ self._residuals(e, used)[0][..., None])[..., 0]).sum(axis=1)
        square = (loss_scale or self.costs.loss_scale) ** 2
        scales = float(np.square(e.scales).sum()) / self.settings.scale_sigma**2
        if self._has_sizes:
            scales += float(self.size_chi2(e)[np.flatnonzero(used), e.which[used]].sum())
        clusters = square * np.log1p(chi2 / square).sum() + self.costs.unused * np.count_nonzero(~used)
        return float(np.minimum(tight, slipped).sum() + clusters) + scales

    def total(self, e: Estimate) -> float:
        """The cost of an estimate with its landmarks."""
        return e.cost + self.costs.landmark * len(e.landmarks)

    def _both(self, residual: Array, *, slips: bool) -> tuple[Array, Array]:
        tight = np.square((self._tight @ residual[..., None])[..., 0]).sum(axis=1)
        if not slips:
            return tight, tight + _NEVER
        return tight, np.square((self._slipped @ residual[..., None])[..., 0]).sum(axis=1) + self.slip_cost

    def _odometry(self, e: Estimate) -> tuple[Array, Array, Array]:
        """Residuals (N - 1, dof) of odometry; the motion of the estimate, and of odometry without its scale."""
        a = e.turn[:-1]
        moved = (a.transpose(0, 2, 1) @ (e.position[1:] - e.position[:-1])[..., None])[..., 0]
        local = (rotation(0.5 * self.turned * e.scales[1]) @ self.way[..., None])[..., 0]
        back = rotation(-self.turned * (1.0 + e.scales[1]))
        turned = rotation_vector(back @ a.transpose(0, 2, 1) @ e.turn[1:])
        return np.concatenate([moved - (1.0 + e.scales[0]) * local, turned], axis=1), moved, local

    def _residuals(self, e: Estimate, used: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Residuals of the clusters that are used, and the positions of their landmarks relative to the scans."""
        k = self.scan[used]
        away = e.landmarks[e.which[used]] - e.position[k]
        seen = (e.turn[k].transpose(0, 2, 1) @ away[..., None])[..., 0]
        return seen - self.points[used], seen

    # -- least squares -----------------------------------------------------------------------------------------------

    def solve(
        self, e: Estimate, iterations: int = 15, *, enough: float = 1e-3, loss_scale: float = 0.0, slips: bool = True
    ) -> Estimate:
        """The estimate at the nearest local minimum of the cost."""
        damping = 1e-6
        e = replace(e, cost=self.cost_of(e, loss_scale=loss_scale, slips=slips))
        for _ in range(iterations):
            h, b, floor = self._normal(e, loss_scale or self.costs.loss_scale, slips=slips)
            diagonal = 1.0 + h.diagonal()
            while True:
                step = splu((h + sparse.diags(floor + damping * diagonal)).tocsc(), "MMD_AT_PLUS_A").solve(b)
                tried = self._moved(e, step)
                cost = self.cost_of(tried, loss_scale=loss_scale, slips=slips)
                if cost <= e.cost + 1e-9 or damping > _DAMPED_AT_MOST:
                    break
                damping = max(damping, 1e-6) * 10.0
            if not cost <= e.cost:
                break
            gain, e, damping = e.cost - cost, replace(tried, cost=cost), damping / 5.0
            if gain < enough * max(1.0, 1e-4 * cost):
                break
        return e

    def staged(self, e: Estimate) -> Estimate:
        """Solve in stages: first without slip and with a wide loss, then with a narrower one."""
        e = replace(e, landmarks=self.landmarks_of(e))
        e = self.solve(e, 25, enough=0.1, loss_scale=30.0, slips=False)
        e = self.solve(e, 15, enough=0.1, loss_scale=10.0)
        return self.solve(e, 40)

    def landmarks_of(self, e: Estimate) -> Array:
        """The median of the observed positions of each landmark."""
        seen = self.seen_at(e)
        return np.array([np.median(seen[e.which == j], axis=0) for j in range(int(e.which.max(initial=-1)) + 1)])

    def _moved(self, e: Estimate, step: Array) -> Estimate:
        n, size = self.n, self.size
        dof = self._dof
        poses, landmarks = step[: dof * size].reshape(size, dof), step[dof * size : -2].reshape(-1, n)
        turn = e.turn @ rotation(poses[:, n:])
        return replace(
            e,
            position=e.position + poses[:, :n],
            turn=turn,
            landmarks=e.landmarks + landmarks,
            scales=e.scales + step[-2:],
        )

    @cached_property
    def _dof(self) -> int:
        return self.n + self.turned.shape[1]

    def _normal(self, e: Estimate, loss_scale: float, *, slips: bool) -> tuple[sparse.csc_matrix, Array, Array]:
        """Gauss-Newton matrix, right-hand side, and the damping of the diagonal."""
        n, dof, size = self.n, self._dof, self.size
        self.work += size + len(self.scan)
        total = dof * size + n * len(e.landmarks) + 2
        blocks = [self._odometry_rows(e, total, slips=slips), self._cluster_rows(e, loss_scale)]
        rows, columns, values, b = [], [], [], np.zeros(total)
        for j, r, at in blocks:
            transposed = j.transpose(0, 2, 1)
            width = at.shape[1]
            rows.append(np.repeat(at, width, axis=1).ravel())
            columns.append(np.tile(at, (1, width)).ravel())
            values.append((transposed @ j).ravel())
            b -= np.bincount(at.ravel(), (transposed @ r[..., None]).ravel(), minlength=total)
        h = sparse.coo_matrix(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (total, total)
        ).tocsc()
        floor = np.zeros(total)
        floor[:dof], floor[dof * size :], floor[-2:] = _HELD, _WEAK_PRIOR, 1.0 / self.settings.scale_sigma**2
        b[-2:] -= e.scales * floor[-2:]
        return h, b, floor

    def _odometry_rows(self, e: Estimate, total: int, *, slips: bool) -> tuple[Array, Array, Ids]:
        n, dof, size = self.n, self._dof, self.size
        r, moved, local = self._odometry(e)
        tight, slipped = self._both(r, slips=slips)
        whiten = np.where((slipped < tight)[:, None, None], self._slipped, self._tight)
        back = e.turn[:-1].transpose(0, 2, 1)
        j = np.zeros((size - 1, dof, 2 * dof + 2))
        j[:, :n, :n], j[:, :n, n:dof], j[:, :n, dof : dof + n] = -back, -lever(moved), back
        j[:, n:, n:dof] = -e.turn[1:].transpose(0, 2, 1) @ e.turn[:-1] if n == 3 else -1.0
        j[:, n:, dof + n : 2 * dof] = np.eye(dof - n)
        j[:, :n, -2] = -local
        j[:, :n, -1] = -0.5 * (1.0 + e.scales[0]) * (lever(local) @ self.turned[..., None])[..., 0]
        j[:, n:, -1] = -self.turned
        at = dof * np.arange(size - 1)[:, None] + np.arange(2 * dof)
        scales = np.broadcast_to([total - 2, total - 1], (size - 1, 2))
        return whiten @ j, (whiten @ r[..., None])[..., 0], np.concatenate([at, scales], axis=1)

    def _cluster_rows(self, e: Estimate, loss_scale: float) -> tuple[Array, Array, Ids]:
        n, dof, size = self.n, self._dof, self.size
        used = e.which >= 0
        r, seen = self._residuals(e, used)
        k, whiten = self.scan[used], self.whiten[used]
        back = e.turn[k].transpose(0, 2, 1)
        j = np.concatenate([-back, -lever(seen), back], axis=2)
        j, r = whiten @ j, (whiten @ r[..., None])[..., 0]
        weight = 1.0 / np.sqrt(1.0 + np.square(r).sum(axis=1) / loss_scale**2)
        of_pose = dof * k[:, None] + np.arange(dof)
        of_landmark = dof * size + n * e.which[used][:, None] + np.arange(n)
        return weight[:, None, None] * j, weight[:, None] * r, np.concatenate([of_pose, of_landmark], axis=1)


def _whitening(covariances: Array) -> Array:
    """``W`` (k, n, n) with ``W' W`` the inverse of each."""
    return np.linalg.cholesky(np.linalg.inv(covariances)).transpose(0, 2, 1)


def compressed(e: Estimate) -> Estimate:
    """The estimate without landmarks that have no cluster."""
    used = np.unique(e.which[e.which >= 0])
    index = np.full(len(e.landmarks) + 1, UNUSED)
    index[used] = np.arange(len(used))
    return replace(e, which=index[e.which], landmarks=e.landmarks[used])
