"""Data association of sightings without identity: what each may be, by the covariance of robot and map together.

The innovation of sighting i with landmark j, ``r = z_i - h_j(x)``, has the covariance ``S = H_j P H_j' + R_i`` with the
joint covariance P of the keyframe and the landmarks nearby. A pair costs ``r' S^-1 r + log |2 pi S|``, and one that was
never seen ``-2 log`` of how many of them there are to a square (cubic) metre: so the vaguer a landmark is foreseen, the
less it is taken for what is seen. ``nearest`` decides sighting by sighting (an assignment, since one message shows each
landmark once), ``joint`` demands that all pairs of a message fit together: J. Neira, J. D. Tardos, "Data association in
stochastic mapping using the joint compatibility test", 2001.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import gammaincinv

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.frontend.motion_compensation import ROUNDING, KeyframeMeasurement, point_jacobian
from graph_slam_ros.typing import Array, Numbers

NEW, UNCLEAR = -1, -2
_SURE = 0.95
_MOST_TRIED = 2000  # pairings of one message; the best so far is taken then
_MOST_WEIGHED = 4000  # pairings of landmarks with older ones; none is clear then


@dataclass(frozen=True, slots=True)
class Gates:
    """The gates of data association.

    Attributes
    ----------
    same : probability with which a true pair passes
    other : outside this a sighting is of none of them
    density : landmarks to a square or cubic metre
    margin : how much worse (chi2) all else must fit
    close_m : but for landmarks this close to each other
    """

    same: float
    other: float
    density: float
    margin: float
    close_m: float

    @property
    def new(self) -> float:
        """Return what a landmark costs that was never seen."""
        return -2.0 * float(np.log(self.density))

    def chi2(self, dof: int) -> float:
        """The largest statistic of a pair, or of several together."""
        return quantile(self.same, dof)

    def sure_chi2(self, dof: int) -> float:
        """Up to this a sighting is of a landmark whatever else it may be."""
        return quantile(_SURE, dof)

    def other_chi2(self, dof: int) -> float:
        """The least statistic of what does not belong together."""
        return quantile(self.other, dof)


@cache
def quantile(probability: float, dof: int) -> float:
    """A quantile of chi-square, by the special function."""
    return 2.0 * float(gammaincinv(0.5 * dof, probability))


@dataclass(frozen=True, slots=True)
class Expected:
    """The expected observations of landmarks from a keyframe.

    Attributes
    ----------
    points : (L, n) where each is expected, in the keyframe's frame
    covariance : (L n, L n) of all of them together
    is_followed : (L,) which of them were seen just now: the others are only what a sighting may be as well
    """

    points: Array
    covariance: Array
    is_followed: NDArray[np.bool_]


def expected(
    space: Geometry, T_map_keyframe: Numbers, landmarks: Sequence[Numbers], joint: Array, is_followed: NDArray[np.bool_]
) -> Expected:
    """Positions of landmarks in a keyframe's frame.

    Parameters
    ----------
    landmarks : points or poses in map
    joint : (D, D) covariance of the keyframe and these landmarks, in this order
    """
    n, dof = space.dimensions, space.dof
    back, turn = space.group.inverse(T_map_keyframe), space.turn(T_map_keyframe)
    points = np.empty((len(landmarks), n))
    jacobian = np.zeros((len(landmarks) * n, len(joint)))
    at = dof
    for j, landmark in enumerate(landmarks):
        points[j] = space.group.act(back, landmark[:n])
        rows = slice(j * n, (j + 1) * n)
        jacobian[rows, :dof] = -point_jacobian(space, points[j])
        is_pose = len(landmark) == space.pose.size
        jacobian[rows, at : at + n] = turn.T @ space.turn(landmark) if is_pose else turn.T
        at += dof if is_pose else n
    return Expected(points, of_sums(jacobian, joint), is_followed)


def of_sums(jacobian: Array, covariance: Array) -> Array:
    """``J P J'``, and what rounding leaves where large numbers cancel: less is not known of their difference."""
    largest = np.abs(jacobian) @ np.sqrt(np.diag(covariance))
    return np.asarray(jacobian @ covariance @ jacobian.T + np.diag(ROUNDING * largest**2))


