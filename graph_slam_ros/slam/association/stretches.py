"""Alignment of a stretch of the drive with the rest of the map, all its landmarks at once.

Where the landmarks of a stretch are copies of landmarks elsewhere, they cannot be mended one by one. Candidate motions
come from pairs of landmarks in the stretch and equally distant pairs in the map. The best few are solved completely,
and their costs are compared.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial import KDTree

from graph_slam_ros.slam.association.constellation import Motions, pair_motions
from graph_slam_ros.slam.association.explanation import UNUSED, Drive, Estimate, Ids, compressed
from graph_slam_ros.slam.association.moves import TRIAL, merged, reassigned, sorts_of, without_few
from graph_slam_ros.slam.association.scans import FIT_M, are_others
from graph_slam_ros.slam.landmarks.rotations import yaw
from graph_slam_ros.slam.levels import ENOUGH
from graph_slam_ros.typing import Array, Mask

_SHORT_S, _WEAK = 100.0, 0.15  # a landmark that is seen for less, or in so small a part of the median's scans
_GAP_S, _LONGEST_S = 5.0, 60.0  # without a scan, in which odometry may err unseen; of a stretch around a landmark
_TRIES = 4  # candidates that are solved completely
_OTHER = 0.1  # part of the clusters by which two candidates differ
_MOST_COST, _MOST_PRIOR, _NONE = 14.0, 30.0, 60.0  # of a cluster, of a motion; chi2 of a cluster of no landmark
_TURN_RAD, _MOVE_M = 0.3, 0.6  # sigmas of what odometry errs by in a gap; and so do distances of pairs of landmarks
_LEAST_STRONG = 5  # scans of a landmark that a stretch is laid on
_MOST_MOVES, _MOST_STRETCHES = 40, 16  # bound the time, as the next two
_MOST_LOCAL, _MOST_SCORED = 8, 200  # landmarks whose pairs make motions, and motions that are compared by all clusters
_HOPELESS = _NONE  # that much more than before is never mended by giving clusters to others


def laid_on_the_map(drive: Drive, e: Estimate) -> tuple[Estimate, int]:
    """Move stretches onto the map while that lowers the cost. Returns also how many fit several places."""
    undecided, moves, moves_before = 0, 0, -1
    while moves > moves_before and moves < _MOST_MOVES:  # until nothing moves in a whole round
        undecided, moves_before = 0, moves
        tried: set[tuple[int, int, int]] = set()
        while left := [one for one in stretches(drive, e) if one not in tried]:
            if not drive.may_move:
                return e, undecided
            tried.add(left[0])
            better = _laid(drive, e, *left[0])
            undecided += better is e
            if better is not None and better is not e:
                e, moves = merged(drive, better), moves + 1
    return e, undecided


def stretches(drive: Drive, e: Estimate) -> list[tuple[int, int, int]]:
    """Stretches of scans that odometry may have laid at a wrong place.

    First those around landmarks that were seen in a single stretch of time, or rarely, each with its landmark. Then
    those between two gaps, in which nothing was seen, and the pairs of these: in a gap odometry may have erred.
    """
    stamps, counts = drive.stamps_s, drive.counts(e)
    out: list[tuple[int, int, int]] = []
    ends = np.flatnonzero(np.diff(stamps) > _GAP_S)
    runs = list(zip(np.r_[0, ends + 1].tolist(), np.r_[ends, len(stamps) - 1].tolist(), strict=True))
    for landmark in np.argsort(counts, kind="stable").tolist():
        scans = drive.scan[e.which == landmark]
        t = stamps[scans]
        if t[-1] - t[0] >= _SHORT_S and counts[landmark] >= _WEAK * np.median(counts):
            continue
        starts = np.r_[0, np.flatnonzero(np.diff(t) > 2 * _GAP_S) + 1]
        ends = np.r_[starts[1:], len(t)] - 1
        own = [(int(scans[a]), int(scans[b])) for a, b in zip(starts, ends, strict=True)]
        out += [(landmark, *one) for one in own]
        out += [(landmark, *_grown(stamps, *one)) for one in own]
    out = list(dict.fromkeys(out))[:_MOST_STRETCHES]
    return out + [(UNUSED, *one) for one in runs] + [(UNUSED, a[0], b[1]) for a, b in pairwise(runs)]


def _grown(stamps: Array, first: int, last: int) -> tuple[int, int]:
    """A stretch of scans without a gap."""
    while first > 0 and stamps[first] - stamps[first - 1] < _GAP_S and stamps[last] - stamps[first - 1] < _LONGEST_S:
        first -= 1
    while (
        last + 1 < len(stamps)
        and stamps[last + 1] - stamps[last] < _GAP_S
        and stamps[last + 1] - stamps[first] < _LONGEST_S
    ):
        last += 1
    return first, last


def _laid(drive: Drive, e: Estimate, landmark: int, first: int, last: int) -> Estimate | None:
    """Move a stretch onto landmarks that were seen before it; None if that does not lower the cost.

    Returns ``e`` itself if two such motions cost nearly the same.
    """
    is_inside = (drive.scan >= first) & (drive.scan <= last)
    outside = drive.counts(e, ~is_inside)
    least = max(_LEAST_STRONG, _WEAK * float(np.median(outside[outside > 0])) if outside.any() else 0.0)
    was_seen = np.isin(np.arange(len(outside)), e.which[drive.scan < first])
    strong = np.flatnonzero((outside >= least) & was_seen & (np.arange(len(outside)) != landmark))
    inside = np.flatnonzero(is_inside)
    if len(strong) < 2 or len(inside) < ENOUGH:
        return None
    scans, found, done = slice(first, last + 1), list[Estimate](), [e.which[inside]]
    for which, turn, move in _candidates(drive, e, inside, strong, (first + last) // 2):
        if any((which != other).mean() < _OTHER for other in done):
            continue
        done.append(which)
        found.append(_solved(drive, e, inside, which, scans, turn, move))
        if len(found) == _TRIES:
            break
    found.sort(key=drive.total)
    if not found or drive.total(found[0]) >= drive.total(e) - drive.costs.ambiguous:
        return None
    others = [one for one in found[1:] if _are_apart(found[0], one, scans) and _are_apart(e, one, scans)]
    is_unique = all(drive.total(one) >= drive.total(found[0]) + drive.costs.ambiguous for one in others)
    return found[0] if is_unique else e


def _are_apart(a: Estimate, b: Estimate, scans: slice) -> bool:
    """Return whether two estimates have a stretch at different places."""
    return float(np.linalg.norm(a.position[scans] - b.position[scans], axis=1).max()) > FIT_M


def _solved(drive: Drive, e: Estimate, inside: Ids, of_inside: Ids, scans: slice, turn: Array, move: Array) -> Estimate:
    """Solve with a stretch moved, and its clusters assigned to other landmarks."""
    which, position, turns = e.which.copy(), e.position.copy(), e.turn.copy()
    which[inside] = of_inside
    position[scans], turns[scans] = position[scans] @ turn.T + move, turn @ turns[scans]
    moved = replace(e, which=without_few(which), position=position, turn=turns)
    one = drive.solve(compressed(moved), 40, enough=TRIAL)
    is_hopeless = drive.total(one) > drive.total(e) + _HOPELESS
    return one if is_hopeless else reassigned(drive, one)[0]


def _candidates(drive: Drive, e: Estimate, inside: Ids, strong: Ids, middle: int) -> list[tuple[Ids, Array, Array]]:
    """Motions of a stretch, the likeliest first, each with the landmarks of its clusters."""
    at, names, there = drive.seen_at(e, inside), e.which[inside], e.landmarks[strong]
    ids, counts = np.unique(names[names >= 0], return_counts=True)
    local = np.array([np.median(at[names == k], axis=0) for k in ids[np.argsort(-counts, kind="stable")]])
    local = local.reshape(-1, drive.n)
    centre = e.position[middle]
    turns, moves = _motions(local[:_MOST_LOCAL], there, centre)
    rough = _rough_scores(local, there, turns, moves) + _priors(turns, moves, centre)
    rough[0] = 0.0  # as it lies
    likely = np.argsort(rough, kind="stable")[:_MOST_SCORED]
    priors = _priors(turns[likely], moves[likely], centre)
    whiten = drive.whiten[inside] @ e.turn[drive.scan[inside]].transpose(0, 2, 1)
    weakest = np.linalg.eigvalsh(whiten.transpose(0, 2, 1) @ whiten)[:, 0]
    reach = 1.001 * _NONE / np.maximum(weakest, 1e-12)  # squared [m2]: what is farther away counts as nothing
    is_other = are_others(drive.sort[inside][:, None], sorts_of(drive, e)[strong])
    scored = []
    for turn, move, prior in zip(turns[likely], moves[likely], priors.tolist(), strict=True):
        least, best = _nearest(at @ turn.T + move, there, turn, whiten, reach, is_other)
        score = float(np.minimum(least / 4.0, _MOST_COST).sum()) + prior
        scored.append((score, np.where(least < _NONE, strong[best], UNUSED), turn, move))
    as_it_lies = scored[int(np.flatnonzero(likely == 0)[0])][0]
    scored.sort(key=lambda one: one[0])
    return [one[1:] for one in scored if one[0] < as_it_lies + _MOST_PRIOR]


def _nearest(at: Array, there: Array, turn: Array, whiten: Array, reach: Array, is_other: Mask) -> tuple[Array, Ids]:
    """The least chi2 (C,) of moved clusters (C, n) with landmarks (J, n), and of which; infinite if none is in reach.

    Parameters
    ----------
    turn : by which the clusters were turned; whiten : (C, n, n) in the axes before
    reach : (C,) squared distance up to which landmarks are looked at [m2]
    is_other : (C, J) whether the sorts differ
    """
    apart = np.zeros((len(at), len(there)))
    for axis in range(at.shape[1]):
        apart += np.square(at[:, None, axis] - there[None, :, axis])
    i, j = np.nonzero((apart < reach[:, None]) & ~is_other)
    away = (there[j] - at[i]) @ turn  # in the axes before the turn
    chi2 = np.full(apart.shape, np.inf)
    chi2[i, j] = np.square((whiten[i] @ away[..., None])[..., 0]).sum(axis=-1)
    best: Ids = chi2.argmin(axis=1)
    return chi2[np.arange(len(at)), best], best


def _rough_scores(local: Array, there: Array, turns: Array, moves: Array) -> Array:
    """The misfit of a stretch with the landmarks, for each motion."""
    at = np.einsum("mij,uj->mui", turns, local) + moves[:, None]
    nearest, _ = KDTree(there).query(at, distance_upper_bound=_MOVE_M * _MOST_COST**0.5)
    return np.asarray(np.minimum(np.square(nearest / _MOVE_M), _MOST_COST).sum(axis=1))


def _priors(turns: Array, moves: Array, centre: Array) -> Array:
    """The prior cost of each motion, from its rotation and translation."""
    gone = np.square(turns @ centre + moves - centre).sum(axis=1)
    return np.minimum(
        np.square(np.arctan2(turns[:, 1, 0], turns[:, 0, 0]) / _TURN_RAD) + gone / _MOVE_M**2, _MOST_PRIOR
    )


def _motions(local: Array, there: Array, centre: Array) -> Motions:
    """Motions that align clusters with landmarks: none, by one pair, by two pairs. The first is none."""
    n = len(centre)
    turns, moves = [np.eye(n)[None]], [np.zeros((1, n))]
    bearing = np.arctan2((there - centre)[:, 1], (there - centre)[:, 0])
    for one in local:
        turn = yaw(bearing - np.arctan2(*(one - centre)[1::-1]), n)
        turns += [turn, np.broadcast_to(np.eye(n), turn.shape)]
        moves += [centre - turn @ centre, there - one]
    by_pairs = pair_motions(local, there, FIT_M, _MOVE_M)
    return np.concatenate([*turns, by_pairs[0]]), np.concatenate([*moves, by_pairs[1]])
