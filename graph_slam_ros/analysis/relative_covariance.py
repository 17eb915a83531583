"""Covariances of a saved run as seen from one or two of its keyframes.

A run's covariances are relative to its first pose. Where the truth begins later, or has no heading, errors are compared
in another frame: that of a later keyframe, or of the line between two positions. What an estimate has in common with
that frame is no error there. It is known from joint covariances of the graph.
"""

from collections.abc import Iterable

import numpy as np

from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.lie import so3
from graph_slam_ros.typing import Array, Numbers


class RelativeCovariances:
    """Covariances in the frame of a keyframe, or in the plane of the line from one keyframe's position to another's.

    Parameters
    ----------
    frame : numbers of the keyframes: one, or two in the plane

    Raises
    ------
    GaugeError, SingularError
        From its functions, as of ``Solver.joint_marginal``.
    """

    def __init__(self, saved: SavedGraph, frame: tuple[int, ...]) -> None:
        self._saved, self._space = saved, saved.space
        self._frame = [saved.vertices[k] for k in frame]
        self._at = [self._value(vertex) for vertex in self._frame]

    def poses(self, keyframes: Iterable[int]) -> Array:
        """Covariances (n, d, d) of poses in the frame of one keyframe, each in its own tangent space; its own is 0."""
        group, d = self._space.group, self._space.dof
        out = []
        for vertex in (self._saved.vertices[k] for k in keyframes):
            by_frame = -group.adjoint(group.between(self._value(vertex), self._at[0]))
            out.append(self._combined(vertex, by_frame, np.eye(d), np.zeros((d, d))))
        return np.array(out).reshape(-1, d, d)

    def positions(self, keyframes: Iterable[int]) -> Array:
        """Covariances (n, dimensions, dimensions) of the positions of keyframes, in the axes of map."""
        return self._points(self._saved.vertices[k] for k in keyframes)

    def landmarks(self, names: Iterable[str]) -> Array:
        """Covariances (m, dimensions, dimensions) of landmarks' positions in the axes of map; NaN where unknown."""
        return self._points(self._saved.landmarks.get(name) for name in names)

    def _points(self, vertices: Iterable[int | None]) -> Array:
        n = self._space.dimensions
        unknown = np.full((n, n), np.nan)
        out = [unknown if vertex is None else self._point(vertex) for vertex in vertices]
        return np.array(out).reshape(-1, n, n)

    def _point(self, vertex: int) -> Array:
        value, n = self._value(vertex), self._space.dimensions
        of_point = np.eye(n) if len(value) == n else self._by_position(value)
        by_frame = self._by_line(value) if len(self._frame) == 2 else self._by_pose(value)
        return self._combined(vertex, by_frame, of_point, np.zeros((n, n)))

    def _by_pose(self, point: Numbers) -> Array:
        """Jacobian of a point, seen from the frame, by the tangent space of the pose that is the frame."""
        n, pose = self._space.dimensions, self._at[0]
        turn = self._space.turn(pose)
        seen = turn.T @ np.subtract(point[:n], pose[:n])
        lever = _across(seen)[:, None] if n == 2 else -so3.hat((seen[0], seen[1], seen[2]))
        return np.asarray(-turn @ np.hstack([np.eye(n), lever]))

    def _by_line(self, point: Numbers) -> Array:
        """Jacobian of a point, seen from the line, by the tangent spaces of the poses at its ends."""
        first, last = self._at
        line, arm = np.subtract(last[:2], first[:2]), np.subtract(point[:2], first[:2])
        turned = np.outer(_across(arm), _across(line)) / (line @ line)
        return np.hstack([(turned - np.eye(2)) @ self._by_position(first), -turned @ self._by_position(last)])

    def _by_position(self, pose: Numbers) -> Array:
        """Jacobian of the position of a pose by its tangent space."""
        n = self._space.dimensions
        return np.hstack([self._space.turn(pose), np.zeros((n, self._space.dof - n))])

    def _combined(self, vertex: int, by_frame: Array, by_own: Array, of_frame: Array) -> Array:
        """The covariance of a linear function of the frame's tangent spaces and a vertex'; ``of_frame`` of its own."""
        if vertex in self._frame:
            return of_frame
        both = np.hstack([by_frame, by_own])
        return both @ self._saved.solver.joint_marginal([*self._frame, vertex]) @ both.T

    def _value(self, vertex: int) -> Numbers:
        return tuple(map(float, self._saved.solver.estimate([vertex])[0]))


def _across(arm: Array) -> Array:
    return np.array([-arm[1], arm[0]])
