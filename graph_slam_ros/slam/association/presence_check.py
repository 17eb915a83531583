"""A check of an explanation: landmarks that should be seen and are not.

What is nearer than something that is seen in about the same direction is in view. A sensor misses some of that, as
scans that follow one another show. If over the whole drive far more is missing, landmarks stand where there are none.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.slam.association.explanation import UNUSED, Drive, Estimate
from graph_slam_ros.slam.association.scans import FIT_M
from graph_slam_ros.typing import Array, Mask

_SAME_DIRECTION_RAD = 0.3  # from what was seen: so near the field of view is known
_MUCH_MORE = 4.0  # times what the sensor misses; maps that are right reach 2.3
_LEAST_PART, _LEAST = 0.02, 10  # of what should be seen: fewer say nothing


def is_missing(in_base: Array, view: Array, points: Array, fit_m: float = FIT_M) -> Mask:
    """Return which of the landmarks should be seen and are not.

    Parameters
    ----------
    in_base : (..., L, n) where they should be seen, in the base frame [m]
    view : (V, n) what shows the field of view: what is nearer than a point in about the same direction is in view
    points : (P, n) what is seen
    fit_m : what is nearer to a landmark than this is the landmark
    """
    near, far = (np.linalg.norm(one, axis=-1) + 1e-9 for one in (in_base, view))
    is_in_view = (in_base / near[..., None]) @ (view / far[:, None]).T > np.cos(_SAME_DIRECTION_RAD)
    is_seen = np.linalg.norm(in_base[..., None, :] - points, axis=-1).min(axis=-1) < fit_m
    return np.asarray((is_in_view & (near[..., None] < far)).any(axis=-1) & ~is_seen)


@dataclass(frozen=True, slots=True)
class Presence:
    """Counts over all scans.

    Attributes
    ----------
    seen, missing : landmarks in view of a scan that it has seen, and has not
    followed, lost : landmarks that the scans before and after one have seen, and those of them that it has not
    """

    seen: int
    missing: int
    followed: int
    lost: int

    @property
    def missing_part(self) -> float:
        """The part of landmarks in view that is missing."""
        return self.missing / max(self.seen + self.missing, 1)

    @property
    def lost_part(self) -> float:
        """The part that the sensor misses, with a prior."""
        return (self.lost + 1) / (self.followed + 2)

    @property
    def is_doubtful(self) -> bool:
        """Return whether far more is missing than the sensor misses."""
        least = max(_MUCH_MORE * self.lost_part, _LEAST_PART)
        return self.missing >= _LEAST and self.missing_part > least


NOTHING_SEEN = Presence(0, 0, 0, 0)


def presence(drive: Drive, e: Estimate, first: int = 0) -> Presence:
    """Count which landmarks in view were seen, over all scans from one on."""
    begins = np.searchsorted(drive.scan, np.arange(first, drive.size + 1)).tolist()
    names = [set(e.which[a:b].tolist()) - {UNUSED} for a, b in itertools.pairwise(begins)]
    missing = 0
    for k, (a, b) in enumerate(itertools.pairwise(begins), first):
        if a == b or not len(e.landmarks):
            continue
        points = drive.points[a:b]
        is_absent = is_missing((e.landmarks - e.position[k]) @ e.turn[k], points, points)
        is_absent[list(names[k - first])] = False
        missing += int(np.count_nonzero(is_absent))
    return Presence(sum(map(len, names)), missing, *lost_of(names))


def lost_of(names: Sequence[set[int]]) -> tuple[int, int]:
    """Count the landmarks that the scans before and after one have seen, and those of them that it has not."""
    both = [(before & after, between) for before, between, after in zip(names, names[1:], names[2:], strict=False)]
    return sum(len(one) for one, _ in both), sum(len(one - between) for one, between in both)
