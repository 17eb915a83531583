"""The solution: solves, and lets each policy look at what is solved; keeps its outcome, and the change of map -> odom.

What may change what was solved, in order. Each change is a ``Revision``, which ``Backend.apply`` does or undoes.

| policy | looks | what it may change |
|---|---|---|
| landmarks without identities | at each solve; all scans at 100, 200, 400 ... of them | whose sightings are whose |
| gates | at each solve | verdicts on edges |
| second look | where enough edges are out, in the background | verdicts on edges |
| odometry in doubt | at each solve | a segment begins, or odometry counts for less; taken back, too |
| noise | at 50, 100, 200 ... keyframes | how much edges count |
| trial fits | at the same keyframes, in the background | nothing: they say what is off |
| factors of odometry | where all scans were explained | what odometry and sightings measured |
| condensing | before a measurement, where nothing goes on | old keyframes become measurements of places |

While an alarm is not decided (``Backend.holds_back``), only what decides it changes the past. Besides these, the
failure guard takes out what nothing can be solved with, and a person what ``~/remove`` and ``~/clear_closures`` name.
"""

import math
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.errors import DivergedError
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.association.landmark_frontend import LandmarkFrontend
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.doubt.detector import OdometryDoubt
from graph_slam_ros.slam.failure_guard import FailureGuard
from graph_slam_ros.slam.found_factors import FoundFactors
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.trial_fits import TrialFits
from graph_slam_ros.solver import Report, Settings
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
    trials : say what is off; found_factors : factors of odometry that the association found
    solves : that succeeded
    report : of the last solve of everything
    correction : of the last solve
    vertices : those below this id were part of the last solve; 0 where it failed
    resting : observations at rest since the last solve
    """

    def __init__(
        self,
        backend: Backend,
        frontend: KeyframeFrontend,
        landmarks: LandmarkFrontend,
        doubt: OdometryDoubt,
        trials: TrialFits,
        found_factors: FoundFactors,
        counters: Counters,
    ) -> None:
        self._space, self._backend, self._frontend = frontend.config.space, backend, frontend
        self._landmarks, self._doubt = landmarks, doubt
        self.trials, self.found_factors = trials, found_factors
        self.guard = FailureGuard(backend, counters, landmarks.map)
        self.solves = 0
        self.report: Report | None = None
        self.correction = Correction()
        self.vertices = self.resting = 0
        self._edges = 0  # the last solve had those below this id
        self._keyframes = 0  # when the last solve was tried
        self._T_map_odom = self._space.identity  # by the last solve

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

    @property
    def is_due(self) -> bool:
        """Return whether enough is unsolved."""
        keyframes = len(self._backend.path.keyframes)
        waiting = keyframes - min(self._keyframes, keyframes) + self.resting
        return waiting >= self._frontend.config.solve.every_keyframes

    def solve(self, everything: Settings | None = None) -> None:
        """Solve the new part, or everything. After a failure, which is counted, the last estimate stays."""
        self._keyframes, self.resting, self.vertices = len(self._backend.path.keyframes), 0, 0
        solved = self.guard.solve(lambda: (self._fits(), self._revised(everything), self._covariance()))
        if solved is None:
            return
        fits, report, self._frontend.covariance = solved
        self.report = report or self.report
        self.solves += 1
        self.vertices, self._edges = self._backend.handed_over
        self._note_correction(fits)

    def _revised(self, everything: Settings | None) -> Report | None:
        """Solve, and let each policy look; return the report of a solve of everything."""
        backend, frontend, keyframes = self._backend, self._frontend, self._backend.path.keyframes
        self._doubt.add(backend.handed_over[1], frontend.now_ns)
        if self._landmarks.is_anonymous:
            self._landmarks.anonymous.review(everything=everything is not None)
        report = None
        if everything is None:
            backend.update()
            self._doubt.check(frontend.now_ns)
        else:
            self._doubt.rejoin(keyframes[-1].stamp_ns)
            report = backend.optimize(everything)
        if not backend.holds_back:
            report = backend.scale_noise(everything) or report
        self.trials.after_solve(is_of_everything=everything is not None)
        if not backend.holds_back:
            report = self.found_factors.after_solve(everything) or report
        return report

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
