"""Trial fits of clocks, mounts and scales at fixed keyframes: what is off is said, and covariances contain it.

A trial starts at keyframes 50, 100, 200 and so on of this drive, where odometry was in doubt four times and more than
twice as often as at the last one, and when everything is solved. It works on a copy, in
the background if possible, and corrects nothing. Its outcome counts a fixed number of keyframes later, so that a replay
says what the live run did.

Covariances that take a wrong parameter for known are too small. A drive that contradicts one parameter of the
configuration says that nobody has calibrated this robot. So all parameters count then: the error is how far the fit
moves the estimate, and the sigmas of all parameters add to it (S. F. Schmidt, "Application of state-space methods to
navigation problems", Advances in Control Systems 3, 1966: parameters that are considered, not estimated).
"""

from collections.abc import Sequence
from copy import deepcopy

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.association.landmark_frontend import LandmarkFrontend
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.background import Background, CancelToken, Work, guarded
from graph_slam_ros.slam.calibration.answers import Fitted, decide, is_off, uncorrected
from graph_slam_ros.slam.calibration.fit import TrialFit
from graph_slam_ros.slam.calibration.model import stated_sigma_per_m
from graph_slam_ros.slam.calibration.parameters import AUTO, Parameter
from graph_slam_ros.slam.calibration.places import fit_with_places
from graph_slam_ros.slam.calibration.rows import TrialProblem
from graph_slam_ros.slam.doubt.detector import OdometryDoubt
from graph_slam_ros.slam.doubt.evidence import LOG_ODDS
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.levels import DIGITS
from graph_slam_ros.slam.noise.factors import FIRST_DUE
from graph_slam_ros.typing import Array, Executor, Index

_DOUBTS = 4  # in recorded drives odometry is rightly in doubt up to twice
_SOURCE = "calibration"  # of what is counted
_MOST_POSES = 100  # whose covariances say whether what is not corrected matters

Fits = tuple[TrialFit, TrialFit]
"""The fit whose findings are said, and the one that always has the places of all sensors."""


