"""Motions that lay points on places of a map as a constellation: by pairs of points and pairs as far apart."""

import numpy as np
from scipy.spatial import KDTree
from scipy.special import bdtrc

from graph_slam_ros.lie import se2
from graph_slam_ros.slam.association.scans import FIT_M
from graph_slam_ros.slam.landmarks.rotations import aligned, yaw
from graph_slam_ros.slam.levels import SAME_M, SAME_RAD
from graph_slam_ros.typing import Array, Numbers

_LEAST, _LEAST_APART_M = 4, 2.0  # points of a constellation, and how far two of them are apart
_MOST_MOTIONS = 4000  # bounds the time: an even sample of them
_BY_CHANCE = 1e-4  # is enough for the displacement search, which decides

Motions = tuple[Array, Array]
"""Rotations (m, n, n) about the vertical, and translations (m, n)."""


def pair_motions(points: Array, places: Array, least_m: float, same_m: float) -> Motions:
    """Return the motions that lay two points on two places.

    Parameters
    ----------
    least_m : how far apart the points are at least
    same_m : by which the distance of the places may differ from theirs
    """
    n = points.shape[1]
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    turns, moves = [np.empty((0, n, n))], [np.empty((0, n))]
    for u, one in enumerate(points):
        for other in points[:u]:
            d = other - one
            far = float(np.linalg.norm(d))
            if far < least_m:
                continue
            i, h = np.nonzero(np.abs(apart - far) <= same_m)
            between = places[h] - places[i]
            turn = yaw(np.arctan2(between[:, 1], between[:, 0]) - np.arctan2(d[1], d[0]), n)
            turns.append(turn)
            moves.append(0.5 * (places[i] + places[h]) - turn @ (0.5 * (one + other)))
    return np.concatenate(turns), np.concatenate(moves)


def only_motion(points: Array, places: Array, here: Numbers) -> tuple[Array, Array] | None:
    """Return the rotation and translation that lay points (G, 2) on places (L, 2) as no other does, nor chance.

    Parameters
    ----------
    here : pose in the frame of the points: poses are compared there
    """
    turns, moves = pair_motions(points, places, _LEAST_APART_M, FIT_M)
    if not len(turns) or len(points) < _LEAST:
        return None
    every = -(-len(turns) // _MOST_MOTIONS)
    turns, moves = turns[::every], moves[::every]
    tree = KDTree(places)
    away, _ = tree.query(points @ turns.transpose(0, 2, 1) + moves[:, None], distance_upper_bound=FIT_M)
    counts = np.count_nonzero(away < FIT_M, axis=1)
    best = int(counts.argmax())
    positions, angles = turns @ np.array(here[:2]) + moves, np.arctan2(turns[:, 1, 0], turns[:, 0, 0])
    is_apart = np.linalg.norm(positions - positions[best], axis=1) > SAME_M
    is_apart |= np.abs(se2.wrap(angles - angles[best])) > SAME_RAD
    if 2 * int(counts[is_apart].max(initial=0)) > counts[best]:
        return None
    chance = len(places) * np.pi * FIT_M**2 / max(float(np.prod(np.ptp(places, axis=0))), 1.0)
    if len(turns) * bdtrc(int(counts[best]) - 3, len(points) - 2, min(chance, 1.0)) > _BY_CHANCE:
        return None
    away, of = tree.query(points @ turns[best].T + moves[best])
    fits = away < FIT_M
    return aligned(points[fits], places[of[fits]], np.ones(np.count_nonzero(fits)))
