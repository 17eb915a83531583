"""Trial fits whose findings are said: of the places of sensors, too, and not of what noise alone explains.

A sensor that is further to the side, or further ahead, than its mount says passes for another scale of odometry, or for
a sensor that is turned. So all are fitted once more together with the places. That fit is taken where a place is off
beyond doubt. Elsewhere the places would only make the other parameters less certain.
Ranges that are too long by an offset pass for another scale of odometry, too. So the offset of a sensor of ranges and
bearings is fitted as well, without its place: for one that looks ahead the two are one.

Where noise of odometry is as large as its motion, a factor is too small by that alone. So a factor that is off must be
off, too, in a fit in which noise grows with it. If it is not, nothing is known of it. Some robots drive less in bends
than odometry says, and as much on straights, which other parameters absorb. So where any is off, that is fitted, too.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graph_slam_ros.errors import SingularError
from graph_slam_ros.slam.calibration.answers import LEAST_M, SIGMAS, is_certain
from graph_slam_ros.slam.calibration.fit import TrialFit, fit, likelier_fit
from graph_slam_ros.slam.calibration.parameters import BEND, FACTORS, Parameter
from graph_slam_ros.slam.calibration.rows import TrialProblem

_SIGMA_M = 0.5
_AGREEING, _PART = 2.0, 1.0 / 3.0  # a factor is off by so many sigmas, and so much of it, whatever its noise is of


def fit_with_places(
    problem: TrialProblem,
    priors: Mapping[Parameter, float],
    log_odds: float,
    *,
    is_thorough: bool = True,
    has_places: bool = True,
) -> tuple[TrialFit, TrialFit]:
    """Fit parameters as ``likelier_fit`` does, with places or range offsets where one is off by ``LEAST_M`` or more.

    These are fitted if ``has_places``, where another parameter is off or if ``is_thorough``. Returns the fit that is
    said, and the one with the places; the same where there is none. Raises SingularError as ``fit`` does.
    """
    places = problem.places()
    first = found = every = likelier_fit(problem, priors, log_odds)
    is_wider = has_places and (is_thorough or bool(_off(found)))
    for lengths in (places, problem.range_offsets()) if is_wider else ():
        if not lengths:
            continue
        try:
            other = likelier_fit(problem, {**priors, **dict.fromkeys(lengths, _SIGMA_M)}, log_odds, first)
        except SingularError:
            continue
        every = other if lengths is places else every
        is_better = found is first or other.evidence > found.evidence
        if is_better and any(abs(other.value(one)) >= LEAST_M and is_certain(other, one) for one in lengths):
            found = other
    if _off(found):
        again = problem if found.slips else problem.without_slips()
        found = _with_bends(again, found)
        every = _with_bends(again, every) if found.doubted else every
        found = _with_noise(again, found)
    return found, every


def _off(found: TrialFit) -> list[Parameter]:
    far = np.abs(found.values) > SIGMAS * found.sigmas
    return [one for one, is_far in zip(found.parameters, far, strict=True) if is_far]


def _priors(found: TrialFit) -> dict[Parameter, float]:
    return dict(zip(found.parameters, found.priors.tolist(), strict=True))


def _with_bends(problem: TrialProblem, found: TrialFit) -> TrialFit:
    """The same with another distance of odometry in bends, where that is off beyond doubt; then no factor mends it."""
    if (distance := next((one for one in found.parameters if one.name == "distance"), None)) is None:
        return found
    bend = Parameter(distance.source, BEND)
    try:
        other = fit(problem, {**_priors(found), bend: bend.quantity.prior}, found)
    except SingularError:
        return found
    if bend not in _off(other) or other.evidence <= found.evidence:
        return found
    why = {distance: f"in bends the factor differs by {bend.shown(other.value(bend))}", bend: "no setting corrects it"}
    doubted = {one: (other.value(one), other.sigma(one), text) for one, text in why.items()}
    return replace(other, slips=found.slips, doubted=doubted)


def _with_noise(problem: TrialProblem, found: TrialFit) -> TrialFit:
    """The same with doubt in the factors of odometry that are not off where its noise is of what was measured."""
    factors = [one for one in _off(found) if one.name in FACTORS and one not in found.doubted]
    try:
        other = fit(replace(problem, is_noise_measured=True), _priors(found), found) if factors else found
    except SingularError:
        return found
    doubted = {
        one: (found.value(one), found.sigma(one), "the noise of odometry explains it as well")
        for one in factors
        if other.value(one) / found.value(one) < max(_PART, _AGREEING * other.sigma(one) / abs(found.value(one)))
    }
    return replace(found, doubted={**found.doubted, **doubted})
