"""Trial fits whose findings are said: of what passes for other errors, too, and not of what noise alone explains.

A sensor that is further to the side, or further ahead, than its mount says passes for another scale of odometry, or for
a sensor that is turned. So does an offset of ranges. Some robots drive less in bends than odometry says, and as much on
straights, which other parameters absorb. So all are fitted together. From that fit follows the one in which places,
offsets and bends are as configured; they are taken up where one is off beyond doubt. Elsewhere they would only make
the other parameters less certain. Of places and offsets one is taken up: for a sensor that looks ahead the two are one.

Where noise of odometry is as large as its motion, a factor is too small by that alone. So a factor that is off must be
off, too, in a fit in which noise grows with it. If it is not, nothing is known of it.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graph_slam_ros.slam.calibration.answers import LEAST_M, is_certain
from graph_slam_ros.slam.calibration.fit import TrialFit, fit
from graph_slam_ros.slam.calibration.parameters import BEND, FACTORS, Parameter
from graph_slam_ros.slam.calibration.rows import TrialProblem
from graph_slam_ros.slam.levels import SIGMAS

_SIGMA_M = 0.5  # of a place on a robot of a metre, beforehand
_AGREEING, _PART = 2.0, 1.0 / 3.0  # a factor is off by so many sigmas, and so much of it, whatever its noise is of


def fit_with_places(
    problem: TrialProblem, priors: Mapping[Parameter, float], log_odds: float, *, has_places: bool = True
) -> tuple[TrialFit, TrialFit]:
    """Fit parameters, with places or range offsets if ``has_places``, where one is off by ``LEAST_M`` or more.

    Returns the fit that is said, and the one with the places. Raises SingularError as ``fit`` does.
    """
    both = [[one for one in some if one not in priors] for some in (problem.places(), problem.range_offsets())]
    places, offsets = both if has_places else ([], [])
    bends = [Parameter(one.source, BEND) for one in priors if one.name == "distance"]
    more = dict.fromkeys([*places, *offsets], _SIGMA_M) | {one: one.quantity.prior for one in bends}
    whole = fit(problem, {**priors, **more}, log_odds)
    simple = whole.without(more)
    found, every = simple, whole.without([*offsets, *bends])
    for lengths, other in ((places, every), (offsets, whole.without([*places, *bends]))):
        is_better = found is simple or other.evidence > found.evidence
        if is_better and any(abs(other.value(one)) >= LEAST_M and is_certain(other, one) for one in lengths):
            found = other
    if bends and _off(found):
        (bend,) = bends
        other = whole.without([one for one in more if one != bend and one not in found.parameters])
        if bend in _off(other) and other.evidence > found.evidence:
            found, every = replace(other, doubted=_of_bends(other, bend)), whole.without(offsets)
    return _with_noise(problem, found, log_odds), every


def _off(found: TrialFit) -> list[Parameter]:
    far = np.abs(found.values) > SIGMAS * found.sigmas
    return [one for one, is_far in zip(found.parameters, far, strict=True) if is_far]


def _of_bends(found: TrialFit, bend: Parameter) -> dict[Parameter, tuple[float, float, str]]:
    """The doubt where the distance of odometry is another in bends: no factor mends it."""
    distance = Parameter(bend.source, "distance")
    why = {distance: f"in bends the factor differs by {bend.shown(found.value(bend))}", bend: "no setting corrects it"}
    return {one: (found.value(one), found.sigma(one), text) for one, text in why.items()}


def _with_noise(problem: TrialProblem, found: TrialFit, log_odds: float) -> TrialFit:
    """The same with doubt in the factors of odometry that are not off where its noise is of what was measured."""
    factors = [one for one in _off(found) if one.name in FACTORS and one not in found.doubted]
    if not factors:
        return found
    priors = dict(zip(found.parameters, found.priors.tolist(), strict=True))
    other = fit(replace(problem, is_noise_measured=True), priors, log_odds)
    doubted = {
        one: (found.value(one), found.sigma(one), "the noise of odometry explains it as well")
        for one in factors
        if other.value(one) / found.value(one) < max(_PART, _AGREEING * other.sigma(one) / abs(found.value(one)))
    }
    return replace(found, doubted={**found.doubted, **doubted})
