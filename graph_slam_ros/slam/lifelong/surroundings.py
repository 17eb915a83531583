"""The edges on the keyframes of a visit, by what becomes of them when the visit is condensed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from graph_slam_ros.graph import Edge, Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.slam.lifelong.elimination import product
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index, Mask, Numbers

CLOSURES, FIXES, LANDMARKS = "closures", "fixes", "landmarks"  # labels
CHAIN = "composed"  # label of edges that are composed of odometry
Motion = tuple[Numbers, Array]
"""A relative pose and its covariance (dof, dof) in the tangent space at its end."""


@dataclass(slots=True)
class Surroundings:
    """The edges that count on the keyframes of a visit, by id.

    Attributes
    ----------
    inside : between its keyframes; sightings : of landmarks
    into : from elsewhere to the first keyframe; onward : from the last one to the keyframe after the visit
    steps : of each keyframe but the last, the edge of odometry to the next
    closures : from a keyframe to one elsewhere; fixes : of one keyframe
    factors : of ``inside``, ``sightings``, ``closures`` and ``fixes``: how much each counts, by its weight and loss
    unfit : why these cannot be condensed; empty where they can
    """

    inside: dict[int, Edge] = field(default_factory=dict)
    sightings: dict[int, Edge] = field(default_factory=dict)
    into: dict[int, Edge] = field(default_factory=dict)
    onward: dict[int, Edge] = field(default_factory=dict)
    steps: list[Edge] = field(default_factory=list)
    closures: dict[int, Edge] = field(default_factory=dict)
    fixes: dict[int, Edge] = field(default_factory=dict)
    factors: dict[int, float] = field(default_factory=dict)
    unfit: str = ""

    @property
    def all(self) -> list[int]:
        """All of them, in order of id."""
        return sorted({*self.inside, *self.sightings, *self.into, *self.onward, *self.closures, *self.fixes})

    @property
    def closures_and_fixes(self) -> dict[int, Edge]:
        """All edges that are closures, also within the visit, or fixes."""
        inside = {number: edge for number, edge in self.inside.items() if edge.label == CLOSURES}
        return inside | self.closures | self.fixes

    @property
    def local(self) -> dict[int, float]:
        """The factors of the edges that are within the visit and its landmarks."""
        return {number: self.factors[number] for number in (*self.inside, *self.sightings)}


def surroundings(space: Geometry, solver: Solver, visit: Sequence[int], after: int) -> Surroundings:
    """Return the edges on the keyframes of a visit.

    Parameters
    ----------
    visit : vertices of its keyframes, in order of time; after : the keyframe that follows
    """
    graph, out = solver.graph, Surroundings()
    on_it = sorted({int(edge) for vertex in visit for edge in solver.edges_on(vertex)})
    edges = {number: edge for number in on_it if (edge := graph.edge(number)).weight}
    members, seen = set(visit), _sightings(space, graph, on_it)
    for number, edge in edges.items():
        first, last = edge.vertices[0], edge.vertices[-1]
        if edge.label == CLOSURES and not members >= {first, last}:
            out.closures[number] = edge
        elif edge.label == FIXES:
            out.fixes[number] = edge
        elif number in seen:
            out.sightings[number] = edge
        elif edge.type is space.relative_pose:
            if members >= {first, last}:
                out.inside[number] = edge
            elif (first, last) == (visit[-1], after):
                out.onward[number] = edge
            elif last == visit[0] and first not in members:
                out.into[number] = edge
            else:
                out.unfit = f"edge {number} leads from the visit to vertex {last if first in members else first}"
        else:
            out.unfit = f"edge {number} is a {edge.type.name}"
    by_ends = {edge.vertices: edge for edge in reversed(out.inside.values()) if edge.label != CLOSURES}
    out.steps = [by_ends[ends] for ends in pairwise(visit) if ends in by_ends]
    if len(out.steps) < len(visit) - 1 or len(out.onward) != 1:
        out.unfit = out.unfit or "odometry does not join its keyframes one by one"
    out.factors = _factors(solver, {**out.inside, **out.sightings, **out.closures, **out.fixes})
    return out


def seen_from(space: Geometry, solver: Solver, keyframes: Index) -> list[set[int] | None]:
    """Return the landmarks that are seen from each keyframe, by vertices; None for one that cannot be condensed.

    One can be if it is free, with edges of odometry, sightings, closures and fixes alone. One that is not free is of a
    frozen map, or of a map that the robot is located in.
    """
    graph = solver.graph
    held = np.isin(keyframes, solver.held).tolist()
    out: list[set[int] | None] = [None if is_held else set() for is_held in held]
    row_of = np.full(graph.vertex_count, -1)
    row_of[keyframes] = np.arange(len(keyframes))
    for table, rows in _tables_of(graph, solver.edges):
        ends, numbers = table.vertices.values[rows], table.id.values[rows]
        is_fit = graph.has_label(numbers, (CLOSURES, FIXES))
        if table.type is space.relative_pose:
            is_fit |= graph.has_label(numbers, ("odometry", CHAIN))
        if ends.shape[1] == 2:
            is_seen = _is_sighting(space, graph, ends, numbers)
            is_fit |= is_seen
            for row, mark in zip(row_of[ends[is_seen, 0]].tolist(), ends[is_seen, 1].tolist(), strict=True):
                if row >= 0 and (of_row := out[row]) is not None:
                    of_row.add(mark)
        for row in row_of[ends[~is_fit]].ravel().tolist():
            if row >= 0:
                out[row] = None
    return out


def _tables_of(graph: Graph, edges: Index) -> Iterator[tuple[EdgeTable, Index]]:
    """Yield each table with its rows that these edges have."""
    for code, table in enumerate(graph.tables.values()):
        yield table, graph.row_of_edge.values[edges[graph.table_of_edge.values[edges] == code]]


def _is_sighting(space: Geometry, graph: Graph, ends: Index, edges: Index) -> Mask:
    """Return which edges (n) with two ends (n, 2) are of a keyframe and a landmark: a point, or a seen pose."""
    is_point = np.array([kind is space.point for kind in graph.kinds])
    return graph.has_label(edges, (LANDMARKS,)) | is_point[graph.kind.values[ends[:, 1]]]


def _sightings(space: Geometry, graph: Graph, edges: Sequence[int]) -> set[int]:
    out = set[int]()
    for table, rows in _tables_of(graph, np.array(edges, dtype=np.int64)):
        ends, numbers = table.vertices.values[rows], table.id.values[rows]
        if ends.shape[1] == 2:
            out.update(numbers[_is_sighting(space, graph, ends, numbers)].tolist())
    return out


def motion_of(edge: Edge, factor: float | None = None) -> Motion:
    """Return what an edge of odometry measured, with its information times a factor, by default its weight."""
    information = product(edge.sqrt_information.T, edge.sqrt_information) * (edge.weight if factor is None else factor)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return tuple(edge.measured.tolist()), covariance


def chained(space: Geometry, motions: Sequence[Motion]) -> Motion:
    """Return motions one after the other as one."""
    pose, covariance = motions[0]
    for step, added in motions[1:]:
        pose = tuple(map(float, space.group.compose(pose, step)))
        covariance = space.group.propagate(covariance, step, added)
    return space.normalized(pose), 0.5 * (covariance + covariance.T)


def _factors(solver: Solver, edges: dict[int, Edge]) -> dict[int, float]:
    chi2, _ = solver.chi2_of(list(edges))
    out = {}
    for (number, edge), one in zip(edges.items(), chi2.tolist(), strict=True):
        loss = solver.settings.last_loss(edge.label, edge.source)
        out[number] = edge.weight * float(weight_and_cost(loss.kind, loss.scale, edge.weight * one)[0])
    return out
