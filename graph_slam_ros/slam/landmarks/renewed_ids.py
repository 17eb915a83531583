"""Find that the detector has numbered all landmarks anew on the way, as after a restart, once or several times.

From some time on no id of before is seen any more, and most new landmarks lie where others were.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from graph_slam_ros.slam.levels import SIGMAS
from graph_slam_ros.typing import Array, Index

LEAST = 4  # sightings of an id that counts, and ids on either side
_SPANNING = 0.1  # part of the ids of either side that may be seen on both: wrong ones
_SAME, _NEAR_M = 0.5, 1.0  # part of the new ids that lie where others were, so near, in spacings; at most
_BY_CHANCE = 0.16  # part of them that is so near to another by chance, in landmarks that lie at random
_NEXT = 5  # ids that are new after one, of which the nearest is how far apart landmarks are


@dataclass(frozen=True, slots=True)
class RenewedIds:
    """Ids that are new from some time on.

    Attributes
    ----------
    since_ns : the stamp of the first new one
    new, same, pairs : landmarks since then, those that lie where others were, and some of these: old and new id
    """

    since_ns: int
    new: int
    same: int
    pairs: tuple[tuple[str, str], ...]

    def __str__(self) -> str:
        return (
            f"from {self.since_ns * 1e-9:.3f} s on all ids are new, and {self.same} of {self.new} landmarks lie where "
            f"others were ({', '.join(f'{old} is {new} now' for old, new in self.pairs[:5])}, ...): did it begin anew?"
        )


def renewed_ids(names: Sequence[str], at: Array, first_ns: Index, last_ns: Index) -> RenewedIds | None:
    """Return which ids are new from some time on; None if none are.

    Of several such times it is that from which on the most landmarks lie where others were.

    Parameters
    ----------
    names, at : the ids, and (n, d) where the landmark of each is [m]
    first_ns, last_ns : (n,) stamps at which each id was seen first and last
    """
    ends_ns, near_m = _ended_there(at, first_ns, last_ns)
    since_ns = np.unique(first_ns)
    before = np.searchsorted(np.sort(last_ns), since_ns)
    new = len(first_ns) - np.searchsorted(np.sort(first_ns), since_ns)
    again = ends_ns < first_ns
    same = np.searchsorted(np.sort(ends_ns[again]), since_ns) - np.searchsorted(np.sort(first_ns[again]), since_ns)
    least = np.maximum(_SAME * new, _BY_CHANCE * new + SIGMAS * np.sqrt(_BY_CHANCE * (1.0 - _BY_CHANCE) * new))
    spanning = len(first_ns) - before - new
    is_renewed = (same >= np.maximum(least, LEAST)) & (spanning <= _SPANNING * np.minimum(before, new))
    if not is_renewed.any():
        return None
    best = int(np.where(is_renewed, same, 0).argmax())
    before, since = (np.flatnonzero(of) for of in (last_ns < since_ns[best], first_ns >= since_ns[best]))
    away, of = KDTree(at[before]).query(at[since])
    pairs = tuple((names[before[of[k]]], names[since[k]]) for k in np.flatnonzero(away < near_m).tolist())
    return RenewedIds(int(since_ns[best]), int(new[best]), int(same[best]), pairs)


def _ended_there(at: Array, first_ns: Index, last_ns: Index) -> tuple[Index, float]:
    """(n,) When the first of the ids near each was seen last, itself among them; and what is near [m]."""
    in_order, n = at[np.argsort(first_ns, kind="stable")], len(at) - _NEXT
    apart = [np.linalg.norm(in_order[k : k + n] - in_order[:n], axis=1) for k in range(1, _NEXT + 1)]
    near_m = min(_SAME * float(np.median(np.min(apart, axis=0))), _NEAR_M)
    a, b = KDTree(at).query_pairs(near_m, output_type="ndarray").T
    ends_ns = last_ns.copy()
    np.minimum.at(ends_ns, a, last_ns[b])
    np.minimum.at(ends_ns, b, last_ns[a])
    return ends_ns, near_m
