"""Trial fits that correct nothing: what they find is said, and covariances contain what is off.

Covariances that take a wrong parameter for known are too small. A drive that contradicts one parameter of the
configuration says that nobody has calibrated this robot. So all parameters count then: the error is how far the fit
moves the estimate, and the sigmas of all parameters add to it (S. F. Schmidt, "Application of state-space methods to
navigation problems", Advances in Control Systems 3, 1966: parameters that are considered, not estimated).
"""

from collections.abc import Callable, Sequence

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.slam.calibration.decision import Finding, amount
from graph_slam_ros.slam.calibration.fit import TrialFit
from graph_slam_ros.slam.calibration.parameters import FACTORS
from graph_slam_ros.slam.calibration.uncorrected import Total, Uncorrected, is_off, sampled, uncorrected
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index

_MOST_POSES = 100  # whose covariances say whether what is not corrected matters

Fits = tuple[TrialFit, TrialFit]
"""The fit whose findings are said, and the one that always has the places of all sensors."""

Watching = Callable[[], "Fits | None"]
Judge = Callable[[TrialFit], tuple[list[Finding], float]]
"""The finding of each parameter of a fit, and the stated noise of odometry's position for each metre."""


class CalibrationWatch:
    """The newest outcome of trial fits that correct nothing. Each is computed when somebody asks.

    Parameters
    ----------
    keyframes : returns those of the drive
    corrected : adds to a marginal of a vertex what corrected parameters do
    """

    def __init__(
        self,
        graph: Graph,
        solver: Solver,
        keyframes: Callable[[], StampedPoses[Keyframe]],
        judge: Judge,
        corrected: Callable[[Array, int], Array],
        total: Total,
    ) -> None:
        self._graph, self._solver, self._keyframes = graph, solver, keyframes
        self._judge, self._corrected, self._total = judge, corrected, total
        self._jobs = list[tuple[int, Watching]]()
        self._fits: Fits | None = None
        self._contradicting: TrialFit | None = None
        self._fits_so_far: Fits | None = None
        self._so_far: list[Uncorrected] = []
        self._of_edges = -1  # the map that the newest trial of everything was of

    def start(self, job: Watching, from_keyframe: int, *, is_of_everything: bool) -> None:
        """Add a trial, whose outcome counts from a keyframe on.

        Parameters
        ----------
        is_of_everything : whether all that was measured was solved before
        """
        if is_of_everything:
            self._jobs, self._of_edges = [], self._graph.edge_count
        self._jobs = [*self._jobs[-1:], (from_keyframe, job)]  # each holds a copy of the map

    def adds(self, vertex: int, dof: int) -> Array | None:
        """The covariance (dof, dof) that wrong parameters add to a vertex; None where nothing contradicts them."""
        self._compute()
        found = self._contradicting
        return None if found is None else found.adds_all(self.known(vertex, dof, found.column), dof)

    def known(self, vertex: int, dof: int, column: Index) -> int:
        """A vertex that a trial had: a pose after it counts as the last keyframe before."""
        keyframes = self._keyframes().ids
        if vertex < len(column) or dof != self._graph.kind_of(int(keyframes[-1])).dof:
            return vertex
        earlier = keyframes[keyframes < len(column)]
        return int(earlier[-1]) if len(earlier) else vertex

    def sentences(self) -> list[str]:
        """Say what each parameter is off by, with its sigma; empty where nothing contradicts the configuration.

        Covariances contain a factor of odometry that noise explains, too: its noise is no worse said by it. But that is
        no error of the configuration.
        """
        self._compute()
        found = self._contradicting
        if found is None or self._fits is None:
            return []
        known = self._fits[0].parameters
        values = zip(found.parameters, found.values.tolist(), found.sigmas.tolist(), strict=True)
        return [
            f"{one} {amount(one, value, 3)} (sigma {amount(one, sigma)})"
            for one, value, sigma in values
            if one in known or one.name not in FACTORS
        ]

    def uncorrected(self, trial: Callable[[], Watching]) -> list[Uncorrected]:
        """Return what is wrong in the map as it is now.

        Parameters
        ----------
        trial : begins a trial, where the newest was not of this map
        """
        if self._of_edges == self._graph.edge_count:
            self._compute()
            return self._off(self._fits)
        return self._off(trial()())

    def uncorrected_so_far(self) -> Sequence[Uncorrected]:
        """Return what was wrong in the map at the newest trial; empty where trials correct what they find."""
        if self._solver.is_current:
            self._compute()
            if self._fits is not self._fits_so_far:
                self._fits_so_far, self._so_far = self._fits, self._off(self._fits)
        return self._so_far

    def _compute(self) -> None:
        """Compute the newest trial whose outcome counts."""
        keyframe = len(self._keyframes()) - 1
        ready = [job for begins, job in self._jobs if begins <= keyframe]
        if not ready:
            return
        self._jobs = [one for one in self._jobs if one[0] > keyframe]
        self._fits = ready[-1]()
        self._contradicting = None
        if self._fits is not None:
            chosen, whole = self._fits
            self._contradicting = whole if any(is_off(chosen, one) for one in self._judge(chosen)[0]) else None

    def _off(self, fits: Fits | None) -> list[Uncorrected]:
        solver = self._solver
        if fits is None or not solver.is_current:
            return []
        keyframes = self._keyframes().ids
        vertices = sampled(keyframes[np.isin(keyframes, solver.vertices)], _MOST_POSES)
        marginals = zip(vertices.tolist(), solver.marginal(vertices), strict=True)
        covariances = {vertex: self._corrected(marginal, vertex) for vertex, marginal in marginals}
        findings, stated = self._judge(fits[0])
        return uncorrected(fits[0], findings, covariances, self._total, stated)
