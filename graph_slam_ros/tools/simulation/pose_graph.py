"""Worlds as graphs: a city and a sphere with closures between poses."""

from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
from numpy.random import Generator

from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.tools.simulation.manhattan import STEP_M, stroll
from graph_slam_ros.tools.simulation.options import checked, option, random
from graph_slam_ros.tools.simulation.recording import integrate
from graph_slam_ros.typing import Array, Index

POSES_PER_CLOSURE = 3
POSES_PER_LAP, RADIUS_M = 50, 100.0  # of the sphere
CLOSURE_RANGE_STEPS = 2  # to an earlier pose at most this far away in x and in y
CLOSURE_GAP_POSES = 20  # and at least this many poses earlier
_FACTOR = option(1.0, "odometry is noisier than closures by this factor", "", 1e-6, 1e3)


@checked("city")
def city_graph(
    seed: int,
    poses: int = option(3500, "poses, 1 m apart", "", 2, 1e6),
    blocks: int = option(60, "the city is this many blocks of 4 m wide and deep", "", 1, 1000),
    sigma_m: float = option(0.05, "noise of relative positions, in x and in y", "m", 1e-9, 10),
    sigma_rad: float = option(0.01, "noise of relative headings", "rad", 1e-9, 1),
    odometry_noise_factor: float = _FACTOR,
) -> tuple[Graph, Array]:
    """Manhattan as a pose graph: odometry (vertex k to k + 1), a closure per three poses once streets are revisited.

    Vertices start at the composed odometry, the first one at its true pose. No vertex is fixed.

    Returns
    -------
    graph : edges labelled ``odometry`` and ``closures``, each in order of its later pose
    truth : (poses, 3) true poses
    """
    rng = random(seed)
    cells, ways = stroll(rng, poses - 1, blocks)
    headings = 0.5 * np.pi * np.concatenate([ways[:1], ways])
    truth = np.column_stack([STEP_M * cells, se2.wrap(headings)])
    closures = closure_pairs(rng, cells)
    sigmas = PLANAR.sigmas(sigma_m, sigma_rad)
    return _pose_graph(PLANAR, rng, truth, closures, sigmas, odometry_noise_factor), truth


@checked("sphere")
def sphere_graph(
    seed: int,
    poses: int = option(2500, "poses, from the lower to the upper pole", "", 2, 1e6),
    sigma_m: float = option(0.1, "noise of relative positions, in x, y and z", "m", 1e-9, 10),
    sigma_rad: float = option(0.01, "noise of relative rotations, about x, y and z", "rad", 1e-9, 1),
    odometry_noise_factor: float = _FACTOR,
) -> tuple[Graph, Array]:
    """Fly up around a sphere, lap above lap. Each pose is measured from the one before and from the lap below.

    The x axis of a pose points away from the centre, its y axis ahead. Vertices start as in ``city_graph``, and edges
    have its labels and order.

    Returns
    -------
    graph
    truth : (poses, 7) true poses
    """
    rng, count = random(seed), np.arange(poses)
    yaw, pitch = 2.0 * np.pi * count / POSES_PER_LAP, np.pi * (0.5 - (count + 0.5) / poses)
    out = [se3.from_xyz_rpy((0.0, 0.0, 0.0, 0.0, *turn)) for turn in np.column_stack([pitch, yaw]).tolist()]
    truth = np.array([se3.compose(pose, (RADIUS_M, *se3.IDENTITY[1:])) for pose in out])
    closures = np.column_stack([count - POSES_PER_LAP, count])[POSES_PER_LAP:]
    sigmas = SPATIAL.sigmas(sigma_m, sigma_rad)
    return _pose_graph(SPATIAL, rng, truth, closures, sigmas, odometry_noise_factor), truth


GRAPH_WORLDS = {"city": city_graph, "sphere": sphere_graph}


def closure_pairs(rng: Generator, cells: Index) -> Index:
    """Pairs (earlier, later), at most one per later pose, chosen evenly among the earlier ones around it.

    While streets are new there is nothing to close. The missing closures are added when streets are revisited.
    """
    visits: dict[tuple[int, int], list[int]] = {}
    reach = range(-CLOSURE_RANGE_STEPS, CLOSURE_RANGE_STEPS + 1)
    draws = rng.random(len(cells)).tolist()
    pairs: list[tuple[int, int]] = []
    for k, (x, y) in enumerate(cells.tolist()):
        if len(pairs) < (k + 1) // POSES_PER_CLOSURE:
            lists = [found for dx in reach for dy in reach if (found := visits.get((x + dx, y + dy)))]
            counts = [bisect_right(found, k - CLOSURE_GAP_POSES) for found in lists]
            pick = int(draws[k] * sum(counts))
            for found, count in zip(lists, counts, strict=True):
                if pick < count:
                    pairs.append((found[pick], k))
                    break
                pick -= count
        visits.setdefault((x, y), []).append(k)
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _pose_graph(
    space: Geometry, rng: Generator, truth: Array, closures: Index, sigmas: Sequence[float], odometry_factor: float
) -> Graph:
    """A graph of odometry from pose to pose, and of these closures (n, 2); poses start where odometry leads."""
    near = np.array(sigmas)
    coarse = odometry_factor * near
    steps = np.column_stack([np.arange(len(truth) - 1), np.arange(1, len(truth))])
    odometry = _measured(space, rng, truth, steps, coarse)
    graph = Graph()
    motions = np.stack(space.group.log(tuple(odometry.T)), axis=1)
    graph.add_vertices(space.pose, integrate(tuple(truth[0].tolist()), motions))
    graph.add_edges(space.relative_pose, steps, odometry, Gaussian.from_sigmas(*coarse.tolist()), "odometry")
    if len(closures):
        seen = _measured(space, rng, truth, closures, near)
        graph.add_edges(space.relative_pose, closures, seen, Gaussian.from_sigmas(*near.tolist()), "closures")
    return graph


def _measured(space: Geometry, rng: Generator, truth: Array, pairs: Index, sigmas: Array) -> Array:
    """Relative poses (n, k) of the pairs, ``T_i_j Exp(noise)``."""
    exact = space.group.between(tuple(truth[pairs[:, 0]].T), tuple(truth[pairs[:, 1]].T))
    noise = rng.standard_normal((len(pairs), len(sigmas))) * sigmas
    return np.stack(space.group.retract(exact, tuple(noise.T)), axis=1)
