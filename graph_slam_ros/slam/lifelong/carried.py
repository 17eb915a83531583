"""Closures and fixes of keyframes that leave the map, carried to the base of their place.

A motion between base and keyframe is added to what was measured, with its covariance. A carried closure is a closure
still: it is judged as a whole, and can be doubted. Fixes of one base add up to a single prior.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph import Edge
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.lifelong.elimination import product, quadratic, square_root, symmetric
from graph_slam_ros.slam.lifelong.surroundings import Motion, chained
from graph_slam_ros.solver import Solver
from graph_slam_ros.solver.linearization import linearized
from graph_slam_ros.typing import Array, Numbers

_UNKNOWN = 1e-12  # part of the largest eigenvalue of a prior below which a direction is not known


@dataclass(frozen=True, slots=True)
class Carried:
    """An edge to add in place of others."""

    vertices: tuple[int, ...]
    measured: Numbers
    root: Array
    label: str
    source: str
    replaces: int | None = None


def inverse(space: Geometry, motion: Motion) -> Motion:
    """Return the motion back."""
    pose, covariance = motion
    turn = space.group.adjoint(pose)
    return tuple(map(float, space.group.inverse(pose))), product(product(turn, covariance), turn.T)


def motions_from(space: Geometry, visit: Sequence[int], legs: Sequence[Motion], k: int) -> dict[int, Motion]:
    """Return the motion to each keyframe of a visit from keyframe ``k`` of it, by odometry alone.

    Parameters
    ----------
    legs : from each keyframe but the last to the next
    """
    nothing = space.identity, np.zeros((space.dof, space.dof))
    out: dict[int, Motion] = {visit[k]: nothing}
    for n in range(k + 1, len(visit)):
        out[visit[n]] = chained(space, [*legs[k:n]])
    for n in range(k):
        out[visit[n]] = inverse(space, chained(space, [*legs[n:k]]))
    return out


def carried_closure(space: Geometry, edge: Edge, base: int, motions: Mapping[int, Motion], weight: float) -> Carried:
    """Return a closure of a keyframe, or odometry to it, as one of its base.

    Parameters
    ----------
    motions : from the base to each keyframe of the visit; weight : by which its information counts
    """
    first, last = edge.vertices
    information = weight * product(edge.sqrt_information.T, edge.sqrt_information)
    measured: Motion = tuple(edge.measured.tolist()), inverted(information)
    if first in motions:
        whole, ends = chained(space, [motions[first], measured]), (base, last)
    else:
        whole, ends = chained(space, [measured, inverse(space, motions[last])]), (first, base)
    return Carried(ends, whole[0], square_root(symmetric(inverted(whole[1]))), edge.label, edge.source)


def fused_closure(space: Geometry, one: Carried, several: Sequence[Edge], gate: float) -> Carried | None:
    """Return a carried closure together with the first of some others between its two vertices that it agrees with."""
    for edge in several:
        motion: Motion = one.measured, inverted(product(one.root.T, one.root))
        if edge.vertices != one.vertices:
            motion = inverse(space, motion)
        before = edge.weight * product(edge.sqrt_information.T, edge.sqrt_information)
        both = fused_motion(space, (tuple(edge.measured.tolist()), inverted(before)), motion, gate)
        if both is not None:
            root = square_root(symmetric(inverted(both[1])))
            return Carried(edge.vertices, both[0], root, edge.label, one.source, edge.id)
    return None


def fused_motion(space: Geometry, one: Motion, other: Motion, gate: float) -> Motion | None:
    """Return two independent measurements of one motion as one; None if they do not agree.

    Parameters
    ----------
    gate : quantile of chi2 above which they do not
    """
    group, (pose, covariance), (seen, added) = space.group, one, other
    off = np.array(group.log(group.between(pose, seen)))
    if quadratic(symmetric(inverted(covariance + added)), off) > quantile(gate, space.dof):
        return None
    information = symmetric(inverted(added))
    both = symmetric(symmetric(inverted(covariance)) + information)
    step = np.linalg.solve(both, product(information, off))
    return space.normalized(tuple(map(float, group.compose(pose, group.exp(tuple(step)))))), symmetric(inverted(both))


def carried_fixes(
    space: Geometry,
    solver: Solver,
    base: int,
    fixes: Mapping[int, Edge],
    factors: Mapping[int, float],
    motions: Mapping[int, Motion],
    prior: Edge | None,
) -> Carried:
    """Return all fixes of a visit, and the prior that their base has already, as one prior.

    Parameters
    ----------
    factors : by which each fix counts; motions : from the base to each keyframe of the visit
    """
    values, group = solver.values, space.group
    (at,) = solver.estimate([base])
    normal, right = np.zeros((space.dof, space.dof)), np.zeros(space.dof)
    for number, edge in fixes.items():
        pose, covariance = motions[edge.vertices[0]]
        residual, jacobian = linearized(solver.graph, values, edge.type, edge.vertices, edge.measured)
        noise = inverted(factors[number] * product(edge.sqrt_information.T, edge.sqrt_information))
        noise += product(product(jacobian, covariance), jacobian.T)
        of_base = product(jacobian, group.adjoint(group.inverse(pose)))
        weighted = product(inverted(noise), of_base)
        normal, right = normal + product(of_base.T, weighted), right + product(weighted.T, residual)
    if prior is not None:
        residual, jacobian = linearized(solver.graph, values, prior.type, prior.vertices, prior.measured)
        white, off = product(prior.sqrt_information, jacobian), product(prior.sqrt_information, residual)
        normal, right = normal + product(white.T, white), right + product(white.T, off)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    size, axes = np.linalg.eigh(symmetric(normal / np.outer(scale, scale)))
    known = size > _UNKNOWN * size[-1]
    root = np.where(known, np.sqrt(np.maximum(size, 0.0)), 0.0)[:, None] * axes.T * scale
    along = product(axes.T, right / scale)
    step = -product(axes, np.where(known, along / np.where(known, size, 1.0), 0.0)) / scale
    measured = space.normalized(tuple(map(float, group.compose(tuple(at.tolist()), group.exp(tuple(step))))))
    source = next(iter(fixes.values())).source
    return Carried((base,), measured, root, "fixes", source, prior.id if prior is not None else None)


def inverted(matrix: Array) -> Array:
    """Return the inverse of a matrix."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)
