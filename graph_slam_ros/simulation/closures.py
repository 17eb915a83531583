"""True loop closures beside what a world's own sensor sees: where a robot has been before, it is seen to be."""

from dataclasses import replace

import numpy as np
from numpy.random import PCG64, Generator, SeedSequence

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.simulation.motion import space_of
from graph_slam_ros.simulation.recording import CLOSURES_TOPIC, Recording
from graph_slam_ros.slam import Closure
from graph_slam_ros.typing import Array, Index

PLACE_M = 0.5  # between the places that closures join, along the way
REACH_M = 2.0  # from one end of a closure to the other at most
GAP_NS = 10 * 10**9  # and at least so much later
SIGMA_M, SIGMA_RAD = 0.05, 0.01
_STREAM = 0


def places(poses: Array) -> Index:
    """Numbers of the poses (n, 3) or (n, 7) at which so much has been driven since the one before, and the first."""
    steps = np.linalg.norm(np.diff(poses[:, : space_of(poses[0]).dimensions], axis=0), axis=1)
    count = np.floor(np.concatenate([[0.0], np.cumsum(steps)]) / PLACE_M)
    return np.flatnonzero(np.diff(count, prepend=-1.0) > 0.0)


def with_closures(recording: Recording, count: int, seed: int) -> Recording:
    """A recording with so many true closures, evenly among the places that the robot came back to.

    Raises
    ------
    GraphSlamError
        It did not come back so often.
    """
    rng = Generator(PCG64(SeedSequence(seed, spawn_key=(_STREAM,))))
    space, at = space_of(recording.T_world_base[0]), places(recording.T_world_base)
    n, truth, stamps_ns = space.dimensions, recording.T_world_base[at], recording.stamps_ns[at]
    back: list[tuple[int, Index]] = []
    for later, stamp_ns in enumerate(stamps_ns.tolist()):
        before = int(np.searchsorted(stamps_ns, stamp_ns - GAP_NS, side="right"))
        away = np.linalg.norm(truth[:before, :n] - truth[later, :n], axis=1)
        if (near := np.flatnonzero(away <= REACH_M)).size:
            back.append((later, near))
    if len(back) < count:
        raise GraphSlamError(f"{count} closures: the robot came back to {len(back)} places only")
    sigmas = np.concatenate([np.full(n, SIGMA_M), np.full(space.dof - n, SIGMA_RAD)])
    covariance = tuple(np.diag(np.square(sigmas)).ravel().tolist())
    found = []
    for pick in np.sort(rng.permutation(len(back))[:count]).tolist():
        later, near = back[pick]
        earlier = int(near[rng.integers(len(near))])
        true = space.group.between(tuple(truth[earlier].tolist()), tuple(truth[later].tolist()))
        noise = tuple((sigmas * rng.standard_normal(space.dof)).tolist())
        measured = tuple(float(number) for number in space.group.retract(true, noise))
        found.append(Closure(int(stamps_ns[later]), int(stamps_ns[earlier]), CLOSURES_TOPIC, measured, covariance))
    return replace(recording, closures=tuple(found))
