"""Monitor of whether the newest sightings contradict odometry: a test on the sum of their innovations.

Each sighting has a normalised innovation squared (NIS). A window has the newest sightings, a few of each landmark,
since sightings of one landmark err together. The sum of NIS is compared with the chi-square quantile of its degrees of
freedom. Some sightings have wrong identities, however good odometry is. So the worst sightings are left out of the sum,
as many as the rate of such errors in this drive explains. Ranges and bearings are used, too.
"""

from collections import deque
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import bdtr, betaincinv

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.slam.robust.gating import OutlierGate
from graph_slam_ros.slam.robust.landmark_history import LandmarkHistory
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Index

_SURE = 1.0 - 1e-6  # probability with which clean measurements raise no alarm
_WINDOW, _LEAST = 20, 6  # sightings that are compared
_PER_LANDMARK = 4  # of them, at most
_REACH_S = 20.0
_RATE_SURE = 0.999  # the rate of wrong ones is at most what it may be with this probability, by what was seen
_CALM, _CALM_SURE = 12, 0.99  # newest sightings of which three quarters must agree for an alarm to end


@dataclass(frozen=True, slots=True)
class Contradiction:
    """The result of the monitor in its window.

    Attributes
    ----------
    held_back, count : sightings that are held back, and all
    landmarks : how many are held back of
    statistic, threshold : the sum of innovations but for the worst, and its quantile
    """

    held_back: int
    count: int
    landmarks: int
    statistic: float
    threshold: float

    @property
    def is_significant(self) -> bool:
        """Return whether neither noise nor wrong identities explain it."""
        return self.landmarks >= 2 and self.statistic > self.threshold


@dataclass(frozen=True, slots=True)
class _Seen:
    edge: int
    keyframe: int
    landmark: int
    stamp_ns: int


class InnovationMonitor:
    """The newest sightings of well known landmarks, of any kind.

    Parameters
    ----------
    solver, decisions : of the back-end
    history : from when on each landmark is well known
    """

    def __init__(self, solver: Solver, decisions: OutlierGate, history: LandmarkHistory) -> None:
        self._solver, self._decisions, self._history = solver, decisions, history
        self._ledger = decisions.ledger
        self._seen: deque[_Seen] = deque(maxlen=4 * _WINDOW)
        self._held_back, self._count = 0, 0  # of those that the window has left behind

    def begin(self, vertex: int) -> None:
        """A segment begins at a keyframe: what was seen before tells nothing of where it is."""
        self._seen = deque((one for one in self._seen if one.keyframe >= vertex), self._seen.maxlen)

    def renumber(self, vertices: Index, edges: Index) -> None:
        """Take over new ids of all vertices and edges, by old ones; -1: it was removed."""
        new = [
            _Seen(int(edges[one.edge]), int(vertices[one.keyframe]), int(vertices[one.landmark]), one.stamp_ns)
            for one in self._seen
        ]
        self._seen = deque((one for one in new if one.edge >= 0 and one.landmark >= 0), self._seen.maxlen)

    def add(self, edge: int, keyframe: int, landmark: int, stamp_ns: int) -> None:
        """A sighting of a landmark."""
        if len(self._seen) == self._seen.maxlen:
            self._leave_behind(self._seen[0])
        self._seen.append(_Seen(edge, keyframe, landmark, stamp_ns))

    def _leave_behind(self, one: _Seen) -> None:
        if self._ledger.is_standing()(one.edge) and self._known_from(one.landmark) < one.keyframe:
            self._count += 1
            self._held_back += not self._ledger.is_inside(one.edge)

    def _known_from(self, landmark: int) -> int:
        return self._history.known_from(landmark, self._seen[0].edge)

    def _window(self) -> list[_Seen]:
        """The newest, the newest first."""
        out, times, known_from = list[_Seen](), dict[int, int](), dict[int, int]()
        is_standing = self._ledger.is_standing()
        for one in reversed(self._seen):
            if len(out) == _WINDOW or (self._seen[-1].stamp_ns - one.stamp_ns) * 1e-9 > _REACH_S:
                break
            landmark, count = one.landmark, times.get(one.landmark, 0)
            if count == _PER_LANDMARK or not is_standing(one.edge):
                continue
            if landmark not in known_from:
                known_from[landmark] = self._known_from(landmark)
            if known_from[landmark] < one.keyframe:
                times[landmark] = count + 1
                out.append(one)
        return out

    def contradiction(self) -> Contradiction | None:
        """Return what the window tells; None where there is too little in it."""
        window, ledger = self._window(), self._ledger
        if len(window) < _LEAST:
            return None
        edges = np.array([one.edge for one in window])
        fits, numbers = self._solver.chi2_of(edges)
        is_out = ~np.array(ledger.are_inside(edges.tolist()), dtype=bool)
        innovations = np.where(is_out, ledger.statistic.values[edges], fits)
        order = np.argsort(innovations / numbers, kind="stable")
        counted = order[: max(0, len(order) - self._by_chance(len(order)))]
        if not len(counted):  # all may be wrong by chance
            return None
        limit = self._decisions.stated_scale * quantile(_SURE, int(numbers[counted].sum()))
        landmarks = {window[k].landmark for k in np.flatnonzero(is_out).tolist()}
        count = int(np.count_nonzero(is_out))
        return Contradiction(count, len(window), len(landmarks), float(innovations[counted].sum()), limit)

    @property
    def is_calm(self) -> bool:
        """Return whether most of the newest sightings agree with odometry."""
        newest = np.array([one.edge for one in self._window()[:_CALM]], dtype=np.int64)
        if not len(newest):
            return False
        innovations, numbers = self._solver.chi2_of(newest)
        is_out = ~np.array(self._ledger.are_inside(newest.tolist()), dtype=bool)
        innovations[is_out] = self._decisions.innovations(newest[is_out].tolist())
        counted = np.argsort(innovations / numbers, kind="stable")[: -(-3 * len(newest) // 4)]
        limit = self._decisions.stated_scale * quantile(_CALM_SURE, int(numbers[counted].sum()))
        return float(innovations[counted].sum()) <= limit

    def _by_chance(self, count: int) -> int:
        """Return how many of a count may be wrong though odometry is right."""
        return _wrong_by_chance(count, self._held_back, self._count)


@lru_cache(maxsize=64)
def _wrong_by_chance(count: int, held_back: int, seen: int) -> int:
    """The most of a count that are wrong, at the rate by which some of those seen were held back."""
    rate = betaincinv(1 + held_back, 1 + seen - held_back, _RATE_SURE)
    return next((k for k in range(count) if bdtr(k, count, rate) >= _SURE), count)
