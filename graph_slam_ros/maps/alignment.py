"""Alignment of two maps by the points that both have. It is robust, because some points may have moved."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import so3
from graph_slam_ros.slam import MapView
from graph_slam_ros.slam.landmarks.rotations import aligned, pose_of
from graph_slam_ros.typing import Array, Mask, Numbers

_MOST_TRIALS = 2000  # minimal sets of points that are tried
_ROUNDS = 20
_ROUNDING_M = 1e-4  # nobody knows where anything is to less
_SPREAD = 3.0  # standard deviations of a point, so far the points must spread to tell how a map is turned


@dataclass(frozen=True, slots=True)
class Alignment:
    """The alignment of map b with map a, and the remaining differences of their points.

    Attributes
    ----------
    apart : a less b, in the axes of a (k, n)
    covariance : of each of these (k, n, n), of both maps and of the alignment
    chi2, limit : of each by that (k,), and what it may be
    fits : which agree with one another (k,)
    """

    T_a_b: Numbers
    apart: Array
    covariance: Array
    chi2: Array
    limit: float
    fits: Mask

    def distance(self, k: int) -> tuple[float, float]:
        """Return the distance by which a point has moved, in metres and in standard deviations in that direction."""
        metres = float(np.linalg.norm(self.apart[k]))
        if metres < _ROUNDING_M:
            return metres, 0.0
        way = self.apart[k] / metres
        return metres, metres / math.sqrt(float(way @ self.covariance[k] @ way) + _ROUNDING_M**2)


def positions(view: MapView, names: Sequence[str]) -> tuple[Array, Array]:
    """Positions of landmarks (k, n), and their joint covariance (k n, k n), in the axes of map."""
    space, n = view.space, view.space.dimensions
    vertices = [view.landmarks[name].vertex for name in names]
    values = [tuple(view.solver.estimate([vertex])[0].tolist()) for vertex in vertices]
    if not names:
        return np.empty((0, n)), np.empty((0, 0))
    joint, at = view.solver.joint_marginal(vertices), 0
    axes = np.zeros((len(names) * n, len(joint)))
    for k, (vertex, value) in enumerate(zip(vertices, values, strict=True)):
        dof = view.graph.kind_of(vertex).dof
        axes[k * n : (k + 1) * n, at : at + n] = space.turn(value) if dof == space.dof else np.eye(n)
        at += dof
    return np.array([value[:n] for value in values]), axes @ joint @ axes.T


def align(
    space: Geometry, a: tuple[Array, Array], b: tuple[Array, Array], gate: float, factor: float
) -> Alignment | None:
    """Align points of b with the same points of a; None if too few agree: two are needed in the plane, three in space.

    Parameters
    ----------
    a, b : positions and covariances as ``positions`` has them
    gate : part of all points that have not moved that is to fit
    factor : so many times worse than told noise may be
    """
    n, count = space.dimensions, len(a[0])
    if count < n:
        return None
    limit = factor**2 * quantile(gate, n)
    fits = _first(a, b, limit)
    for _ in range(_ROUNDS):
        if not _is_determined(a, b, fits):
            return None
        turn, shift = aligned(b[0][fits], a[0][fits])
        apart = a[0] - b[0] @ turn.T - shift
        covariance = _covariance(a, b, turn, fits)
        chi2 = np.einsum("ki,kij,kj->k", apart, np.linalg.inv(covariance), apart)
        before, fits = fits, chi2 <= limit
        if (fits == before).all():
            break
    return Alignment(pose_of(space, turn, shift), apart, covariance, chi2, limit, fits)


def as_they_are(space: Geometry, a: tuple[Array, Array], b: tuple[Array, Array], T_a_b: Numbers) -> Alignment:
    """Differences without an alignment by points, where the transform is known otherwise."""
    count, n = a[0].shape
    moved = np.stack(space.group.act(T_a_b, tuple(b[0].T)), axis=-1).reshape(count, n)
    turn, variances = space.turn(T_a_b), [np.einsum("kikj->kij", c.reshape(count, n, count, n)) for _, c in (a, b)]
    covariance = variances[0] + turn @ variances[1] @ turn.T
    unknown, none = np.full(count, np.nan), np.zeros(count, dtype=bool)
    return Alignment(T_a_b, a[0] - moved, covariance, unknown, math.nan, none)


def laid_on(space: Geometry, a: Array, b: Array) -> Numbers | None:
    """Return the pose of map b in map a by points that have not moved; None if they are too few, or on a line."""
    spread = np.linalg.svd(b - b.mean(axis=0), compute_uv=False) if len(b) else np.empty(0)
    n = space.dimensions
    if len(spread) < n - 1 or len(b) < n or spread[n - 2] < 1e-6 * len(b):
        return None
    return pose_of(space, *aligned(b, a))


def _variances(*maps: tuple[Array, Array]) -> Array:
    """The variance of each point along an axis, in all maps together (k,)."""
    return sum(np.diagonal(c).reshape(p.shape).mean(axis=1) for p, c in maps) + _ROUNDING_M**2


def _first(a: tuple[Array, Array], b: tuple[Array, Array], limit: float) -> Mask:
    """The points that agree best with a minimal sample: all samples, or random ones if there are many."""
    count, n = a[0].shape
    if math.comb(count, n) <= _MOST_TRIALS:
        sets = np.array(list(combinations(range(count), n)))
    else:
        sets = np.random.default_rng(0).random((_MOST_TRIALS, count)).argpartition(n, axis=1)[:, :n]
    turns, shifts = aligned(b[0][sets], a[0][sets])
    apart = a[0] - np.einsum("tij,kj->tki", turns, b[0]) - shifts[:, None]
    chi2 = np.einsum("tki,tki->tk", apart, apart) / _variances(a, b)
    best = int(np.minimum(chi2, limit).sum(axis=1).argmin())
    fits: Mask = chi2[best] <= limit
    return fits


def _is_determined(a: tuple[Array, Array], b: tuple[Array, Array], fits: Mask) -> bool:
    """Return whether points determine a motion: enough of them, not in one place, in space not on a line."""
    count, n = int(fits.sum()), a[0].shape[1]
    if count < n:
        return False
    spread = np.linalg.svd(b[0][fits] - b[0][fits].mean(axis=0), compute_uv=False)[n - 2] / math.sqrt(count)
    return bool(spread > _SPREAD * math.sqrt(float(np.median(_variances(a, b)[fits]))))


def _covariance(a: tuple[Array, Array], b: tuple[Array, Array], turn: Array, fits: Mask) -> Array:
    """The covariance (k, n, n) of each difference after the alignment of the points that fit."""
    count, n = a[0].shape
    axes = np.kron(np.eye(count), turn)
    total = a[1] + axes @ b[1] @ axes.T
    j, used = _derivative(b[0] @ turn.T), np.repeat(fits, n)
    left = np.eye(count * n)
    left[:, used] -= j @ np.linalg.pinv(j[used])
    blocks = (left @ total @ left.T).reshape(count, n, count, n)
    out: Array = np.einsum("kikj->kij", blocks) + _ROUNDING_M**2 * np.eye(n)
    return out


def _derivative(points: Array) -> Array:
    """The derivative (k n, dof) of points that are moved and turned."""
    count, n = points.shape
    about = [(0.0, 0.0, 1.0)] if n == 2 else [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
    turned = [(points @ so3.hat(axis)[:n, :n].T).reshape(-1, 1) for axis in about]
    return np.hstack([np.tile(np.eye(n), (count, 1)), *turned])
