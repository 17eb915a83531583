"""Graphs in GTSAM's words, for its incremental and its batch solvers alike.

Poses are keys 0, 1, ...; a landmark is the symbol ``l`` with its index. GTSAM has the rotation before the position in
the tangent space of a pose in space, we after it.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import gtsam
import numpy as np

from benchmarks.problem import Array, Edges, Problem, polar, triangular

_ANCHOR = 1e-3  # sigma [m, rad] of the prior on the first pose, which fixes the gauge and is met exactly
_ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])

Loss: TypeAlias = gtsam.noiseModel.mEstimator.Base


def landmark(index: int) -> int:
    """The key of a landmark."""
    return gtsam.symbol("l", index)


def pose(values: Sequence[float] | Array) -> gtsam.Pose2 | gtsam.Pose3:
    """From (3,) or (7,) numbers."""
    if len(values) == 3:
        return gtsam.Pose2(*values)
    x, y, z, w = values[3:]
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), np.asarray(values[:3]))


def numbers(of: gtsam.Pose2 | gtsam.Pose3) -> Array:
    """The (3,) or (7,) numbers of a pose."""
    if isinstance(of, gtsam.Pose2):
        return np.array([of.x(), of.y(), of.theta()])
    q = of.rotation().toQuaternion()
    return np.array([*of.translation(), q.x(), q.y(), q.z(), q.w()])


def prepared(problem: Problem) -> Problem:
    """Landmarks by bearing and range, and relative poses as GTSAM takes them."""
    return replace(problem, relative=prepared_edges(problem.relative), sightings=polar(problem.sightings))


def prepared_edges(relative: Edges) -> Edges:
    """Relative poses with the noise of those in space in GTSAM's order, triangular again."""
    if relative.measured.shape[1] == 3:
        return relative
    return replace(relative, root=triangular(relative.root[:, :, _ROTATION_FIRST]))


def graph_of(
    given: Problem, candidates: Edges | None = None, loss: Loss | None = None
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A prepared problem, with more relative poses; these and the sightings under a loss where one is given."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, at in enumerate(given.poses.tolist()):
        values.insert(k, pose(at))
    for k, point in enumerate(given.landmarks):
        values.insert(landmark(k), point)
    add_anchor(graph, given.poses[0])
    add_relative(graph, given.relative)
    if candidates is not None:
        add_relative(graph, candidates, loss)
    add_sightings(graph, given.sightings, loss)
    return graph, values


def add_anchor(graph: gtsam.NonlinearFactorGraph, at: Array) -> None:
    """A prior on the first pose."""
    prior, dof = (gtsam.PriorFactorPose2, 3) if len(at) == 3 else (gtsam.PriorFactorPose3, 6)
    graph.add(prior(0, pose(at), gtsam.noiseModel.Isotropic.Sigma(dof, _ANCHOR)))


def add_relative(graph: gtsam.NonlinearFactorGraph, relative: Edges, loss: Loss | None = None) -> None:
    """Relative poses of a prepared problem, all under a robust loss where one is given."""
    between = gtsam.BetweenFactorPose2 if relative.measured.shape[1] == 3 else gtsam.BetweenFactorPose3
    for (i, j), measured, root in zip(relative.ends.tolist(), relative.measured.tolist(), relative.root, strict=True):
        graph.add(between(i, j, pose(measured), _noise(root, loss)))


def add_sightings(graph: gtsam.NonlinearFactorGraph, seen: Edges, loss: Loss | None = None) -> None:
    """Sightings of a prepared problem, as ``add_relative``."""
    for (i, j), (bearing, distance), root in zip(seen.ends.tolist(), seen.measured.tolist(), seen.root, strict=True):
        graph.add(gtsam.BearingRangeFactor2D(i, landmark(j), gtsam.Rot2(bearing), distance, _noise(root, loss)))


def _noise(root: Array, loss: Loss | None) -> gtsam.noiseModel.Base:
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(root)
    return noise if loss is None else gtsam.noiseModel.Robust.Create(loss, noise)


def estimate(values: gtsam.Values, poses: int, landmarks: int, planar: bool) -> tuple[Array, Array]:
    """Poses and landmarks as our arrays."""
    at = values.atPose2 if planar else values.atPose3
    points = [values.atPoint2(landmark(j)) for j in range(landmarks)]
    return np.array([numbers(at(k)) for k in range(poses)]), np.array(points).reshape(-1, 2)


def thrown(error: Exception) -> str:
    """The first line of what GTSAM throws."""
    return f"throws: {str(error).strip().splitlines()[0]}"
