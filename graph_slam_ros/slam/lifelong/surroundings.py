"""The edges on the keyframes of a visit, by what becomes of them when the visit is condensed."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from graph_slam_ros.graph import Edge
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.slam.lifelong.elimination import product, square_root, symmetric
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index, Numbers

CLOSURES, FIXES, LANDMARKS = "closures", "fixes", "landmarks"  # labels
CHAIN = "composed"  # label of edges that are composed of odometry


@dataclass(slots=True)
class Surroundings:
    """The edges that count on the keyframes of a visit, by id.

    Attributes
    ----------
    inside : between its keyframes; sightings : of landmarks
    into : from elsewhere to the first keyframe; onward : from the last one to the keyframe after the visit
    steps : of each keyframe but the last, the edge of odometry to the next
    factors : of ``inside`` and ``sightings``: how much each counts, by its weight and loss
    unfit : why these cannot be condensed; empty where they can
    """

    inside: dict[int, Edge] = field(default_factory=dict)
    sightings: dict[int, Edge] = field(default_factory=dict)
    into: dict[int, Edge] = field(default_factory=dict)
    onward: dict[int, Edge] = field(default_factory=dict)
    steps: list[Edge] = field(default_factory=list)
    factors: dict[int, float] = field(default_factory=dict)
    unfit: str = ""

    @property
    def own(self) -> list[int]:
        """The edges that are within the visit and its landmarks."""
        return [*self.inside, *self.sightings]

    @property
    def seen(self) -> set[int]:
        """The landmarks that are seen."""
        return {edge.vertices[1] for edge in self.sightings.values()}


def surroundings(space: Geometry, solver: Solver, visit: Sequence[int], after: int) -> Surroundings:
    """Return the edges on the keyframes of a visit.

    Parameters
    ----------
    visit : vertices of its keyframes, in order of time; after : the keyframe that follows
    """
    graph, out = solver.graph, Surroundings()
    on_it = sorted({int(edge) for vertex in visit for edge in solver.edges_on(vertex)})
    edges = {number: edge for number in on_it if (edge := graph.edge(number)).weight}
    members = set(visit)
    for number, edge in edges.items():
        first, last = edge.vertices[0], edge.vertices[-1]
        if len(edge.vertices) == 2 and (edge.label == LANDMARKS or graph.kind_of(last) is space.point):
            out.sightings[number] = edge
        elif edge.type is space.relative_pose:
            if members >= {first, last}:
                out.inside[number] = edge
            elif edge.label != CLOSURES and (first, last) == (visit[-1], after):
                out.onward[number] = edge
            elif edge.label != CLOSURES and last == visit[0] and first not in members:
                out.into[number] = edge
            else:
                out.unfit = f"edge {number} leads from the visit to vertex {last if first in members else first}"
        else:
            out.unfit = f"edge {number} is a {edge.type.name}"
    by_ends = {edge.vertices: edge for edge in reversed(out.inside.values()) if edge.label != CLOSURES}
    out.steps = [by_ends[ends] for ends in pairwise(visit) if ends in by_ends]
    if len(out.steps) < len(visit) - 1 or len(out.onward) != 1 or len(out.into) > 1:
        out.unfit = out.unfit or "odometry does not join its keyframes one by one"
    out.factors = _factors(solver, {**out.inside, **out.sightings})
    return out


def seen_from(space: Geometry, solver: Solver, keyframes: Index) -> list[set[int] | None]:
    """Return the landmarks that are seen from each keyframe, by vertices; None for one that cannot be condensed.

    One can be if it is free, with edges of odometry, sightings, closures and fixes alone. One that is not free is of a
    frozen map, or of a map that the robot is located in.
    """
    graph = solver.graph
    held = np.isin(keyframes, solver.held).tolist()
    out: list[set[int] | None] = [None if is_held else set() for is_held in held]
    is_point = np.array([kind is space.point for kind in graph.kinds])
    row_of = np.full(graph.vertex_count, -1)
    row_of[keyframes] = np.arange(len(keyframes))
    edges, codes = solver.edges, graph.table_of_edge.values[solver.edges]
    for code, table in enumerate(graph.tables.values()):
        rows = graph.row_of_edge.values[edges[codes == code]]
        ends, numbers = table.vertices.values[rows], table.id.values[rows]
        is_fit = graph.has_label(numbers, (CLOSURES, FIXES))
        if table.type is space.relative_pose:
            is_fit |= graph.has_label(numbers, ("odometry", CHAIN))
        if ends.shape[1] == 2:
            is_seen = graph.has_label(numbers, (LANDMARKS,)) | is_point[graph.kind.values[ends[:, 1]]]
            is_fit |= is_seen
            for row, mark in zip(row_of[ends[is_seen, 0]].tolist(), ends[is_seen, 1].tolist(), strict=True):
                if row >= 0 and (of_row := out[row]) is not None:
                    of_row.add(mark)
        for row in row_of[ends[~is_fit]].ravel().tolist():
            if row >= 0:
                out[row] = None
    return out


def composed(space: Geometry, edges: Sequence[Edge]) -> tuple[Numbers, Array]:
    """Return odometry, one edge after the other, as one relative pose, and the square root of its information."""
    pose, covariance = space.identity, np.zeros((space.dof, space.dof))
    for edge in edges:
        step: Numbers = tuple(edge.measured.tolist())
        information = edge.weight * product(edge.sqrt_information.T, edge.sqrt_information)
        covariance = space.group.propagate(covariance, step, _inverse(information))
        pose = tuple(map(float, space.group.compose(pose, step)))
    return space.normalized(pose), square_root(symmetric(_inverse(covariance)))


def _inverse(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _factors(solver: Solver, edges: dict[int, Edge]) -> dict[int, float]:
    chi2, _ = solver.chi2_of(list(edges))
    out = {}
    for (number, edge), one in zip(edges.items(), chi2.tolist(), strict=True):
        loss = solver.settings.last_loss(edge.label, edge.source)
        out[number] = edge.weight * float(weight_and_cost(loss.kind, loss.scale, edge.weight * one)[0])
    return out
