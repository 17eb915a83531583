"""Trial fits whose findings are said: of the places of sensors, too, and not of what noise alone explains.

A sensor that is further to the side, or further ahead, than its mount says passes for another scale of odometry, or for
a sensor that is turned. So all are fitted once more together with the places. That fit is taken where a place is off
beyond doubt. Elsewhere the places would only make the other parameters less certain.
Ranges that are too long by an offset pass for another scale of odometry, too. So the offset of a sensor of ranges and
bearings is fitted as well, without its place: for one that looks ahead the two are one.

Where noise of odometry is as large as its motion, a factor is too small by that alone. So a factor that is off must be
off, too, in a fit in which noise grows with it. If it is not, nothing is known of it.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graph_slam_ros.errors import SingularError
from graph_slam_ros.slam.calibration.choice import offsets_of, places_of
from graph_slam_ros.slam.calibration.decision import SIGMAS, is_certain
from graph_slam_ros.slam.calibration.fit import TrialFit, fit, likelier_fit
from graph_slam_ros.slam.calibration.parameters import FACTORS, Parameter
from graph_slam_ros.slam.calibration.rows import TrialProblem

LEAST_M = 0.2  # errors that last, as a robot that follows its commands late, are up to 0.14 m in recorded drives
_SIGMA_M = 0.5
_AGREEING, _PART = 2.0, 1.0 / 3.0  # a factor is off by so many sigmas, and so much of it, whatever its noise is of


def fit_with_places(
    problem: TrialProblem, priors: Mapping[Parameter, float], log_odds: float, *, is_thorough: bool = True
) -> tuple[TrialFit, TrialFit]:
    """Fit parameters as ``likelier_fit`` does, with places or range offsets where one is off by ``LEAST_M`` or more.

    Parameters
    ----------
    is_thorough : fit these also where no other parameter is off

    Returns
    -------
    That fit, and the one with the places; the same without any, or where that is singular or not asked for.

    Raises
    ------
    SingularError
        The edges do not determine the estimate.
    """
    again, places, offsets = replace(problem, graph=problem.graph.copy()), places_of(problem), offsets_of(problem)
    first = found = likelier_fit(problem, priors, log_odds)  # which overwrites the graph of its problem
    every, used, is_off = found, priors, bool((np.abs(found.values) > SIGMAS * found.sigmas).any())
    for lengths in (places, offsets) if is_off or is_thorough else ():
        if not lengths:
            continue
        wider = {**priors, **dict.fromkeys(lengths, _SIGMA_M)}
        try:
            other = likelier_fit(replace(again, graph=again.graph.copy()), wider, log_odds, first)
        except SingularError:
            continue
        every = other if lengths is places else every
        is_better = found is first or other.evidence > found.evidence
        if is_better and any(abs(other.value(one)) >= LEAST_M and is_certain(other, one) for one in lengths):
            found, used = other, wider
    return _without_noise(again, found, used), every


def _without_noise(problem: TrialProblem, found: TrialFit, priors: Mapping[Parameter, float]) -> TrialFit:
    """The same; or a fit without the factors of odometry that are not off where its noise is of what was measured."""
    far = np.abs(found.values) > SIGMAS * found.sigmas
    factors = [one for one, is_far in zip(found.parameters, far, strict=True) if is_far and one.name in FACTORS]
    if not factors:
        return found
    problem = problem if found.slips else problem.without_slips()
    copy = replace(problem, graph=problem.graph.copy(), is_noise_measured=True)
    try:
        other = fit(copy, priors, found)
        sigmas = dict(zip(other.parameters, other.sigmas.tolist(), strict=True))
        parts = {one: other.value(one) / found.value(one) for one in factors}
        of_noise = {one for one in factors if parts[one] < max(_PART, _AGREEING * sigmas[one] / abs(found.value(one)))}
        left = {one: prior for one, prior in priors.items() if one not in of_noise}
        return replace(fit(problem, left, found), slips=found.slips) if of_noise and left else found
    except SingularError:
        return found
