"""The outcome of ``GraphSlam.process``: what one measurement changed."""

from dataclasses import dataclass

from graph_slam_ros.slam.bounded_map import Condensation
from graph_slam_ros.slam.calibration.answers import Fitted
from graph_slam_ros.slam.doubt.record import Doubt
from graph_slam_ros.slam.map_view import MapView
from graph_slam_ros.slam.robust.ledger import VerdictChange
from graph_slam_ros.slam.solution import Correction
from graph_slam_ros.solver import Report

_NO_CORRECTION = Correction()


@dataclass(frozen=True, slots=True)
class Update:
    """The changes that ``process`` made.

    Attributes
    ----------
    keyframes : indices of new ones
    edges : ids of new ones that the solver has
    solved : whether it solved
    report : of a solve of everything
    correction : of the last solve
    changes : of verdicts, since the last update that told any
    calibrated : factors of odometry that the association found
    alarms : that began, were decided or ended since then: the landmarks contradict odometry
    condensed : what left the map before anything else, when all that stays got new ids
    """

    keyframes: tuple[int, ...] = ()
    edges: range = range(0)
    solved: bool = False
    report: Report | None = None
    correction: Correction = _NO_CORRECTION
    changes: tuple[VerdictChange, ...] = ()
    alarms: tuple[Doubt, ...] = ()
    calibrated: tuple[Fitted, ...] = ()
    condensed: Condensation | None = None

    def __bool__(self) -> bool:
        return bool(self.keyframes) or self.solved or self.condensed is not None


class UpdateLog:
    """Makes each update from the difference to the previous one."""

    def __init__(self, view: MapView) -> None:
        self._view = view
        self._keyframes = self._edges = self._solves = 0
        self._report: Report | None = None
        self._changes = len(view.ledger.history)  # of verdicts, that updates have reported
        self._alarms, self._corrections = view.alarms, len(view.corrected)
        self._condensed: Condensation | None = None

    def begin(self, condensed: Condensation | None) -> None:
        """Begin the next update, before which something may have been condensed."""
        view, self._condensed = self._view, condensed
        if condensed is not None:
            self._changes = len(view.ledger.history)
        self._keyframes, self._edges = len(view.keyframes), view.backend.handed_over[1]
        self._solves, self._report = view.solves, view.report

    def update(self) -> Update:
        """The changes since ``begin``; of verdicts, alarms and factors, since the last update that told any."""
        view = self._view
        solved, keyframes = view.solves > self._solves, range(self._keyframes, len(view.keyframes))
        if not solved and not keyframes:
            return Update(condensed=self._condensed)
        changes, self._changes = tuple(view.ledger.history[self._changes :]), len(view.ledger.history)
        known, self._alarms = set(map(_state, self._alarms)), view.alarms
        calibrated, self._corrections = tuple(view.corrected[self._corrections :]), len(view.corrected)
        return Update(
            tuple(keyframes),
            range(self._edges, view.backend.handed_over[1]),
            solved,
            view.report if view.report is not self._report else None,
            view.correction if solved else _NO_CORRECTION,
            changes,
            tuple(one for one in self._alarms if _state(one) not in known),
            calibrated,
            self._condensed,
        )


def _state(alarm: Doubt) -> tuple[int, int | None, int | None, str]:
    """The part of an alarm that changes when it begins, is decided or ends."""
    return alarm.began_ns, alarm.segment, alarm.ended_ns, alarm.outcome