@dataclass(frozen=True, slots=True)
class Match:
    """The association of a sighting.

    Attributes
    ----------
    landmark : its index, ``NEW`` where it is none of them, ``UNCLEAR`` where that is open
    spread : (n, n) what is added to the sighting's covariance, in the keyframe's axes, since it may as well be of
        another landmark close by
    """

    landmark: int
    spread: Array | None = None


def associate(gates: Gates, seen: Sequence[KeyframeMeasurement], what: Expected, *, jointly: bool) -> list[Match]:
    """Return the landmark of each sighting, by index."""
    statistic, cost = _costs(seen, what)
    n, followed = what.points.shape[1], what.is_followed
    possible = np.where(statistic > gates.chi2(n), np.inf, cost)
    mine = np.where(followed, possible, np.inf)
    pairs = _jointly(gates, seen, what, mine) if jointly else _one_by_one(mine, gates.new)
    out = []
    for i in range(len(seen)):
        j = pairs.get(i)
        if j is None:
            is_apart = not followed.any() or statistic[i, followed].min() > gates.other_chi2(n)
            out.append(Match(NEW if is_apart else UNCLEAR))
        elif statistic[i, j] > gates.sure_chi2(n) and (possible[i, ~followed] < cost[i, j]).any():
            out.append(Match(NEW))
        else:
            used = [k for k in pairs.values() if k != j]
            rivals = np.flatnonzero(mine[i] < cost[i, j] + gates.margin)
            out.append(_among_rivals(gates, what.points, cost[i], j, [k for k in rivals.tolist() if k not in used]))
    return out


def _among_rivals(gates: Gates, points: Array, cost: Array, j: int, rivals: list[int]) -> Match:
    """The best where all that fit nearly as well are close to it; then the sighting says as much less."""
    offsets = points[rivals] - points[j]
    if np.linalg.norm(offsets, axis=1).max() > gates.close_m:
        return Match(UNCLEAR)
    weights = np.exp(-0.5 * (cost[rivals] - cost[rivals].min()))
    return Match(j, (offsets.T * (weights / weights.sum())) @ offsets)


def pair_cost(residual: Array, covariance: Array) -> tuple[float, float]:
    """chi2 of a residual (n,), and with the log of its density's volume."""
    statistic = float(residual @ np.linalg.solve(covariance, residual))
    return statistic, statistic + float(np.linalg.slogdet(2.0 * np.pi * covariance)[1])


def _costs(seen: Sequence[KeyframeMeasurement], what: Expected) -> tuple[Array, Array]:
    """chi2 and cost of each sighting (a row) with each landmark."""
    count, n = what.points.shape
    k = np.arange(count)
    blocks = what.covariance.reshape(count, n, count, n)[k, :, k, :]
    at = np.array([z.measured[:n] for z in seen])
    covariance = blocks[None] + np.array([z.covariance for z in seen])[:, None]
    r = at[:, None] - what.points[None]
    statistic = np.einsum("ijk,ijk->ij", r, np.linalg.solve(covariance, r[..., None])[..., 0])
    return statistic, statistic + np.linalg.slogdet(2.0 * np.pi * covariance)[1]


def _one_by_one(cost: Array, new: float) -> dict[int, int]:
    """The assignment with the least sum."""
    rows, columns = cost.shape
    full = np.full((rows, columns + rows), new)
    full[:, :columns] = np.where(np.isfinite(cost), cost, 1e6)
    found = zip(*linear_sum_assignment(full), strict=True)
    return {int(i): int(j) for i, j in found if j < columns and np.isfinite(cost[i, j])}