class TrialFits:
    """The newest outcome of trial fits. Each is computed when somebody asks.

    Parameters
    ----------
    first_keyframe : the first that is driven now; those before are of another drive
    """

    def __init__(
        self,
        config: Config,
        backend: Backend,
        frontend: KeyframeFrontend,
        landmarks: LandmarkFrontend,
        doubt: OdometryDoubt,
        counters: Counters,
        executor: Executor,
        first_keyframe: int = 0,
    ) -> None:
        self._config, self._backend, self._frontend = config, backend, frontend
        self._landmarks = landmarks.map
        self._doubt, self._counters = doubt, counters
        self._graph, self._solver = backend.graph, backend.solver
        self._first_keyframe, self._first_edge = first_keyframe, backend.graph.edge_ids.next
        self._due, self._due_slips = FIRST_DUE, _DOUBTS
        after = config.robust.apply_after_keyframes
        self._background = Background[Fits | None](_SOURCE, executor, after, counters)
        self._of_window = Background[Fits | None](_SOURCE, executor, after, counters)  # before anything is condensed
        self._fits: Fits | None = None
        self._contradicting: TrialFit | None = None
        self._so_far: tuple[Fits | None, list[Fitted]] = (None, [])  # what the newest outcome says
        self._of_whole: list[Fitted] = []  # what the trial of the first window found
        self._of_edges = -1  # the map that the newest trial of everything was of

    # -- trials ------------------------------------------------------------------------------------------------------

    def after_solve(self, *, is_of_everything: bool) -> None:
        """Start a trial if it is due, as it is where all that was measured was solved."""
        keyframe = self._backend.keyframe
        driven = keyframe + 1 - self._first_keyframe
        if driven == self._config.map.window_keyframes and self._config.condenses:  # later it is of a part
            self._of_window.begin(self._frozen, driven)
        if (found := self._of_window.due(driven)) is not None:
            self._of_whole = self._off(found())
        slips = self._counters["odometry", "slip"]
        is_due = is_of_everything or driven >= self._due or slips >= self._due_slips
        if self._backend.holds_back or not is_due:
            return
        self._due_slips = max(_DOUBTS, 2 * slips)
        while not is_of_everything and driven >= self._due:
            self._due *= 2
        is_begun = self._background.begin(self._frozen, keyframe, at_once=is_of_everything)
        if is_of_everything and is_begun:
            self._of_edges = self._graph.edge_ids.next

    def _frozen(self) -> Work[Fits | None]:
        """A trial of the map as it is now."""
        problem = self.problem()

        def run(_: CancelToken) -> Fits | None:
            priors = self._priors(problem)
            return fit_with_places(problem, priors, LOG_ODDS) if priors else None

        return run

    def problem(self) -> TrialProblem:
        """A copy of the map as it is now."""
        path, origins, factors = self._frontend.path, self._landmarks.origins, self._frontend.corrections.factors
        graph, solver, out = self._graph.copy(), self._solver, self._backend.ledger.outside
        graph.set_weights(out[graph.has_label(out, ("landmarks",))], 1.0)  # a fit has a loss for each sighting
        rows, begins = path.keyframes, [max(k - path.keyframes.first, 0) for k in path.segments]
        return TrialProblem(
            space=self._config.space,
            graph=graph,
            vertices=solver.vertices,
            held=solver.held,
            values=solver.values,
            settings=solver.settings,
            origins=deepcopy(origins, {id(self._config.space): self._config.space}),
            keyframes=rows.ids.copy(),
            stamps_ns=rows.stamps_ns.copy(),
            segments=tuple(dict.fromkeys(begins)),
            track=path.samples.track(rows.poses, factors),
            first_edge=max(self._backend.first_free_edge, self._first_edge),
            slips=self._doubt.slipped(),
        )

    def fit(self, groups: Sequence[str], *, is_to_correct: bool) -> tuple[TrialFit, list[Fitted]]:
        """Fit the map as it is now, as of ``GraphSlam.trial_fit``."""
        problem = self.problem()
        wanted = self._priors(problem, groups, has_gyro=is_to_correct)
        found = fit_with_places(problem, wanted, LOG_ODDS, has_places=not is_to_correct)[0]
        return found, self._judged(found, are_factors_asked="factors" in groups or not is_to_correct)

    def _priors(
        self, problem: TrialProblem, groups: Sequence[str] = (AUTO,), *, has_gyro: bool = True
    ) -> dict[Parameter, float]:
        """The parameters of groups, with the sigmas of their priors. Odometry's turn is mostly that of a gyro."""
        has_turn = not (has_gyro and self._config.gyro_input)
        return {one: one.quantity.prior for one in problem.parameters(groups) if one.name != "turn" or has_turn}

    def _judged(self, found: TrialFit, *, are_factors_asked: bool = False) -> list[Fitted]:
        """The finding of each parameter."""
        known = [mark.is_unnamed for mark in self._landmarks.known.values() if not mark.is_tentative]
        is_unnamed = not self._first_keyframe and 2 * sum(known) > len(known)
        return decide(
            found,
            len(known),
            slides=self._config.odometry.slides,
            sigma_per_m=self._stated(),
            is_unnamed=is_unnamed and not are_factors_asked,
        )

    def _stated(self) -> float:
        return stated_sigma_per_m(self._config.space, self._graph, max(self._backend.first_free_edge, self._first_edge))

    # -- what they find ----------------------------------------------------------------------------------------------

    def widened(self, marginal: Array, vertex: int) -> Array:
        """The marginal of a vertex with what wrong parameters add to it, where any contradicts the configuration."""
        self._compute()
        found, dof = self._contradicting, len(marginal)
        if found is None:
            return marginal
        return marginal + np.round(found.adds(self._known(vertex, dof, found.column), dof), DIGITS)

    def _known(self, vertex: int, dof: int, column: Index) -> int:
        """A vertex that a trial had: a pose after it counts as the last keyframe before."""
        keyframes = self._frontend.path.keyframes.ids
        if vertex < len(column) or dof != self._graph.kind_of(int(keyframes[-1])).dof:
            return vertex
        earlier = keyframes[keyframes < len(column)]
        return int(earlier[-1]) if len(earlier) else vertex

    def contradicted(self) -> list[str]:
        """Say what each parameter is off by, with its sigma; empty where nothing contradicts the configuration.

        Covariances contain what is doubted, too, but that is no error of the configuration.
        """
        self._compute()
        found = self._contradicting
        if found is None or self._fits is None:
            return []
        doubted = self._fits[0].doubted
        values = zip(found.parameters, found.values.tolist(), found.sigmas.tolist(), strict=True)
        return [
            f"{one} {one.shown(value, 3)} (sigma {one.shown(sigma)})"
            for one, value, sigma in values
            if one not in doubted
        ]

    def uncorrected(self) -> list[Fitted]:
        """Return what is wrong in the map as it is now."""
        self._compute()
        is_newest = self._of_edges == self._graph.edge_ids.next
        fits = self._fits if is_newest else guarded(self._counters, _SOURCE, lambda: self._frozen()(CancelToken()))
        return self._with_whole(self._off(fits))

    def _with_whole(self, now: list[Fitted]) -> list[Fitted]:
        """Add what was found before anything was condensed, and the window that is left does not show."""
        known = {(one.code, one.parameter.source) for one in now}
        whole = self._of_whole * bool(self._frontend.path.keyframes.first)
        return now + [one for one in whole if (one.code, one.parameter.source) not in known]

    def uncorrected_so_far(self) -> Sequence[Fitted]:
        """Return what was wrong in the map at the newest trial."""
        if self._solver.is_current:
            self._compute()
            if self._fits is not self._so_far[0]:
                self._so_far = self._fits, self._with_whole(self._off(self._fits))
        return self._so_far[1]

    def _compute(self) -> None:
        """Compute the newest trial whose outcome counts."""
        keyframe = len(self._frontend.path.keyframes) - 1
        ready = self._background.due(keyframe)
        if ready is None:
            return
        self._fits = ready()
        self._contradicting = None
        if self._fits is not None:
            chosen, whole = self._fits
            is_wrong = chosen.doubted or chosen.since_ns or any(is_off(chosen, one) for one in self._judged(chosen))
            self._contradicting = whole if is_wrong else None

    def _off(self, fits: Fits | None) -> list[Fitted]:
        if fits is None or not self._solver.is_current:
            return []
        keyframes, total = self._frontend.path.keyframes.ids, self._frontend.corrections.total
        vertices = keyframes[np.isin(keyframes, self._solver.vertices)]
        vertices = vertices[:: max(1, -(-len(vertices) // _MOST_POSES))]
        covariances = dict(zip(vertices.tolist(), self._solver.marginal(vertices), strict=True))
        return uncorrected(fits[0], self._judged(fits[0]), covariances, total, self._stated())
