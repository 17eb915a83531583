"""Sightings without identities contradict the pose: what should be seen is not, and what is seen is not in the map.

That is so where the map knows the ground, and where all that was followed from scan to scan is lost at once. The scans
since then are compared with the whole map as a constellation. If they fit it at one pose only, and not by chance, their
clusters are proposed to be of the landmarks there. Whether that is so the displacement search decides, as for landmarks
with identities.
"""

import numpy as np
from scipy.spatial import KDTree

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import se2
from graph_slam_ros.slam.association.assignments import Assignments
from graph_slam_ros.slam.association.beam import NOTHING, Ids
from graph_slam_ros.slam.association.constellation import only_motion
from graph_slam_ros.slam.association.presence_check import is_missing, lost_of
from graph_slam_ros.slam.association.scan_history import ScanHistory
from graph_slam_ros.slam.association.scans import FIT_M
from graph_slam_ros.slam.landmarks.landmark_map import Landmarks
from graph_slam_ros.typing import Array, Index

_VIEW = 12  # scans before it was moved, which show the field of view, and what the sensor misses
_AFTER, _NEW = 3, 6  # scans since what was followed is lost, and at least so many clusters in them
_COMPARED = (6, 9, 12, 18, 24)  # newest scans that are compared with the whole map
_NEWEST = _COMPARED[0]  # scans that are compared with the map around them
_CLUSTERS = 8  # in them, at least
_FOUND = 0.5  # part of the clusters that is of landmarks seen before, once it is found
_GOES_ON = 0.5 * _FOUND  # at most, while it is lost
_MISSING, _MISSING_LANDMARKS = 4, 2  # landmarks that should be seen and are not, over the scans, and different ones
_MISSED_BY_CHANCE = 1e-5  # probability
_SLIP = 0.5  # part of the way by which odometry may err: that is a slip
_MOST_GROUPS = 12  # newest landmarks that are compared: bounds the time