def _jointly(gates: Gates, seen: Sequence[KeyframeMeasurement], what: Expected, cost: Array) -> dict[int, int]:
    """The pairs that fit together and cost the least: branch and bound."""
    n = what.points.shape[1]
    options = [[int(j) for j in np.argsort(row) if np.isfinite(row[j])] for row in cost]
    order = sorted((i for i in range(len(seen)) if options[i]), key=lambda i: len(options[i]))
    best: dict[int, int] = {}
    best_cost, tried = np.inf, 0
    least = [min(0.0, *(cost[i, options[i]] - gates.new)) for i in order]

    def descend(depth: int, pairs: dict[int, int], so_far: float) -> None:
        nonlocal best, best_cost, tried
        tried += 1
        if so_far + sum(least[depth:]) >= best_cost or tried > _MOST_TRIED:
            return
        if depth == len(order):
            best, best_cost = dict(pairs), so_far
            return
        i = order[depth]
        for j in options[i]:
            if j not in pairs.values():
                longer = pairs | {i: j}
                if _joint_statistic(seen, what, longer) < gates.chi2(n * len(longer)):
                    descend(depth + 1, longer, so_far + cost[i, j] - gates.new)
        descend(depth + 1, pairs, so_far)

    descend(0, {}, 0.0)
    return best


def _joint_statistic(seen: Sequence[KeyframeMeasurement], what: Expected, pairs: dict[int, int]) -> float:
    n = what.points.shape[1]
    rows = np.concatenate([np.arange(j * n, (j + 1) * n) for j in pairs.values()])
    covariance = what.covariance[np.ix_(rows, rows)]
    for k, i in enumerate(pairs):
        covariance[k * n : (k + 1) * n, k * n : (k + 1) * n] += seen[i].covariance
    r = np.concatenate([np.array(seen[i].measured[:n]) - what.points[j] for i, j in pairs.items()])
    return float(r @ np.linalg.solve(covariance, r))


@dataclass(frozen=True, slots=True)
class Candidates:
    """Pairs of a landmark and an older one that may be the same.

    Attributes
    ----------
    options : (k,) of each landmark the pairs it is in, the likeliest first
    residual : (P n,) difference of the positions of each pair
    covariance : (P n, P n) of all of them together
    excluded : (P, P) which pairs are not both true
    """

    options: Sequence[Sequence[int]]
    residual: Array
    covariance: Array
    excluded: NDArray[np.bool_]

    def cost(self, pairs: Sequence[int]) -> tuple[float, float]:
        """chi2 of some pairs together, and with the log of its density's volume."""
        n = len(self.residual) // len(self.excluded)
        rows = (np.array(pairs)[:, None] * n + np.arange(n)).ravel()
        return pair_cost(self.residual[rows], self.covariance[rows[:, None], rows])


def likely_pairings(gates: Gates, c: Candidates) -> list[tuple[int, ...]] | None:
    """The sets of pairs that fit together and cost at most ``margin`` more than the best, the best first.

    Branch and bound; None where that is too much to look through. A landmark in no pair costs as much as a new one.
    """
    count = len(c.excluded)
    if not count:
        return [()]
    n = len(c.residual) // count
    # A pair given all others is never foreseen better: what it may gain at most.
    sharpest = np.linalg.inv(c.covariance).reshape(count, n, count, n)[range(count), :, range(count), :]
    gain = gates.new + np.linalg.slogdet(sharpest / (2.0 * np.pi))[1]
    names = sorted((k for k in range(len(c.options)) if c.options[k]), key=lambda k: len(c.options[k]))
    hope = [max(0.0, *(float(gain[p]) for p in c.options[k])) for k in names]
    to_come = np.r_[np.cumsum(hope[::-1])[::-1], 0.0]
    found: list[tuple[float, tuple[int, ...]]] = []
    best, tried = np.inf, 0

    def descend(depth: int, pairs: tuple[int, ...], so_far: float) -> None:
        nonlocal best, tried
        tried += 1
        if tried > _MOST_WEIGHED or so_far - to_come[depth] > best + gates.margin:
            return
        if depth == len(names):
            best = min(best, so_far)
            found.append((so_far, pairs))
            return
        for p in c.options[names[depth]]:
            if not c.excluded[p, list(pairs)].any():
                longer = (*pairs, p)
                statistic, cost = c.cost(longer)
                if statistic < gates.chi2(n * len(longer)):
                    descend(depth + 1, longer, cost - len(longer) * gates.new)
        descend(depth + 1, pairs, so_far)

    descend(0, (), 0.0)
    if tried > _MOST_WEIGHED:
        return None
    found.sort(key=lambda item: item[0])
    return [pairs for cost, pairs in found if cost <= best + gates.margin]
