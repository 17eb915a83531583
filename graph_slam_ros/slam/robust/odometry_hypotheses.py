"""Hypotheses on a stretch of odometry, compared by the likelihood of what was seen along it.

Odometry has its own noise there (tight), its errors are larger from a keyframe on (slip), or the robot was moved at one
(carried). Under each the stretch is filtered anew (``odometry_filter``). This is the generalized likelihood ratio test
of Willsky and Jones ("A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems", 1976).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.robust.odometry_filter import Errors, OdometryFilter
from graph_slam_ros.typing import Array, Numbers

TIGHT, CARRIED = "tight", "carried"
SLIPS = ("translation", "rotation")
_LOG_ODDS_MOVED = float(np.log(1e-2))  # of a robot that was moved, relative to one that slipped
LOG_ODDS = float(np.log(1e-6))  # of a slip within a stretch of odometry, before anything is seen
_LEAST_FITTING = 0.6  # part of what was seen since then that a slip must explain


@dataclass(frozen=True, slots=True)
class Moved:
    """A place to which the robot may have been moved.

    Attributes
    ----------
    first : vertex of the first keyframe there
    pose_of : pose in map of such a keyframe, by its vertex
    """

    first: int
    pose_of: Callable[[int], Numbers]


@dataclass(frozen=True, slots=True)
class Choice:
    """The hypothesis of highest probability.

    Attributes
    ----------
    kind : ``tight``, ``translation`` or ``rotation`` (a slip), or ``carried``
    first : place of the first edge of odometry that it concerns
    log_ratio : logarithm of the likelihood ratio to ``tight``
    voters : landmarks, and other classes of edges, without which that is less
    is_sure : whether it is above 0 also without any one of them
    fitting : the part of what was seen since then that fits
    """

    kind: str
    first: int = 0
    log_ratio: float = 0.0
    voters: tuple[int | str, ...] = ()
    is_sure: bool = False
    fitting: float = 1.0

    @property
    def is_slip(self) -> bool:
        """Return whether at least two landmarks or classes say that odometry slipped, and that explains most of it."""
        return self.kind in SLIPS and self.is_sure and len(self.voters) >= 2 and self.fitting >= _LEAST_FITTING


class HypothesisTest:
    """Compares hypotheses on a stretch of odometry with the one that its noise is as stated."""

    def __init__(self, filtered: OdometryFilter, space: Geometry) -> None:
        self._filter, self._space = filtered, space
        self._none = np.zeros((filtered.size, space.dof))
        self._tight = Errors(self._none, self._none)
        self._best = (0.0, TIGHT, 0, self._tight)
        self._likelihood = filtered.log_likelihood(self._tight, filtered.size)

    def add_slip(self, kind: str, first: int, variances: Array, shared: Array) -> None:
        """Consider a slip from an edge on, with variances (n, dof) and shared sigmas (n, dof) of all edges."""
        is_part = (np.arange(len(variances)) >= first)[:, None]
        self._add(kind, first, Errors(variances * is_part, shared * is_part), LOG_ODDS)

    def add_moved(self, first: int, there: Numbers, sigma_m: float, sigma_rad: float) -> None:
        """Consider that the robot was moved across an edge."""
        variances = np.square(self._space.sigmas(sigma_m, sigma_rad))
        errors = Errors(self._none, self._none, first, there, variances)
        self._add(CARRIED, first, errors, LOG_ODDS + _LOG_ODDS_MOVED)

    def _add(self, kind: str, first: int, errors: Errors, log_odds: float) -> None:
        above = self._best[0] - log_odds + self._likelihood
        gain = self._filter.log_likelihood(errors, first, above=above) - self._likelihood + log_odds
        self._best = max(self._best, (gain, kind, first, errors), key=lambda one: one[0])

    def choice(self) -> Choice:
        """Return the best."""
        gain, kind, first, errors = self._best
        if kind not in SLIPS:
            return Choice(kind, first)
        ratio, voters, is_sure = gain - LOG_ODDS, list[int | str](), True
        for one in self._filter.seen_since(first):
            tight = self._filter.log_likelihood(self._tight, self._filter.size, one)
            without = self._filter.log_likelihood(errors, first, one) - tight
            is_sure &= without > 0.0
            if without < ratio:
                voters.append(one)
        return Choice(kind, first, ratio, tuple(voters), is_sure, self._filter.fitting(errors, first))
