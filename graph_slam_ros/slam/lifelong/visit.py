"""A visit: a stretch of keyframes at one place, and what it measured of the landmarks, as one joint Gaussian."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np
from numpy.typing import ArrayLike

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import Edge, EdgeType, Gaussian, Graph
from graph_slam_ros.graph.geometry import Geometry, rigid_motions
from graph_slam_ros.slam.levels import SINGULAR
from graph_slam_ros.slam.lifelong.constellation import Constellation
from graph_slam_ros.slam.lifelong.elimination import marginal_information
from graph_slam_ros.slam.lifelong.place import Place
from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.typing import Array

_SETTINGS = replace(Settings(), step_tolerance=1e-10, cost_tolerance=0.0)
_ONE_STEP = replace(Settings(), max_iterations=1, cost_tolerance=np.inf)
Estimate = Callable[[ArrayLike], Array]


def visit_of(
    space: Geometry, graph: Graph, estimate: Estimate, poses: Sequence[int], base: int, edges: Mapping[int, float]
) -> tuple[Place, float, int]:
    """Return what some edges say of the landmarks on them, in the axes of one pose; chi2 and degrees of freedom, too.

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
    marks = _marks(space, graph, ends.values(), poses)
    while marks:
        order = [base, *(v for v in poses if v != base), *marks]
        known = set(order)
        inside = [edge for edge in ends if known.issuperset(ends[edge])]
        counting = [(records[edge], edges[edge]) for edge in inside]
        solver, at = _local_solver(space, graph, estimate, order, counting)
        solver.hold(at[base])
        information, sizes = solver.information_matrix(), [graph.kind_of(mark).dof for mark in marks]
        begins = (len(information) - np.cumsum(sizes[::-1])[::-1]).tolist()
        whole = {ends[e][1] for e in inside if records[e].type.residual_size >= graph.kind_of(ends[e][1]).dof}
        if not whole.issuperset(marks):
            blocks = [information[low : low + n, low : low + n] for low, n in zip(begins, sizes, strict=True)]
            sure = [_is_sure(block) for block in blocks]
            if not all(sure):
                marks = [mark for mark, is_sure in zip(marks, sure, strict=True) if is_sure]
                continue
        marginal = marginal_information(information, np.arange(begins[0], len(information)))
        numbers = [at[mark] for mark in marks]
        linearized_at = _constellation(space, solver, numbers)
        try:
            solver.optimize(_ONE_STEP)
            seen = _constellation(space, solver, numbers)
            chi2, degrees = solver.optimize().chi2_final, solver.degrees_of_freedom
        except SingularError as error:  # at the own optimum of bearings a landmark may be at infinity
            if error.vertex is None or order[error.vertex] not in marks:
                raise
            marks = [mark for mark in marks if mark != order[error.vertex]]
            continue
        information = _of_positions(space, marginal, linearized_at)
        return Place(tuple(marks), seen, linearized_at, information), chi2, degrees
    raise SingularError("the visit determines no landmark")


def best_known(
    space: Geometry, graph: Graph, estimate: Estimate, poses: Sequence[int], edges: Mapping[int, float]
) -> int:
    """Return which pose of a visit, counted from 0, knows best where the landmarks that it sees are, all of them.

    Parameters are those of ``visit_of``.

    Raises
    ------
    SingularError
        They do not determine them.
    """
    records = [(graph.edge(edge), edges[edge]) for edge in sorted(edges)]
    marks = _marks(space, graph, (edge.vertices for edge, _ in records), poses)
    if not marks:
        raise SingularError("the visit sees no landmark")
    solver, at = _local_solver(space, graph, estimate, [*poses, *marks], records)
    for mark in marks:
        solver.hold(at[mark])
    solver.update()
    there, spreads = _constellation(space, solver, [at[mark] for mark in marks]), list[float]()
    ids = range(len(poses))
    for pose, covariance in zip(solver.estimate(ids).tolist(), solver.marginal(ids), strict=True):
        columns = rigid_motions(there.moved(space, space.group.inverse(tuple(pose))).points)
        spreads.append(float(np.einsum("ni,ij,nj->", columns, covariance, columns, optimize=False)))
    return int(np.argmin(spreads))


def _is_sure(information: Array) -> bool:
    """Return whether the information of a landmark, given the poses, is of full rank."""
    scale = np.sqrt(np.diag(information))
    return bool(scale.all()) and float(np.linalg.eigvalsh(information / np.outer(scale, scale))[0]) > SINGULAR


def _marks(space: Geometry, graph: Graph, ends: Iterable[Sequence[int]], poses: Sequence[int]) -> list[int]:
    """Return the landmarks on some edges: points, ascending, and then poses, ascending."""
    marks = {v for vertices in ends for v in vertices} - set(poses)
    return sorted(marks, key=lambda mark: (graph.kind_of(mark) is space.pose, mark))


def _constellation(space: Geometry, solver: Solver, marks: Sequence[int]) -> Constellation:
    """Return how some landmarks lie: points, and then poses."""
    points = [mark for mark in marks if solver.graph.kind_of(mark) is space.point]
    poses = solver.estimate(marks[len(points) :]).reshape(-1, space.pose.size)
    return Constellation.from_poses(space, solver.estimate(points), poses)


def _of_positions(space: Geometry, information: Array, at: Constellation) -> Array:
    """Return the information (n, n) of a step of a constellation, given that of steps of its vertices.

    Those of vertices that are poses are in their own axes, position and rotation side by side.
    """
    b, d = len(at.turns), space.dimensions
    first, turn = d * (len(at.points) - b), np.eye(len(information))
    order = list(range(first))
    for k, rotation in enumerate(at.turns.tolist()):
        begin = first + space.dof * k
        turn[begin : begin + d, begin : begin + d] = space.turn((*space.identity[:d], *rotation))
        order += range(begin, begin + d)
    order += [first + space.dof * k + axis for k in range(b) for axis in range(d, space.dof)]
    if not b:
        return information
    return (turn @ information @ turn.T)[np.ix_(order, order)]


def _local_solver(
    space: Geometry, graph: Graph, estimate: Estimate, order: Sequence[int], edges: Sequence[tuple[Edge, float]]
) -> tuple[Solver, dict[int, int]]:
    """Return a solver of some edges alone, each with its factor, and the ids that it has of some vertices.

    Parameters
    ----------
    order : the vertices, in the axes of the first, which is a pose
    """
    local, group = Graph(), space.group
    base = tuple(estimate(order[:1])[0].tolist())
    for kind, alike in groupby(order, graph.kind_of):
        values = tuple(estimate(list(alike)).T)
        seen = group.between(base, values) if kind is space.pose else group.act(group.inverse(base), values)
        local.add_vertices(kind, np.stack(seen, axis=-1))
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
