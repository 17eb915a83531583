"""Noise of odometry that grows with what was turned and driven, estimated from its residuals.

The variance of an edge is what is configured times a factor, plus a variance for each radian turned and each metre
driven: components of variance. They are estimated by expectation and maximisation (Dempster, Laird, Rubin, "Maximum
likelihood from incomplete data via the EM algorithm", 1977). The expected square of an error is that of its residual
plus the variance that all measurements together leave to it. The components are the regression of these squares, none
below zero.

Errors and motions are those of edges, or sums over windows of a few. One that says little of its own noise hardly moves
it, and rounds are few. That is wanted: errors of a sensor that are alike within a pass look like those of odometry.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from graph_slam_ros.slam.frontend.noise_factors import PER_M, PER_RAD, Key, configured_variance, motion_sizes
from graph_slam_ros.typing import Array, Index

CONFIGURED_COUNT = 50.0  # steps of odometry: its configured noise counts as that of so many
_ROUNDS = 4  # of the regression, each weighted by the variances of the last
_LARGEST_SQUARE = 9.0  # variances: an error that is larger counts as that
_LEAST, _MOST = 0.1, 3.0  # factor of the configured sigma
_MOST_VARIANCE = 9.0  # of what is configured, in the mean over all edges


@dataclass(frozen=True, slots=True)
class Growth:
    """The noise of a part of odometry.

    Attributes
    ----------
    factor : of the configured sigma
    per_rad, per_m : variance that is added for each radian turned and each metre driven
    """

    factor: float = 1.0
    per_rad: float = 0.0
    per_m: float = 0.0


def growth_of(factors: Mapping[Key, float], key: Key) -> Growth:
    """The noise that a part of odometry has now."""
    label, source, part = key
    added = (factors.get((label, source, part + per), 0.0) for per in (PER_RAD, PER_M))
    return Growth(factors.get(key, 1.0), *added)


@dataclass(frozen=True, slots=True)
class Motions:
    """Motions that odometry measured, or sums over windows of them, each (n,).

    Attributes
    ----------
    own : configured variance
    turned, way : radians turned and metres driven
    """

    own: Array
    turned: Array
    way: Array

    @classmethod
    def of(cls, measured: Array, variance: Array, now: Growth) -> "Motions":
        """Motions (n, 3) or (n, 7) whose variance (n,) is what it is with the present noise."""
        of_group = {"": now.factor, PER_RAD: now.per_rad, PER_M: now.per_m}
        return cls(configured_variance(variance, "", of_group, measured), *motion_sizes(measured))

    def at(self, rows: Index) -> "Motions":
        """Some of them."""
        return Motions(self.own[rows], self.turned[rows], self.way[rows])

    def summed(self, windows: Sequence[Index]) -> "Motions":
        """Sums over windows of motions, which follow one another."""
        columns = self.own, self.turned, self.way
        return Motions(*(np.array([column[rows].sum() for rows in windows]) for column in columns))

    def variance(self, noise: Growth) -> Array:
        """The variance of each."""
        return noise.factor**2 * self.own + noise.per_rad * self.turned + noise.per_m * self.way


def fit_growth(motions: Motions, square: Array, left: Array, now: Growth, count: float, *, is_rotation: bool) -> Growth:
    """One step of expectation and maximisation, drawn to what is configured.

    Parameters
    ----------
    square : (n,) square of each residual, or sum of residuals
    left : (n,) the variance that all measurements together leave to its error
    count : number of edges or windows, of which these are a sample; what is configured counts as
        ``CONFIGURED_COUNT`` of them
    is_rotation : turning adds to it; that of a position grows with the way alone
    """
    at, turned = motions.variance(now), motions.turned * is_rotation
    expected = np.minimum(square + left, _LARGEST_SQUARE * at)
    for _ in range(_ROUNDS):
        columns = np.stack([motions.own, turned, motions.way], axis=1) / at[:, None]
        size = np.linalg.norm(columns, axis=0)
        size[size == 0.0] = 1.0
        found = nnls(columns / size, expected / at)[0] / size
        now = _bounded(motions, Growth(float(np.sqrt(found[0])), float(found[1]), float(found[2])))
        at = motions.variance(now)
    part = count / (count + CONFIGURED_COUNT)
    return Growth(float(np.sqrt(part * now.factor**2 + 1.0 - part)), part * now.per_rad, part * now.per_m)


def _bounded(motions: Motions, noise: Growth) -> Growth:
    factor = float(np.clip(noise.factor, _LEAST, _MOST))
    added = float(np.sum(motions.variance(Growth(0.0, noise.per_rad, noise.per_m))))
    share = min(1.0, _MOST_VARIANCE * float(np.sum(motions.own)) / added) if added > 0.0 else 1.0
    return Growth(factor, share * noise.per_rad, share * noise.per_m)
