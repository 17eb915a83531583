"""Find that the detector has numbered all landmarks anew on the way, as after a restart.

Then no id of before is seen any more, and most new landmarks lie where others were. The two halves of the map have no
landmark in common, so nothing corrects the one by the other.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from graph_slam_ros.typing import Array, Index

LEAST = 4
"""Sightings of an id that counts, and ids on either side."""

_SPANNING = 0.05  # part of the ids that may be seen on both sides: wrong ones
_SAME, _NEAR, _NEAR_M = 0.5, 0.4, 1.0  # part of the new ids that lie where others were; how near, in spacings, at most


@dataclass(frozen=True, slots=True)
class RenewedIds:
    """Ids that are new from some time on.

    Attributes
    ----------
    since_ns : the stamp of the first new one
    new, same : landmarks since then, and those of them that lie where others were
    """

    since_ns: int
    new: int
    same: int

    def __str__(self) -> str:
        return (
            f"from {self.since_ns * 1e-9:.3f} s on all ids are new, and {self.same} of {self.new} landmarks lie where "
            "others were: did the detector begin anew?"
        )


def renewed_ids(at: Array, first_ns: Index, last_ns: Index) -> RenewedIds | None:
    """Return which ids are new from some time on; None if none are.

    Parameters
    ----------
    at : (n, d) where the landmark of each id is [m]
    first_ns, last_ns : (n,) stamps at which each id was seen first and last
    """
    since_ns = _cut(first_ns, last_ns)
    if since_ns is None:
        return None
    old, new = last_ns < since_ns, first_ns >= since_ns
    tree = KDTree(at[old])
    near_m = min(_NEAR * float(np.median(tree.query(at[old], k=2)[0][:, 1])), _NEAR_M)
    same = int((tree.query(at[new])[0] < near_m).sum())
    return RenewedIds(since_ns, int(new.sum()), same) if same >= max(LEAST, _SAME * new.sum()) else None


def _cut(first_ns: Index, last_ns: Index) -> int | None:
    """Return the stamp that parts most ids into old and new ones; None if none does."""
    cuts = np.unique(first_ns)
    before = np.searchsorted(np.sort(last_ns), cuts)
    since = len(first_ns) - np.searchsorted(np.sort(first_ns), cuts)
    spanning = len(first_ns) - before - since
    fewer = np.where(spanning <= _SPANNING * len(first_ns), np.minimum(before, since), 0)
    best = int(fewer.argmax()) if len(fewer) else 0
    return int(cuts[best]) if len(fewer) and fewer[best] >= LEAST else None
