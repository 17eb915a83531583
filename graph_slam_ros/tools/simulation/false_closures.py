"""False loop closures, as place recognition makes them.

They are drawn as by Vertigo, the generator that robust solvers are compared with (Suenderhauf, Protzel, "Switchable
constraints for robust pose graph SLAM", 2012): two poses, and between them a relative pose near the identity. A draw
that agrees with the truth is not false. It is drawn again, as in McGann et al. ("Robust incremental smoothing and
mapping (riSAM)", 2023).
"""

import numpy as np
from numpy.random import Generator

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.tools.simulation.recording import space_of
from graph_slam_ros.typing import Array, Index

POLICIES = ("random", "local", "group", "local-group", "aliased")
SIGMA_M, SIGMA_RAD = 0.3, float(np.deg2rad(10.0))  # how far from the identity what is measured is
LOCAL_POSES = 20  # between the ends of a local one at most
GROUP = 10  # pairs of a group, each of the poses after those of the pair before
AGREES = 0.9999  # a true relative pose is within this quantile of what is measured,
MARGIN = 4.0  # and what is false is off by more than this multiple of it
_ALIKE_OF = 30  # pairs of stretches of which the two most alike are taken for one place
_PATIENCE = 100  # draws for each that is wanted, before it is said that there are none


def false_closures(
    truth: Array,
    roots: Array,
    rng: Generator,
    policy: str,
    rate: float = 0.0,
    count: int = 0,
    group: int = GROUP,
    margin: float = MARGIN,
) -> tuple[Index, Array, Array]:
    """Draw false closures.

    Raises GraphSlamError: no true closure, unknown policy, too few poses, or all that can be drawn agrees with the
    truth.

    Parameters
    ----------
    truth : (n, 3) or (n, 7) true poses, in order of time
    roots : (m, d, d) those of true closures; each false one, or group, has that of one of them
    policy : ``random``: any two poses; ``local``: at most 20 apart; ``group``, ``local-group``: consecutive pairs, all
        with the same measurement; ``aliased``: two stretches of the path taken for one place, so that each of its pairs
        is measured where one wrong rigid motion of the second stretch would have it, with the noise of a true closure
    rate, count : the fraction of all closures that is false then; or so many, whatever the rate
    group : pairs in a group

    Returns
    -------
    ends : (k, 2) the earlier and the later pose
    measured : (k, 3) or (k, 7), the later pose in the earlier one
    root : (k, d, d), R with ``R'R`` the information in the tangent space of what is measured
    """
    if not len(roots):
        raise GraphSlamError("false_closures: there is no true one to be like (simulate records some with --closures)")
    count = count or round(rate * len(roots) / (1.0 - rate))
    if policy not in POLICIES:
        raise GraphSlamError(f"false closures: {policy!r} is not one of {', '.join(POLICIES)}")
    pairs = group if policy.endswith("group") or policy == "aliased" else 1
    if len(truth) < 2 * pairs + 2:
        raise GraphSlamError(f"false closures: {len(truth)} poses are too few for groups of {pairs}")
    draw = _aliased if policy == "aliased" else _local if policy.startswith("local") else _anywhere
    limit = margin * quantile(AGREES, roots.shape[-1])
    ends, measured, root = [np.empty((0, 2), dtype=np.int64)], [np.empty((0, truth.shape[1]))], [roots[:0]]
    found, tried = 0, 0
    while found < count:
        tried += 1
        if tried > _PATIENCE * count:
            raise GraphSlamError(
                f"false closures ({policy}): all but {found} of {tried - 1} draws agree with the truth"
            )
        its_root = roots[rng.integers(len(roots))]
        at, z = draw(rng, truth, its_root, pairs)
        if (disagreement(truth, at, z, its_root) > limit).all():
            wanted = min(pairs, count - found)
            ends.append(at[:wanted])
            measured.append(z[:wanted])
            root.append(np.tile(its_root, (wanted, 1, 1)))
            found += wanted
    return np.concatenate(ends), np.concatenate(measured), np.concatenate(root)


def disagreement(poses: Array, ends: Index, measured: Array, root: Array) -> Array:
    """Chi2 (n,) of relative poses at given poses."""
    space = space_of(poses[0])
    residual, _ = space.relative_pose.linearize(poses.ravel(), poses.shape[1] * ends, measured)
    return np.asarray(np.square(np.einsum("...ij,...j->...i", root, residual)).sum(axis=-1))


def _anywhere(rng: Generator, truth: Array, _root: Array, pairs: int) -> tuple[Index, Array]:
    last = len(truth) - pairs
    a, b = rng.integers(0, last + 1, size=2).tolist()
    earlier, later = _distant_pair(min(a, b), max(a, b), last)
    return _following(earlier, later, pairs), np.tile(_near_identity(rng, space_of(truth[0])), (pairs, 1))


def _local(rng: Generator, truth: Array, _root: Array, pairs: int) -> tuple[Index, Array]:
    last = len(truth) - pairs
    earlier = int(rng.integers(0, last - 1))
    later = int(rng.integers(earlier + 2, min(last, earlier + LOCAL_POSES) + 1))
    return _following(earlier, later, pairs), np.tile(_near_identity(rng, space_of(truth[0])), (pairs, 1))


def _aliased(rng: Generator, truth: Array, root: Array, pairs: int) -> tuple[Index, Array]:
    """The two most similar stretches that do not overlap: the same view at two places.

    With W the wrong motion of the second stretch, a pair is measured as ``Ti^-1 W Tj``.
    """
    space, last = space_of(truth[0]), len(truth) - pairs
    group, best = space.group, (np.inf, _following(0, 1, pairs))
    for _ in range(_ALIKE_OF):
        earlier = int(rng.integers(0, last - pairs))
        at = _following(earlier, int(rng.integers(earlier + pairs + 1, last + 1)), pairs)
        moved = (group.between(tuple(truth[ends[0]]), tuple(truth[ends].T)) for ends in at.T)
        unlike = float(np.abs(np.stack(group.local(*moved))).max())
        best = min(best, (unlike, at), key=lambda one: one[0])
    at = best[1]
    seen = tuple(_near_identity(rng, space).tolist())
    middle = at[pairs // 2]
    wrong = group.compose(group.compose(tuple(truth[middle[0]]), seen), group.inverse(tuple(truth[middle[1]])))
    exact = group.between(tuple(truth[at[:, 0]].T), group.compose(wrong, tuple(truth[at[:, 1]].T)))
    noise = np.linalg.solve(root, rng.standard_normal((space.dof, pairs)))
    return at, np.stack(group.retract(exact, tuple(noise)), axis=1)


def _distant_pair(earlier: int, later: int, last: int) -> tuple[int, int]:
    """Two poses that no odometry edge joins."""
    if later - earlier >= 2:
        return earlier, later
    return (earlier, earlier + 2) if earlier + 2 <= last else (earlier - 2, earlier)


def _following(earlier: int, later: int, pairs: int) -> Index:
    return np.array([earlier, later]) + np.arange(pairs)[:, None]


def _near_identity(rng: Generator, space: Geometry) -> Array:
    n = space.dimensions
    sigmas = np.concatenate([np.full(n, SIGMA_M), np.full(space.dof - n, SIGMA_RAD)])
    turned = space.group.exp(tuple((sigmas * rng.standard_normal(space.dof)).tolist()))
    return np.array([float(number) for number in turned])
