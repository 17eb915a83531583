"""What may change what was solved, in order. Each change is a ``Revision``, which ``Backend.apply`` does or undoes.

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

from graph_slam_ros.slam.association.landmark_frontend import LandmarkFrontend
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.bounded_map import BoundedMap, Condensation
from graph_slam_ros.slam.doubt.detector import OdometryDoubt
from graph_slam_ros.slam.found_factors import FoundFactors
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.solution import Solution
from graph_slam_ros.slam.trial_fits import TrialFits
from graph_slam_ros.solver import Report, Settings


class Policies:
    """Solves, and lets each policy look at what is solved."""

    def __init__(
        self,
        backend: Backend,
        frontend: KeyframeFrontend,
        landmarks: LandmarkFrontend,
        doubt: OdometryDoubt,
        trials: TrialFits,
        factors: FoundFactors,
        bounded: BoundedMap,
        solution: Solution,
    ) -> None:
        self._backend, self._frontend, self._landmarks, self._doubt = backend, frontend, landmarks, doubt
        self._trials, self._factors, self._bounded, self._solution = trials, factors, bounded, solution

    def solve(self, everything: Settings | None) -> Report | None:
        """Solve what is new, or everything; returns the report of a solve of everything."""
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
        self._trials.after_solve(is_of_everything=everything is not None)
        if not backend.holds_back:
            report = self._factors.after_solve(everything) or report
        return report

    def condense(self) -> Condensation | None:
        """Condense what has left the window, if that is due; returns what has left the map.

        It waits until all is judged and solved, and nothing goes on that could change a verdict.
        """
        if not self._bounded.is_due:
            return None
        is_quiet = self._backend.is_quiet and self._doubt.now is None and self._solution.is_whole
        return self._bounded.condense() if is_quiet else None
