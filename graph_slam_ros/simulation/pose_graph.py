"""The same worlds as graphs: cities with closures between poses, and drives among landmarks."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.random import PCG64, Generator

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.g2o_writer import write_g2o
from graph_slam_ros.formats.graph_file import G2oFile, Values
from graph_slam_ros.graph import RELATIVE_POSE, SE2, Gaussian, Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import se2
from graph_slam_ros.simulation.manhattan import STEP_M, stroll
from graph_slam_ros.simulation.motion import space_of, step_covariance
from graph_slam_ros.simulation.options import fill, option
from graph_slam_ros.simulation.recording import Recording
from graph_slam_ros.slam import Sighting
from graph_slam_ros.typing import Array, Index, Numbers

POSES_PER_CLOSURE = 3
CLOSURE_RANGE_STEPS = 2  # to an earlier pose at most this far away in x and in y
CLOSURE_GAP_POSES = 20  # and at least this many poses earlier


@dataclass(frozen=True, slots=True)
class CityGraph:
    """Options of ``city_graph``."""

    poses: int = option(3500, "poses, 1 m apart", "", 2, 1e6)
    blocks: int = option(60, "the city is this many blocks of 4 m wide and deep", "", 1, 1000)
    sigma_m: float = option(0.05, "noise of relative positions, in x and in y", "m", 1e-9, 10)
    sigma_rad: float = option(0.01, "noise of relative headings", "rad", 1e-9, 1)
    odometry_noise_factor: float = option(1.0, "odometry is noisier than closures by this factor", "", 1e-6, 1e3)


def city_graph(seed: int, **values: float) -> tuple[Graph, Array]:
    """Manhattan as a pose graph: odometry (vertex k to k + 1), a closure per three poses once streets are revisited.

    Vertices start at the composed odometry, the first one at its true pose. No vertex is fixed.

    Parameters
    ----------
    values : options of ``CityGraph``

    Returns
    -------
    graph : edges labelled ``odometry`` and ``closures``, each in order of its later pose
    truth : (poses, 3) true poses
    """
    options = fill("city_graph", CityGraph, values)
    rng = Generator(PCG64(seed))
    cells, ways = stroll(rng, options.poses - 1, options.blocks)
    headings = 0.5 * np.pi * np.concatenate([ways[:1], ways])
    truth = np.column_stack([STEP_M * cells, se2.wrap(headings)])
    closures = closure_pairs(rng, cells)
    sigmas = np.array([options.sigma_m, options.sigma_m, options.sigma_rad])
    coarse = options.odometry_noise_factor * sigmas
    steps = np.column_stack([np.arange(options.poses - 1), np.arange(1, options.poses)])
    odometry = _measured(rng, truth, steps, coarse)
    graph = Graph()
    graph.add_vertices(SE2, _composed(truth[0], odometry))
    graph.add_edges(RELATIVE_POSE, steps, odometry, Gaussian.from_sigmas(*coarse.tolist()), "odometry")
    if len(closures):
        seen = _measured(rng, truth, closures, sigmas)
        graph.add_edges(RELATIVE_POSE, closures, seen, Gaussian.from_sigmas(*sigmas.tolist()), "closures")
    return graph, truth


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


def _measured(rng: Generator, truth: Array, pairs: Index, sigmas: Array) -> Array:
    """Relative poses (n, 3) of the pairs, ``T_i_j Exp(noise)``."""
    exact = se2.between(tuple(truth[pairs[:, 0]].T), tuple(truth[pairs[:, 1]].T))
    noise = rng.standard_normal((len(pairs), 3)) * sigmas
    return np.stack(se2.retract(exact, tuple(noise.T)), axis=1)


def _composed(start: Array, steps: Array) -> Array:
    """Poses (n + 1, 3) from relative poses (n, 3)."""
    theta = start[2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    moved = se2.act((0.0, 0.0, theta[:-1]), (steps[:, 0], steps[:, 1]))
    x, y = (first + np.concatenate([[0.0], np.cumsum(d)]) for first, d in zip(start[:2], moved, strict=True))
    return np.stack([x, y, se2.wrap(theta)], axis=1)


def landmark_graph(recording: Recording) -> Graph:
    """A recording as a graph: a pose at each stamp of odometry, a vertex for each landmark that was seen.

    Poses start at the dead reckoning, landmarks where they were first seen from there. The noise of an odometry edge is
    the twist covariance over the tick, as where each tick's error is its own. No vertex is fixed.

    Raises
    ------
    GraphSlamError
        A landmark is seen by bearing or by range alone: one sighting does not tell where it is.
    """
    graph, space = Graph(), space_of(recording.T_odom_base[0])
    poses = graph.add_vertices(space.pose, recording.T_odom_base)
    dt_s = np.diff(recording.stamps_ns) * 1e-9
    noise = [
        step_covariance(twist * dt, recording.twist_covariance * dt**2)
        for twist, dt in zip(recording.twist[1:], dt_s.tolist(), strict=True)
    ]
    odometry = space.group.between(tuple(recording.T_odom_base[:-1].T), tuple(recording.T_odom_base[1:].T))
    graph.add_edges(
        space.relative_pose,
        np.column_stack([poses[:-1], poses[1:]]),
        np.stack(odometry, axis=1),
        Gaussian.from_covariance(np.array(noise)),
        "odometry",
    )
    vertex_of: dict[str, int] = {}
    pose_at = dict(zip(recording.stamps_ns.tolist(), poses.tolist(), strict=True))
    for seen in recording.seen:
        pose = pose_at[seen.stamp_ns]
        for s in seen.sightings:
            if s.id not in vertex_of:
                vertex_of[s.id] = _first_seen(graph, space, tuple(recording.T_odom_base[pose].tolist()), s)
        for kind in dict.fromkeys(s.kind for s in seen.sightings):
            same, edge = [s for s in seen.sightings if s.kind == kind], space.sightings[kind]
            covariances = np.reshape([s.covariance for s in same], (-1, edge.residual_size, edge.residual_size))
            graph.add_edges(
                edge,
                [(pose, vertex_of[s.id]) for s in same],
                [edge.whole([*s.measured, *(s.T_base_sensor or ())]) for s in same],
                Gaussian.from_covariance(covariances),
                "landmarks",
            )
    for c in recording.closures:
        noise_of = Gaussian.from_covariance(np.reshape(c.covariance, (space.dof, space.dof)))
        ends = pose_at[c.from_stamp_ns], pose_at[c.stamp_ns]
        graph.add_edge(space.relative_pose, ends, c.T_from_base, noise_of, "closures")
    return graph


def _first_seen(graph: Graph, space: Geometry, T_odom_base: Numbers, s: Sighting) -> int:
    """A vertex for a landmark, at its first sighting."""
    group, seen = space.group, s.measured
    if s.kind == "pose":
        return graph.add_vertex(space.pose, group.compose(T_odom_base, seen))
    if s.kind == "range_bearing":
        distance, azimuth, elevation = (*seen, 0.0)[:3]
        flat = distance * np.cos(elevation)
        in_sensor = (flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation))
        seen = group.act(s.T_base_sensor or space.identity, in_sensor[: space.dimensions])
    elif s.kind != "position":
        raise GraphSlamError(f"a {s.kind} alone does not determine a landmark, and a graph needs initial values")
    return graph.add_vertex(space.point, group.act(T_odom_base, seen))


def write_graph(graph: Graph, path: Path | str) -> None:
    """Write a graph as g2o at its initial values. A FIX line holds the first vertex."""
    write_g2o(path, G2oFile(graph, list(range(graph.vertex_count)), [0]), values_of(graph, graph.initial.values))


def values_of(graph: Graph, numbers: Array) -> Values:
    """The values of vertices by id, of the stored numbers of all of them end to end."""

    def values(ids: Sequence[int]) -> Array:
        size = graph.kind_of(ids[0]).size
        return np.asarray(numbers[graph.offset.values[ids][:, None] + np.arange(size)])

    return values


def truth_of(recording: Recording, graph: Graph) -> Array:
    """The true stored numbers of all vertices of a recording's graph, end to end."""
    names = list(dict.fromkeys(s.id for seen in recording.seen for s in seen.sightings))
    true = [recording.landmarks[name] for name in names]
    size = [graph.kind_of(len(recording.stamps_ns) + k).size for k in range(len(names))]
    return np.concatenate([recording.T_world_base.ravel(), *(place[:n] for place, n in zip(true, size, strict=True))])
