"""Sightings without identities contradict the pose: what should be seen is not, and what is seen is not in the map.

The newest scans are then compared with the whole map as a constellation. If they fit it at one other pose only, and
not by chance, their clusters are proposed to be of the landmarks there. Whether that is so the displacement search
decides, as for landmarks with identities.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.special import bdtrc

from graph_slam_ros.lie import se2
from graph_slam_ros.slam.landmarks.beam import NOTHING
from graph_slam_ros.slam.landmarks.landmark_map import Landmarks
from graph_slam_ros.slam.landmarks.rigid_alignment import aligned
from graph_slam_ros.slam.landmarks.scans import Scan
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index

_SCANS, _CLUSTERS = 6, 8  # the newest, and at least so many in them
_LOST, _FOUND = 0.25, 0.5  # part of them that is of landmarks of the map
_KNOWN = 4  # clusters of a landmark that is well known
_MISSING, _MISSING_LANDMARKS = 4, 2  # landmarks that should be seen and are not, over the scans, and different ones
_COMPARED = (6, 9, 12, 18, 24)  # newest scans that are compared with the map
_SAME_DIRECTION_RAD = 0.3  # what is nearer than something seen in about this direction should be seen
_FIT_M, _MOST = 0.5, 0.9  # and the part that fits since the robot was moved
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
    """

    scans: Sequence[Scan]
    firsts: Sequence[int]
    thought: Index
    names: dict[int, str]


class UnnamedDisplacement:
    """Detects that the newest scans contradict the pose, and proposes another.

    Attributes
    ----------
    since : the first cluster since when they do; None while they do not
    keeps_from : the keyframe, by its vertex, of the first scan since then
    fits_from : that of the first scan from which on most fits the other pose
    proposed : clusters that were proposed to be of other landmarks since then, with those that the beam says
    """

    def __init__(self, landmarks: Landmarks, solver: Solver) -> None:
        self._landmarks, self._solver = landmarks, solver
        self.since: int | None = None
        self.keeps_from: int | None = None
        self.fits_from: int | None = None
        self.proposed: dict[int, int] = {}

    def end(self) -> None:
        """Begin anew, because the pose is another now."""
        self.since = self.keeps_from = self.fits_from = None
        self.proposed = {}

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

    def _known(self, seen: Seen, before: int) -> tuple[Index, Array]:
        """Numbers and places (L, n) of the landmarks that were well known before a cluster."""
        numbers, counts = np.unique(seen.thought[:before], return_counts=True)
        known = self._landmarks.known
        numbers = np.array(
            [k for k in numbers[counts >= _KNOWN].tolist() if k != NOTHING and seen.names.get(k) in known],
            dtype=np.int64,
        )
        return numbers, self._landmarks.positions([known[seen.names[k]].vertex for k in numbers.tolist()])

    def _are_missing(self, seen: Seen, places: Array) -> bool:
        """Return whether landmarks of the map should be seen from the newest scans and are not."""
        missing = np.zeros(len(places), dtype=np.int64)
        for scan in seen.scans[-_SCANS:]:
            in_base = self._landmarks.seen_from(scan.where, places)
            points = np.array([one.point for one in scan.clusters])
            near, far = (np.linalg.norm(one, axis=1) + 1e-9 for one in (in_base, points))
            is_in_view = (in_base / near[:, None]) @ (points / far[:, None]).T > np.cos(_SAME_DIRECTION_RAD)
            is_seen = np.linalg.norm(in_base[:, None] - points[None], axis=2).min(axis=1) < _FIT_M
            missing += (is_in_view & (near[:, None] < far)).any(axis=1) & ~is_seen
        return bool(missing.sum() >= _MISSING and np.count_nonzero(missing) >= _MISSING_LANDMARKS)

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
        for one, begin in zip(seen.scans[k:], begins.tolist(), strict=True):
            if begin < len(away) and np.mean(away[begin:] < _FIT_M) >= _MOST:
                self.fits_from = one.where.vertex
                break
        fits = np.flatnonzero((away < _FIT_M) & ~np.isin(which, numbers))
        return {self.since + c: int(numbers[of[c]]) for c in fits.tolist()}


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
    away, _ = tree.query(laid)
    counts = np.count_nonzero(away < _FIT_M, axis=1)
    best = int(counts.argmax())
    position = (
        np.stack([c[:, 0] * here[0] - s[:, 0] * here[1], s[:, 0] * here[0] + c[:, 0] * here[1]], axis=-1) + shifts
    )
    is_apart = np.linalg.norm(position - position[best], axis=1) > _SAME_M
    is_apart |= np.abs(se2.wrap(turns - turns[best])) > _SAME_RAD
    if 2 * int(counts[is_apart].max(initial=0)) > counts[best]:
        return None
    chance = len(places) * np.pi * _FIT_M**2 / max(float(np.prod(np.ptp(places, axis=0))), 1.0)
    if len(turns) * bdtrc(int(counts[best]) - 3, len(points) - 2, min(chance, 1.0)) > _BY_CHANCE:
        return None
    away, of = tree.query(laid[best])
    fits = away < _FIT_M
    return aligned(points[fits], places[of[fits]], np.ones(np.count_nonzero(fits)))


def _motions(points: Array, places: Array) -> tuple[Array, Array]:
    """Rotations (C,) and translations (C, 2) that lay two points on two places."""
    i, j = np.triu_indices(len(points), 1)
    apart = np.linalg.norm(points[i] - points[j], axis=1)
    i, j, apart = (one[apart > _LEAST_APART_M] for one in (i, j, apart))
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    turns, shifts = [], []
    for a, b, far in zip(i.tolist(), j.tolist(), apart.tolist(), strict=True):
        k, m = np.nonzero(np.abs(distances - far) < _FIT_M)
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
