"""Moves that correct an association: merge two landmarks, reassign clusters. A move is kept if it costs less."""

from dataclasses import replace

import numpy as np

from graph_slam_ros.slam.association.explanation import UNUSED, Drive, Estimate, Ids, compressed
from graph_slam_ros.slam.association.scans import are_others
from graph_slam_ros.typing import Array

LEAST_SCANS = 3  # of a landmark
_MERGE_M = 3.0  # a stretch that lies farther off is laid anew as a whole
_APART = 0.02  # of the scans of two landmarks, that show both, if they may be one
_BOTH_AT_MOST = LEAST_SCANS  # scans that showed both, that count
_HOPELESS = 4.0  # times what a landmark costs: a merge that costs more by the covariance is not tried
_BETTER = 4.0  # chi2 by which another landmark fits a cluster better
_ROUNDS = 6  # of merging and reassigning, which end where nothing changes
TRIAL = 0.1  # a solve that compares ends where an iteration gains less

_Key = tuple[tuple[float, ...], tuple[float, ...]]
"""About where the two landmarks of a pair stand [m]."""


def refined(drive: Drive, e: Estimate) -> Estimate:
    """Merge and reassign until nothing changes."""
    for _ in range(_ROUNDS):
        if not drive.may_move:
            break
        before = e.cost
        e = merged(drive, e)
        e, is_changed = reassigned(drive, e)
        if e.cost >= before and not is_changed:
            break
    return drive.solve(e, 40)


def merged(drive: Drive, e: Estimate) -> Estimate:
    """Merge pairs, the nearest first, if that costs less than the landmark that it saves."""
    tried: set[_Key] = set()
    while True:
        for key, i, j in _pairs(drive, e, tried):
            if not drive.may_move:
                return e
            tried.add(key)
            one = _merged_pair(drive, e, i, j)
            if one is not None:
                e = one
                break
        else:
            return e


def _pairs(drive: Drive, e: Estimate, tried: set[_Key]) -> list[tuple[_Key, int, int]]:
    """Pairs of close landmarks, the nearest first, with their positions.

    Those that were tried are left out, and those that by their covariance are surely two are added to them.
    """
    landmarks = e.landmarks
    apart = np.linalg.norm(landmarks[:, None] - landmarks[None], axis=2)
    places = [tuple(place) for place in np.round(landmarks, 1).tolist()]
    near = zip(*(at.tolist() for at in np.nonzero(np.tril(apart < _MERGE_M, -1))), strict=True)
    pairs = [(a, b) for a, b in near if (places[a], places[b]) not in tried]
    i, j = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    close = np.unique(np.concatenate([i, j]))
    if len(i) and (blocks := drive.landmark_covariances(e, close)) is not None:
        a, b = np.searchsorted(close, i), np.searchsorted(close, j)
        away = landmarks[i] - landmarks[j]
        between = blocks[a, a] + blocks[b, b] - blocks[a, b] - blocks[b, a]
        chi2 = (away * np.linalg.solve(between, away[..., None])[..., 0]).sum(axis=1)
        counts = np.bincount(e.which[e.which >= 0], minlength=len(landmarks))
        most = (counts[i] + counts[j]) * drive.costs.loss_scale**2  # Cauchy's loss, if all clusters share it
        is_near = most * np.log1p(chi2 / most) < _HOPELESS * drive.costs.landmark * (1 + _BOTH_AT_MOST)
        tried.update((places[a], places[b]) for a, b in zip(i[~is_near].tolist(), j[~is_near].tolist(), strict=True))
        i, j = i[is_near], j[is_near]
    order = np.argsort(apart[i, j], kind="stable")
    return [((places[a], places[b]), a, b) for a, b in zip(i[order].tolist(), j[order].tolist(), strict=True)]


def _merged_pair(drive: Drive, e: Estimate, i: int, j: int) -> Estimate | None:
    is_i, is_j = e.which == i, e.which == j
    sorts = sorts_of(drive, e)
    if are_others(sorts[i], sorts[j]):
        return None
    both = len(np.intersect1d(drive.scan[is_i], drive.scan[is_j]))
    counts = np.count_nonzero(is_i), np.count_nonzero(is_j)
    if both > max(1.0, _APART * min(counts)):
        return None
    landmarks = e.landmarks.copy()
    landmarks[j] = np.average(e.landmarks[[i, j]], axis=0, weights=counts)
    one = drive.solve(compressed(replace(e, which=np.where(is_i, j, e.which), landmarks=landmarks)), 12, enough=TRIAL)
    allowed = drive.costs.landmark * min(both, _BOTH_AT_MOST)
    return one if drive.total(one) < drive.total(e) + allowed else None


def reassigned(drive: Drive, e: Estimate) -> tuple[Estimate, bool]:
    """Assign each cluster to the landmark that fits best, one to one in a scan, if the total cost falls."""
    chi2 = drive.chi2_with(e)
    chi2[are_others(drive.sort[:, None], sorts_of(drive, e))] = np.inf
    rows = np.arange(len(chi2))
    which, best = e.which.copy(), chi2.argmin(axis=1)
    mine = np.where(which >= 0, chi2[rows, which], drive.costs.unused)
    for i in np.flatnonzero((chi2.min(axis=1) < mine - _BETTER) & (best != which)).tolist():
        if not (which[drive.scan == drive.scan[i]] == best[i]).any():
            which[i] = best[i]
    which[(which >= 0) & (chi2[rows, which] > 2.0 * drive.costs.unused)] = UNUSED
    if (which == e.which).all():
        return e, False
    one = drive.solve(compressed(replace(e, which=without_few(which))), enough=TRIAL)
    if drive.total(one) > drive.total(e):
        return e, False
    return one, True


def sorts_of(drive: Drive, e: Estimate) -> Array:
    """The sort of each landmark (J,), empty where no cluster has one."""
    out = np.full(len(e.landmarks), "", dtype=drive.sort.dtype)
    used = (e.which >= 0) & (drive.sort != "")
    out[e.which[used]] = drive.sort[used]
    return out


def without_few(which: Ids) -> Ids:
    """Unassign the clusters of landmarks that hardly any scan contains."""
    counts = np.bincount(which[which >= 0], minlength=1)
    return np.where((which >= 0) & (counts[np.maximum(which, 0)] < LEAST_SCANS), UNUSED, which)
