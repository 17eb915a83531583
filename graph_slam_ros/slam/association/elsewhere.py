"""Sightings without identities contradict the pose: what should be seen is not, and what is seen is not in the map.

That is so where the map knows the ground, and where all that was followed from scan to scan is lost at once.
The newest scans are then compared with the whole map as a constellation. If they fit it at one other pose only, and
not by chance, their clusters are proposed to be of the landmarks there. Whether that is so the displacement search
decides, as for landmarks with identities.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial import KDTree
from scipy.special import bdtrc

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import se2
from graph_slam_ros.slam.association.beam import NOTHING
from graph_slam_ros.slam.association.presence_check import FIT_M, is_missing
from graph_slam_ros.slam.association.scans import Scan
from graph_slam_ros.slam.landmarks.landmark_map import Landmarks
from graph_slam_ros.slam.landmarks.rotations import aligned
from graph_slam_ros.typing import Array, Index

_SCANS, _CLUSTERS = 6, 8  # the newest, and at least so many in them
_LOST, _FOUND = 0.25, 0.5  # part of them that is of landmarks of the map
_KNOWN = 4  # clusters of a landmark that is well known
_MISSING, _MISSING_LANDMARKS = 4, 2  # landmarks that should be seen and are not, over the scans, and different ones
_COMPARED = (6, 9, 12, 18, 24)  # newest scans that are compared with the map
_AFTER, _NEW = 3, 6  # scans since what was followed is lost, and at least so many clusters in them
_VIEW = 12  # scans before them, which show the field of view
_GOES_ON = 0.25  # part of them that is of landmarks seen before
_MISSED_BY_CHANCE = 1e-5  # probability
_SLIP = 0.5  # part of the way by which odometry may err: that is a slip
_MOST = 0.9  # part that fits since the robot was moved
_MOST_GROUPS, _MOST_MOTIONS = 12, 4000
_LEAST, _LEAST_APART_M = 4, 2.0  # points of a constellation, and how far two of them are apart
_SAME_M, _SAME_RAD = 1.0, 0.3  # poses farther from each other are two
_BY_CHANCE = 1e-4  # is_in_view the displacement search, which decides


@dataclass(frozen=True, slots=True)
class Seen:
    """The scans so far: their poses in map are those of the solver.

    Attributes
    ----------
    firsts : the first cluster of each scan
    thought : (M,) the number of each cluster's landmark, by the beam
    names : of landmarks by number
    before : of landmarks by number how many clusters there were before these
    """

    scans: Sequence[Scan]
    firsts: Sequence[int]
    thought: Index
    names: dict[int, str]
    before: Mapping[int, int]


class UnnamedDisplacement:
    """Detects that the newest scans contradict the pose, and proposes another.

    Attributes
    ----------
    since : the first cluster since when they do; None while they do not
    keeps_from : the keyframe, by its vertex, of the first scan since then
    fits_from : that of the first scan from which on most fits the other pose
    proposed : clusters that were proposed to be of other landmarks since then, with those that the beam says
    """

    def __init__(self, space: Geometry, landmarks: Landmarks) -> None:
        self._space, self._landmarks = space, landmarks
        self.since: int | None = None
        self.keeps_from: int | None = None
        self.fits_from: int | None = None
        self.proposed: dict[int, int] = {}

    def end(self) -> None:
        """Begin anew, because the pose is another now."""
        self.since = self.keeps_from = self.fits_from = None
        self.proposed = {}

    def propose(self, seen: Seen) -> dict[int, int]:
        """Compare the newest scans with the map; returns what fits elsewhere, as landmark by cluster."""
        thought = seen.thought.copy()
        thought[list(self.proposed)] = list(self.proposed.values())
        seen = replace(seen, thought=thought)
        self.update(seen)
        proposed = self.proposal(seen)
        self.proposed |= {cluster: int(thought[cluster]) for cluster in proposed}
        return proposed

    def update(self, seen: Seen) -> None:
        """Compare the newest scans with the map."""
        if len(seen.scans) <= 2 * _SCANS:
            return
        recent, before = seen.firsts[-_SCANS], seen.firsts[-2 * _SCANS]
        numbers, places = self._known(seen, before if self.since is None else self.since)
        part = float(np.mean(np.isin(seen.thought[recent:], numbers))) if recent < len(seen.thought) else 1.0
        if self.since is not None and part >= _FOUND:
            self.end()
        is_unknown = part <= _LOST and len(seen.thought) - recent >= _CLUSTERS
        if self.since is None and is_unknown and self._are_missing(seen, places):
            self.since, self.keeps_from = before, seen.scans[-2 * _SCANS].where.vertex
        if self.since is None and self._is_lost(seen):
            self.since, self.keeps_from = seen.firsts[-_AFTER], seen.scans[-_AFTER].where.vertex
            self.fits_from = self.keeps_from  # it was moved just then, wherever it is found again

    def _known(self, seen: Seen, before: int) -> tuple[Index, Array]:
        """Numbers and places (L, n) of the landmarks that were well known before a cluster."""
        counts, known = Counter(seen.before), self._landmarks.known
        for number, count in zip(*np.unique(seen.thought[:before], return_counts=True), strict=True):
            counts[int(number)] += int(count)
        often = sorted(k for k, count in counts.items() if count >= _KNOWN and k != NOTHING)
        numbers = np.array([k for k in often if seen.names.get(k) in known], dtype=np.int64)
        return numbers, self._landmarks.positions([known[seen.names[k]].vertex for k in numbers.tolist()])

    def _are_missing(self, seen: Seen, places: Array) -> bool:
        """Return whether landmarks of the map should be seen from the newest scans and are not."""
        missing = np.zeros(len(places), dtype=np.int64)
        for scan in seen.scans[-_SCANS:]:
            points = scan.points
            missing += is_missing(self._landmarks.seen_from(scan.where, places), points, points)
        return _are_gone(seen, missing)

    def _is_lost(self, seen: Seen) -> bool:
        """Return whether all that was followed from scan to scan is lost at once, while other things are seen.

        This needs no map: a robot that is carried to new ground sees nothing again of what it has just seen.
        """
        if len(seen.scans) < _VIEW + _AFTER or len({scan.at.segment for scan in seen.scans[-2 * _AFTER :]}) > 1:
            return False
        first, last = seen.firsts[-_AFTER], seen.scans[-_AFTER - 1]
        after, before = seen.thought[first:], seen.thought[:first]
        if len(after) < _NEW or np.mean(np.isin(after, before[before != NOTHING])) > _GOES_ON:
            return False
        now = before[seen.firsts[-_AFTER - 1] :]
        is_followed = np.isin(now, before[seen.firsts[-2 * _AFTER] : seen.firsts[-_AFTER - 1]]) & (now != NOTHING)
        if np.count_nonzero(is_followed) < _MISSING_LANDMARKS:
            return False
        group, space = self._space.group, self._space
        view = np.concatenate([scan.points for scan in seen.scans[-_VIEW - _AFTER : -_AFTER]])
        missing = np.zeros(np.count_nonzero(is_followed), dtype=np.int64)
        for scan in seen.scans[-_AFTER:]:
            moved = group.between(scan.at.pose, last.at.pose)
            in_base = last.points[is_followed] @ space.turn(moved).T + np.array(moved[: space.dimensions])
            fit_m = FIT_M + _SLIP * float(np.linalg.norm(moved[: space.dimensions]))
            missing += is_missing(in_base, view, scan.points, fit_m)
        return _are_gone(seen, missing)

    def proposal(self, seen: Seen) -> dict[int, int]:
        """Clusters of the newest scans, and the landmarks that they are of at the only other pose that fits."""
        if self.since is None or len(seen.scans[-1].at.pose) != 3:
            return {}
        numbers, places = self._known(seen, self.since)
        for count in _COMPARED:
            k = max(len(seen.scans) - count, seen.firsts.index(self.since))
            which = seen.thought[seen.firsts[k] :]
            points = np.array([se2.act(one.at.pose, tuple(c.point)) for one in seen.scans[k:] for c in one.clusters])
            groups, last, counts = np.unique(which[::-1], return_index=True, return_counts=True)
            groups = groups[np.argsort(last + len(which) * ((counts < 2) | (groups == NOTHING)))][:_MOST_GROUPS]
            centers = np.array([points[which == group].mean(axis=0) for group in groups]).reshape(-1, 2)
            motion = only_motion(centers, places, seen.scans[-1].at.pose)
            if motion is not None:
                return self._fitting(seen, motion, numbers, places)
        return {}

    def _fitting(self, seen: Seen, motion: tuple[Array, Array], numbers: Index, places: Array) -> dict[int, int]:
        """Clusters that a motion lays on landmarks, by their numbers and places, and these."""
        assert self.since is not None
        k, which = seen.firsts.index(self.since), seen.thought[self.since :]
        points = np.array([se2.act(one.at.pose, tuple(c.point)) for one in seen.scans[k:] for c in one.clusters])
        away, of = KDTree(places).query(points @ motion[0].T + motion[1])
        begins = np.array(seen.firsts[k:]) - self.since
        is_known = self.fits_from is not None and self.fits_from == self.keeps_from
        for one, begin in zip([] if is_known else seen.scans[k:], begins.tolist(), strict=False):
            if begin < len(away) and np.mean(away[begin:] < FIT_M) >= _MOST:
                self.fits_from = one.where.vertex
                break
        fits = np.flatnonzero((away < FIT_M) & ~np.isin(which, numbers))
        return {self.since + c: int(numbers[of[c]]) for c in fits.tolist()}


def _are_gone(seen: Seen, missing: Index) -> bool:
    """Return whether so many landmarks are missing that the sensor does not only miss them by chance.

    Parameters
    ----------
    missing : (L,) scans in which each landmark should be seen and is not
    """
    count = int(missing.sum())
    is_enough = count >= _MISSING and np.count_nonzero(missing) >= _MISSING_LANDMARKS
    return bool(is_enough) and _missed_part(seen) ** count < _MISSED_BY_CHANCE


def _missed_part(seen: Seen) -> float:
    """The part of landmarks seen in a scan and in the next but one that the scan between does not see, with a prior."""
    numbers = [set(seen.thought[a:b].tolist()) for a, b in pairwise(seen.firsts[-_VIEW - _AFTER : -_AFTER + 1])]
    count = missed = 0
    for before, between, after in zip(numbers, numbers[1:], numbers[2:], strict=False):
        both = before & after - {NOTHING}
        count, missed = count + len(both), missed + len(both - between)
    return (missed + 1) / (count + 2)


def only_motion(points: Array, places: Array, here: tuple[float, ...]) -> tuple[Array, Array] | None:
    """Return the rotation and translation that lay points (G, 2) on places (L, 2) as no other does, nor chance.

    Parameters
    ----------
    here : pose in the frame of the points: poses are compared there
    """
    turns, shifts = _motions(points, places)
    if not len(turns) or len(points) < _LEAST:
        return None
    tree = KDTree(places)
    c, s = np.cos(turns)[:, None], np.sin(turns)[:, None]
    x, y = points.T
    laid = np.stack([c * x - s * y + shifts[:, :1], s * x + c * y + shifts[:, 1:]], axis=-1)
    away, _ = tree.query(laid, distance_upper_bound=FIT_M)
    counts = np.count_nonzero(away < FIT_M, axis=1)
    best = int(counts.argmax())
    position = (
        np.stack([c[:, 0] * here[0] - s[:, 0] * here[1], s[:, 0] * here[0] + c[:, 0] * here[1]], axis=-1) + shifts
    )
    is_apart = np.linalg.norm(position - position[best], axis=1) > _SAME_M
    is_apart |= np.abs(se2.wrap(turns - turns[best])) > _SAME_RAD
    if 2 * int(counts[is_apart].max(initial=0)) > counts[best]:
        return None
    chance = len(places) * np.pi * FIT_M**2 / max(float(np.prod(np.ptp(places, axis=0))), 1.0)
    if len(turns) * bdtrc(int(counts[best]) - 3, len(points) - 2, min(chance, 1.0)) > _BY_CHANCE:
        return None
    away, of = tree.query(laid[best])
    fits = away < FIT_M
    return aligned(points[fits], places[of[fits]], np.ones(np.count_nonzero(fits)))


def _motions(points: Array, places: Array) -> tuple[Array, Array]:
    """Rotations (C,) and translations (C, 2) that lay two points on two places."""
    i, j = np.triu_indices(len(points), 1)
    apart = np.linalg.norm(points[i] - points[j], axis=1)
    i, j, apart = (one[apart > _LEAST_APART_M] for one in (i, j, apart))
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    turns, shifts = [], []
    for a, b, far in zip(i.tolist(), j.tolist(), apart.tolist(), strict=True):
        k, m = np.nonzero(np.abs(distances - far) < FIT_M)
        d, e = points[b] - points[a], places[m] - places[k]
        turn = np.arctan2(e[:, 1], e[:, 0]) - np.arctan2(d[1], d[0])
        middle, c, s = 0.5 * (points[a] + points[b]), np.cos(turn), np.sin(turn)
        moved = np.stack([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1]], axis=-1)
        turns.append(turn)
        shifts.append(0.5 * (places[k] + places[m]) - moved)
    if not turns:
        return np.empty(0), np.empty((0, 2))
    every = -(-sum(map(len, turns)) // _MOST_MOTIONS) or 1
    return np.concatenate(turns)[::every], np.concatenate(shifts)[::every]
