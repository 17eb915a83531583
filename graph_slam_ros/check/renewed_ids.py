"""A check of identities: whether the detector has numbered the landmarks anew on the way, as after a restart.

Then no id of before is seen any more, and most new ones lie where others were. The two halves of the map have no
landmark in common, so nothing corrects the one by the other.
"""

from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree

from graph_slam_ros.check.finding import Finding
from graph_slam_ros.check.pairs import usable
from graph_slam_ros.check.sightings import SightingColumns
from graph_slam_ros.typing import Array, Index

_LEAST = 4  # sightings of an id, and ids on either side
_SPANNING = 0.05  # part of the ids that may be seen on both sides: wrong ones
_SAME, _NEAR, _NEAR_M = 0.5, 0.4, 1.0  # part of the new ids that lie where others were; how near, in spacings, at most


def check_renewed(s: SightingColumns, points: Array, path_ns: Index, dimensions: int) -> Iterator[Finding]:
    """Yield the finding that ids are new from some time on, if they are.

    Parameters
    ----------
    points : (k, 3) where each sighting puts its landmark in the map
    """
    use = usable(s, path_ns) & np.isfinite(points).all(axis=1)
    numbers, counts = np.unique(s.name[use], return_counts=True)
    ids = numbers[counts >= _LEAST]
    if len(ids) < 2 * _LEAST:
        return
    of = [np.flatnonzero(use & (s.name == one)) for one in ids]
    at = np.array([np.median(points[rows, :dimensions], axis=0) for rows in of])
    first, last = (np.array([end(s.stamp_ns[rows]) for rows in of]) for end in (np.min, np.max))
    since_ns = _cut(first, last)
    if since_ns is None:
        return
    old, new = last < since_ns, first >= since_ns
    tree = KDTree(at[old])
    near_m = min(_NEAR * float(np.median(tree.query(at[old], k=2)[0][:, 1])), _NEAR_M)
    same = int((tree.query(at[new])[0] < near_m).sum())
    if same < max(_LEAST, _SAME * new.sum()):
        return
    text = (
        f"{s.topic}: from {since_ns * 1e-9:.3f} s on all ids are new, and {same} of {new.sum()} landmarks lie where "
        "others were: did the detector begin anew?"
    )
    yield Finding("ids_renewed", "warning", same, _LEAST, "landmarks", text, s.topic, since_ns, int(new.sum()))


def _cut(first: Index, last: Index) -> int | None:
    """Return the stamp that parts most ids into old and new ones, by their first and last stamps; None if none does."""
    cuts = np.unique(first)
    before, since = np.searchsorted(np.sort(last), cuts), len(first) - np.searchsorted(np.sort(first), cuts)
    spanning = len(first) - before - since
    fewer = np.where(spanning <= _SPANNING * len(first), np.minimum(before, since), 0)
    best = int(fewer.argmax())
    return int(cuts[best]) if fewer[best] >= _LEAST else None
