"""A check of an explanation: landmarks that should be seen and are not.

What is nearer than something that is seen in about the same direction is in view. A sensor misses some of that, as
scans that follow one another show. If over the whole drive far more is missing, landmarks stand where there are none.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.slam.landmarks.explanation import UNUSED, Drive, Estimate
from graph_slam_ros.slam.landmarks.view import is_missing

_MUCH_MORE = 4.0  # times what the sensor misses; maps that are right reach 2.3
_LEAST_PART, _LEAST = 0.02, 10


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
    both = [(before & after, between) for before, between, after in zip(names, names[1:], names[2:], strict=False)]
    followed, lost = sum(len(one) for one, _ in both), sum(len(one - between) for one, between in both)
    return Presence(sum(map(len, names)), missing, followed, lost)
