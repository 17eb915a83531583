"""The landmarks of the map in an explanation of the scans in memory: scans that stand for what was seen before.

Some scans at the pose of the first one see each landmark that has sightings which are final. Together they know as much
of its place, relative to that pose, as the solver does.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graph_slam_ros.slam.landmarks.belief import SolverBelief
from graph_slam_ros.slam.landmarks.hindsight import FrozenScans
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.landmarks.moves import LEAST_SCANS
from graph_slam_ros.slam.landmarks.scans import Cluster, Motion, Scan

_COUNT = LEAST_SCANS  # with fewer a landmark would be dropped
_APART_NS = 100_000_000_000  # so that no stretch of the drive has two of them
_LEAST_M2 = 1e-6
_STILL = 1e-9  # variances of the motion between them


def with_map(frozen: FrozenScans, belief: SolverBelief, known: Mapping[int, Landmark]) -> FrozenScans:
    """Return frozen scans after those that stand for landmarks of the map.

    Parameters
    ----------
    known : the landmarks, by number

    Raises
    ------
    GraphSlamError
        The solver has no covariance.
    """
    if not known or not frozen.scans:
        return frozen
    first, marks, dof = frozen.scans[0], list(known.values()), frozen.nearby.shape[-1]
    points, covariances = belief.seen_from(first, [mark.name for mark in marks])
    n = points.shape[1]
    clusters = tuple(
        Cluster(point, _COUNT * (covariance + _LEAST_M2 * np.eye(n)), (), mark.sort)
        for mark, point, covariance in zip(marks, points, covariances, strict=True)
    )
    still = Motion(np.zeros(n), np.zeros(dof - n), _STILL * np.eye(dof), 1e-3, is_broken=False)
    stamps_ns = [first.at.stamp_ns - k * _APART_NS for k in range(_COUNT, 0, -1)]
    numbers = np.tile(np.array(list(known), dtype=np.int64), _COUNT)
    before = np.array([mark.sightings - len(mark.seen) for mark in marks])
    return replace(
        frozen,
        scans=(*(Scan(replace(first.at, stamp_ns=at), first.where, clusters) for at in stamps_ns), *frozen.scans),
        motions=(still,) * _COUNT + frozen.motions,
        nearby=np.concatenate([np.zeros((_COUNT, *frozen.nearby.shape[1:])), frozen.nearby]),
        poses=np.concatenate([np.tile(frozen.poses[:1], (_COUNT, 1)), frozen.poses]),
        given=np.concatenate([numbers, frozen.given]),
        leader=np.concatenate([numbers, frozen.leader]),
        of_map=_COUNT,
        clusters_of_map=len(numbers),
        times=np.concatenate([np.tile(before / _COUNT, _COUNT), np.ones(len(frozen.given))]),
    )