class Elsewhere:
    """Detects that the newest scans contradict the pose, and proposes another.

    Attributes
    ----------
    since : the first cluster since when they do; None while they do not
    fits_from : the keyframe, by its vertex, from which on the robot is elsewhere; None if that is not known
    proposed : clusters that were proposed to be of other landmarks since then, with those that the beam says
    """

    def __init__(self, space: Geometry, landmarks: Landmarks, history: ScanHistory, clusters: Assignments) -> None:
        self._space, self._landmarks, self._history, self._clusters = space, landmarks, history, clusters
        self.since: int | None = None
        self.fits_from: int | None = None
        self.proposed: dict[int, int] = {}

    def end(self) -> None:
        """Begin anew, because the pose is another now."""
        self.since = self.fits_from = None
        self.proposed = {}

    def look(self) -> dict[int, int]:
        """Compare the newest scans with those before, and with the map; returns clusters and where else they fit."""
        scans, firsts = self._history.scans, self._history.firsts
        if len(scans) < _VIEW + _AFTER:
            return {}
        before = firsts[-2 * _NEWEST] if self.since is None else self.since
        numbers, places = self._known(before)
        newest = self._thought(len(scans) - _NEWEST)
        known_part = float(np.isin(newest, numbers).mean()) if len(newest) else 1.0
        if self.since is not None and known_part >= _FOUND:
            self.end()
        if self.since is None and known_part <= _GOES_ON and len(newest) >= _CLUSTERS and self._are_missing(places):
            self.since = before
        if self.since is None and self._are_lost():
            self.since, self.fits_from = firsts[-_AFTER], scans[-_AFTER].where.vertex
        return {} if self.since is None else self._proposal(self.since)

    def _thought(self, first: int, end: int | None = None) -> Ids:
        """The landmark of each cluster of some scans, by the beam."""
        firsts, given = self._history.firsts, self._clusters.given
        last = self._clusters.count if end is None or end == len(firsts) else firsts[end]
        return np.array([self.proposed.get(c, given[c]) for c in range(firsts[first], last)], dtype=np.int64)

    def _known(self, since: int) -> tuple[Index, Array]:
        """Numbers and places (L, n) of the landmarks that were believed before a cluster."""
        known = self._landmarks.known
        marks = {k: known[name] for k, name in self._clusters.names.items() if k < since and name in known}
        marks = {k: mark for k, mark in marks.items() if not mark.is_tentative}
        places = self._landmarks.positions([mark.vertex for mark in marks.values()])
        return np.array(list(marks), dtype=np.int64), places

    def _are_missing(self, places: Array) -> bool:
        """Return whether landmarks of the map should be seen from the newest scans and are not."""
        missing = np.zeros(len(places), dtype=np.int64)
        for scan in self._history.scans[-_NEWEST:]:
            missing += is_missing(self._landmarks.seen_from(scan.where, places), scan.points, scan.points)
        return self._are_gone(missing)

    def _are_lost(self) -> bool:
        """Return whether all that was followed from scan to scan is lost at once, while other things are seen.

        This needs no map: a robot that is carried to new ground sees nothing again of what it has just seen.
        """
        scans, space, count = self._history.scans, self._space, len(self._history.scans)
        if len({scan.at.segment for scan in scans[-2 * _AFTER :]}) > 1:
            return False
        after = self._thought(count - _AFTER)
        is_new = (after >= self._history.firsts[-_AFTER]) | (after == NOTHING)
        if len(after) < _NEW or np.mean(~is_new) > _GOES_ON:
            return False
        now, before = (
            self._thought(count - _AFTER - 1, count - _AFTER),
            self._thought(count - 2 * _AFTER, count - _AFTER - 1),
        )
        is_followed = np.isin(now, before) & (now != NOTHING)
        if np.count_nonzero(is_followed) < _MISSING_LANDMARKS:
            return False
        last, view = scans[-_AFTER - 1], np.concatenate([scan.points for scan in scans[-_VIEW - _AFTER : -_AFTER]])
        missing = np.zeros(np.count_nonzero(is_followed), dtype=np.int64)
        for scan in scans[-_AFTER:]:
            moved = space.group.between(scan.at.pose, last.at.pose)
            way = np.array(moved[: space.dimensions])
            in_base = last.points[is_followed] @ space.turn(moved).T + way
            missing += is_missing(in_base, view, scan.points, FIT_M + _SLIP * float(np.linalg.norm(way)))
        return self._are_gone(missing)

    def _are_gone(self, missing: Index) -> bool:
        """Return whether so many landmarks are missing that the sensor does not only miss them by chance.

        Parameters
        ----------
        missing : (L,) scans in which each landmark should be seen and is not
        """
        count, scans = int(missing.sum()), len(self._history.scans)
        if count < _MISSING or np.count_nonzero(missing) < _MISSING_LANDMARKS:
            return False
        names = [self._thought(k, k + 1) for k in range(scans - _VIEW - _AFTER, scans - _AFTER)]
        followed, lost = lost_of([set(one.tolist()) - {NOTHING} for one in names])
        return ((lost + 1) / (followed + 2)) ** count < _MISSED_BY_CHANCE

    def _proposal(self, since: int) -> dict[int, int]:
        """Clusters since then, and the landmarks that they are of at the only other pose that fits."""
        scans, first = self._history.scans, self._history.firsts.index(since)
        here = scans[-1].at.pose
        if len(here) != 3:
            return {}
        numbers, places = self._known(since)
        points = np.array([se2.act(one.at.pose, tuple(c.point)) for one in scans[first:] for c in one.clusters])
        thought = self._thought(first)
        for count in _COMPARED:
            newest = self._history.firsts[max(len(scans) - count, first)] - since
            motion = only_motion(_centers(points[newest:], thought[newest:]), places, here)
            if motion is not None:
                away, of = KDTree(places).query(points @ motion[0].T + motion[1])
                fits = np.flatnonzero((away < FIT_M) & ~np.isin(thought, numbers))
                self.proposed |= {since + c: int(thought[c]) for c in fits.tolist()}
                return {since + c: int(numbers[of[c]]) for c in fits.tolist()}
        return {}


def _centers(points: Array, which: Ids) -> Array:
    """The mean point (G, n) of each landmark: first of those seen at least twice, the newest first."""
    groups, last, counts = np.unique(which[::-1], return_index=True, return_counts=True)
    groups = groups[np.argsort(last + len(which) * ((counts < 2) | (groups == NOTHING)))][:_MOST_GROUPS]
    return np.array([points[which == group].mean(axis=0) for group in groups]).reshape(-1, points.shape[1])
