"""A visit: a stretch of keyframes at one place, and what it measured of the landmarks, as one joint Gaussian."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import Edge, EdgeType, Gaussian, Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.lifelong.elimination import marginal_information
from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.typing import Array

_SETTINGS = replace(Settings(), step_tolerance=1e-10, cost_tolerance=0.0)
_ONE_STEP = replace(Settings(), max_iterations=1, cost_tolerance=np.inf)
_LEAST = 1e-6  # eigenvalue of the correlations of a landmark's position, given the poses: less is no position
Estimate = Callable[[ArrayLike], Array]


@dataclass(frozen=True, slots=True)
class Visit:
    """The joint Gaussian of landmarks by some edges alone.

    Attributes
    ----------
    members : vertices of the landmarks, ascending
    points : (m, d) their positions in the axes of one pose of the visit [m]
    linearized_at : (m, d) the same by the whole map, where the edges are linearised
    information : (m d, m d) of these, given that pose; all other poses are marginalised out
    chi2, degrees : of the edges at their own optimum
    """

    members: tuple[int, ...]
    points: Array
    linearized_at: Array
    information: Array
    chi2: float
    degrees: int


def visit_of(
    space: Geometry, graph: Graph, estimate: Estimate, poses: Sequence[int], base: int, edges: Mapping[int, float]
) -> Visit:
    """Return what some edges say of the landmarks on them, in the axes of one pose.

    No other edge has a say in it, but they are linearised at the estimate of the whole map: there the visit is compared
    with others. At its own optimum landmarks may be far from there, where only odometry joins them. Landmarks whose
    position these edges alone do not determine are left out, with their sightings.

    Parameters
    ----------
    estimate : stored numbers of vertices by the whole map
    poses : vertices of the visit; base : one of them
    edges : between these and landmarks, with the factor by which each counts, above 0

    Raises
    ------
    SingularError
        The edges do not determine the poses, or no landmark.
    """
    records = {edge: graph.edge(edge) for edge in sorted(edges)}
    ends = {number: one.vertices for number, one in records.items()}
    marks = sorted({v for vertices in ends.values() for v in vertices} - set(poses))
    while marks:
        order = [base, *(v for v in poses if v != base), *marks]
        known = set(order)
        inside = [edge for edge in ends if known.issuperset(ends[edge])]
        counting = [(records[edge], edges[edge]) for edge in inside]
        solver, at = _local_solver(space, estimate, order, len(marks), counting)
        solver.hold(at[base])
        size, information = space.dimensions, solver.information_matrix()
        whole = {ends[edge][1] for edge in inside if records[edge].type.residual_size >= size}
        if not whole.issuperset(marks):
            blocks = [len(information) - size * (len(marks) - k) for k in range(len(marks))]
            sure = [_is_sure(information[low : low + size, low : low + size]) for low in blocks]
            if not all(sure):
                marks = [mark for mark, is_sure in zip(marks, sure, strict=True) if is_sure]
                continue
        kept = np.arange(len(information) - size * len(marks), len(information))
        marginal = marginal_information(information, kept)
        numbers = [at[mark] for mark in marks]
        linearized_at = solver.estimate(numbers)
        solver.optimize(_ONE_STEP)
        points = solver.estimate(numbers)
        chi2 = solver.optimize().chi2_final
        return Visit(tuple(marks), points, linearized_at, marginal, chi2, solver.degrees_of_freedom)
    raise SingularError("the visit determines no landmark")


def best_known(
    space: Geometry, graph: Graph, estimate: Estimate, poses: Sequence[int], edges: Mapping[int, float]
) -> int:
    """Return which pose of a visit, counted from 0, the landmarks that it sees determine best.

    Parameters are those of ``visit_of``.

    Raises
    ------
    SingularError
        They do not determine them.
    """
    records = [(graph.edge(edge), edges[edge]) for edge in sorted(edges)]
    marks = sorted({v for edge, _ in records for v in edge.vertices} - set(poses))
    if not marks:
        raise SingularError("the visit sees no landmark")
    solver, at = _local_solver(space, estimate, [*poses, *marks], len(marks), records)
    for mark in marks:
        solver.hold(at[mark])
    solver.update()
    spreads = [np.linalg.slogdet(one)[1] for one in solver.marginal(range(len(poses)))]
    return int(np.argmin(spreads))


def _is_sure(information: Array) -> bool:
    """Return whether the information (d, d) of a point is of full rank."""
    scale = np.sqrt(np.diag(information))
    return bool(scale.all()) and float(np.linalg.eigvalsh(information / np.outer(scale, scale))[0]) > _LEAST


def _local_solver(
    space: Geometry, estimate: Estimate, order: Sequence[int], marks: int, edges: Sequence[tuple[Edge, float]]
) -> tuple[Solver, dict[int, int]]:
    """Return a solver of some edges alone, each with its factor, and the ids that it has of some vertices.

    Parameters
    ----------
    order : the vertices; all are in the axes of the first pose, and the last ones, so many ``marks``, are landmarks
    """
    poses, points = order[: len(order) - marks], order[len(order) - marks :]
    at_poses, at_points = estimate(poses), estimate(points)
    local, group = Graph(), space.group
    base = tuple(at_poses[0].tolist())
    local.add_vertices(space.pose, np.stack(group.between(base, tuple(at_poses.T)), axis=-1))
    local.add_vertices(space.point, np.stack(group.act(group.inverse(base), tuple(at_points.T)), axis=-1))
    at, by_type = {vertex: k for k, vertex in enumerate(order)}, dict[EdgeType, list[tuple[Edge, float]]]()
    for one in edges:
        by_type.setdefault(one[0].type, []).append(one)
    for edge_type, several in by_type.items():
        ends = [[at[v] for v in edge.vertices] for edge, _ in several]
        noise = Gaussian(np.stack([np.sqrt(factor) * edge.sqrt_information for edge, factor in several]))
        local.add_edges(edge_type, ends, np.stack([edge.measured for edge, _ in several]), noise, several[0][0].label)
    solver = Solver(local, _SETTINGS)
    solver.add(range(local.vertex_count), range(local.edge_count))
    return solver, at
