"""The solution: the outcome of the last solve, and the change of map -> odom."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.errors import DivergedError
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.failure_guard import FailureGuard
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.solver import Report
from graph_slam_ros.typing import Array, Numbers

_BLAMED = 5  # edges that are named as the cause of a correction


@dataclass(frozen=True, slots=True)
class Correction:
    """The correction of a solve: the motion of map -> odom, and the new edges, odometry excepted, that caused it.

    Attributes
    ----------
    distance_m, angle_rad : of the robot's newest keyframe, the jump that a user sees
    edges : ids, the one that fitted least before first
    chi2 : of each, per number measured, before the solve
    """

    distance_m: float = 0.0
    angle_rad: float = 0.0
    edges: tuple[int, ...] = ()
    chi2: tuple[float, ...] = ()


class Solution:
    """The outcome of the last solve, and the unsolved additions since.

    Attributes
    ----------
    guard : keeps the estimate a good one where a solve fails
    solves : that succeeded
    report : of the last solve of everything
    correction : of the last solve
    vertices : those below this id were part of the last solve; 0 where it failed
    resting : observations at rest since the last solve
    """

    def __init__(self, space: Geometry, backend: Backend, guard: FailureGuard) -> None:
        self._space, self._backend, self.guard = space, backend, guard
        self.solves = 0
        self.report: Report | None = None
        self.correction = Correction()
        self.vertices = self.resting = 0
        self._edges = 0  # the last solve had those below this id
        self._keyframes = 0  # when the last solve was tried
        self._T_map_odom = space.identity  # by the last solve

    def pose(self, vertex: int) -> Numbers:
        """The present estimate of a pose."""
        return tuple(self._backend.solver.estimate([vertex])[0].tolist())

    @property
    def _newest(self) -> Keyframe:
        return self._backend.path.keyframes[-1]

    @property
    def T_map_odom(self) -> Numbers:
        """The correction of odometry's drift at the newest keyframe."""
        group, newest = self._space.group, self._newest
        out: Numbers = group.compose(self.pose(newest.vertex), group.inverse(newest.T_odom_base))
        return out

    def begin(self) -> None:
        """Begin the map with the present keyframes."""
        self._T_map_odom, self._keyframes = self.T_map_odom, len(self._backend.path.keyframes)

    def restore(self, report: Report) -> None:
        """Note that a loaded map was solved."""
        self.guard.note_good()
        self.report = report
        self.vertices, self._edges = self._backend.handed_over
        self.begin()

    def go_back(self) -> None:
        """Use the last good estimate, which does not include all edges."""
        self.guard.go_back()
        self.vertices = 0

    @property
    def is_whole(self) -> bool:
        """Return whether the last solve succeeded and has all of the graph."""
        return (self.vertices, self._edges) == self._backend.handed_over and self._backend.solver.is_current

    def solve_rest(self) -> None:
        """Solve a graph of which a part has left."""
        self.guard.note_good()
        self.vertices, self._edges = self._backend.handed_over
        self.guard.solve(self._backend.solver.update)

    def is_due(self, every_keyframes: int) -> bool:
        """Return whether enough is unsolved."""
        keyframes = len(self._backend.path.keyframes)
        return keyframes - min(self._keyframes, keyframes) + self.resting >= every_keyframes

    def solve(self, work: Callable[[], Report | None]) -> Array | None:
        """Solve by calling ``work``. Returns the covariance of the newest pose; None if it fails.

        A failure is counted, and the last estimate stays.

        Parameters
        ----------
        work : returns the report of a solve of everything
        """
        self._keyframes, self.resting, self.vertices = len(self._backend.path.keyframes), 0, 0
        solved = self.guard.solve(lambda: (self._fits(), work(), self._covariance()))
        if solved is None:
            return None
        fits, report, covariance = solved
        self.report = report or self.report
        self.solves += 1
        self.vertices, self._edges = self._backend.handed_over
        self._note_correction(fits)
        return covariance

    def _covariance(self) -> Array:
        (covariance,) = self._backend.solver.marginal([self._newest.vertex])
        if not np.isfinite(covariance).all():
            raise DivergedError("the covariance is not finite")
        return covariance

    def _fits(self) -> list[tuple[float, int]]:
        """Return (chi2 per degree of freedom, edge) of the new edges with the worst fit, which may move the map."""
        self._backend.hand_over()
        edges = self._backend.graph.edge_ids.since(self._edges).tolist()
        chi2, numbers = self._backend.solver.chi2_of(edges)
        fit = chi2 / numbers
        return [(float(fit[k]), edges[k]) for k in np.argsort(-fit, kind="stable")[:_BLAMED].tolist()]

    def _note_correction(self, fits: list[tuple[float, int]]) -> None:
        """Note the difference to the pose by the previous solve and its odometry."""
        group, newest = self._space.group, self._newest
        before, self._T_map_odom = self._T_map_odom, self.T_map_odom
        moved = group.between(group.compose(before, newest.T_odom_base), self.pose(newest.vertex))
        distance_m = math.hypot(*moved[: self._space.dimensions])
        chi2, edges = zip(*fits, strict=True) if fits else ((), ())
        self.correction = Correction(distance_m, float(self._space.angle(moved)), edges, chi2)
