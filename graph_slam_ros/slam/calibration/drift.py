"""Parameters that change on the way: constant in each window of the drive, and a random walk from one to the next.

A trial corrects what was measured in the newest window only. Its prior is what is left of the last one: the sigma of
its last trial, the value that was not used, and what the parameter may have changed since.
"""

import math

from graph_slam_ros.slam.calibration.decision import Finding
from graph_slam_ros.slam.calibration.parameters import Parameter
from graph_slam_ros.typing import Index

WINDOW = 200  # keyframes
_HOUR_NS = 3_600_000_000_000


class DriftWindows:
    """The windows so far, of which the newest may be corrected.

    Parameters
    ----------
    rate : change in an hour, in parts of the configured prior's sigma; 0: all of the drive is one window
    first_edge, first_keyframe : edges and keyframes before are of another drive

    Attributes
    ----------
    first_edge : the first of the newest window
    closed : first keyframe of each window before, with its settings
    """

    def __init__(self, rate: float, first_edge: int, first_keyframe: int = 0) -> None:
        self.rate, self.first_edge = rate, first_edge
        self.closed: list[tuple[int, dict[str, float | str]]] = []
        self._first_keyframe, self._before_ns = first_keyframe, 0  # of the newest window; where the one before began
        self._left: dict[Parameter, float] = {}

    @property
    def drifts(self) -> bool:
        """Return whether parameters change."""
        return self.rate > 0.0

    def next_trial(self, due: int) -> int:
        """The number of keyframes at which the trial after one is due."""
        return min(2 * due, due + WINDOW // 2) if self.drifts else 2 * due

    def prior(self, parameter: Parameter, configured: float, now_ns: int) -> float:
        """The sigma of a parameter's change: against the configuration, then against the window before."""
        left = self._left.get(parameter)
        if left is None:
            return configured
        hours = (now_ns - self._before_ns) / 2.0 / _HOUR_NS  # from the middle of a window to that of the next
        return min(configured, math.hypot(left, self.rate * configured * math.sqrt(max(hours, 0.0))))

    def close_if_full(
        self,
        keyframe: int,
        stamps_ns: Index,
        edges: int,
        findings: list[Finding],
        settings: dict[str, float | str],
        first: int = 0,
    ) -> None:
        """Begin a window after a keyframe, if the newest has enough of them.

        Parameters
        ----------
        stamps_ns : (n,) of the keyframes in the map, of which the first has the number ``first``
        edges : of the graph
        findings, settings : of the trial, and what is corrected with it
        """
        if not self.drifts or keyframe + 1 - self._first_keyframe < WINDOW:
            return
        self.closed.append((self._first_keyframe, settings))
        self._before_ns = int(stamps_ns[max(self._first_keyframe - first, 0)])
        self._first_keyframe, self.first_edge = keyframe + 1, edges
        for one in findings:
            unused = 0.0 if one.verdict == "admitted" else one.value
            self._left[one.parameter] = math.hypot(one.sigma, unused)
