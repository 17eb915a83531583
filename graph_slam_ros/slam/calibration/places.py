"""The places of sensors on the robot, which are fitted, too, where one is far off.

A sensor that is further to the side, or further ahead, than its mount says passes for another scale of odometry, or for
a sensor that is turned. So all are fitted once more together with the places. That fit is taken where a place is off
beyond doubt. Elsewhere the places would only make the other parameters less certain.
"""

from collections.abc import Mapping
from dataclasses import replace

from graph_slam_ros.errors import SingularError
from graph_slam_ros.slam.calibration.choice import places_of
from graph_slam_ros.slam.calibration.decision import is_certain
from graph_slam_ros.slam.calibration.fit import TrialFit, likelier_fit
from graph_slam_ros.slam.calibration.parameters import Parameter
from graph_slam_ros.slam.calibration.rows import TrialProblem

LEAST_M = 0.2  # errors that last, as a robot that follows its commands late, are up to 0.14 m in recorded drives
_SIGMA_M = 0.5


def fit_with_places(
    problem: TrialProblem, priors: Mapping[Parameter, float], log_odds: float
) -> tuple[TrialFit, TrialFit]:
    """Fit parameters as ``likelier_fit`` does, with the places of sensors where one is off by ``LEAST_M`` or more.

    Returns
    -------
    That fit, and the one that always has the places; without any, or where it is singular, the same.

    Raises
    ------
    SingularError
        The edges do not determine the estimate.
    """
    again, places = replace(problem, graph=problem.graph.copy()), places_of(problem)
    found = likelier_fit(problem, priors, log_odds)  # which overwrites the graph of its problem
    if not places:
        return found, found
    try:
        every = likelier_fit(again, {**priors, **dict.fromkeys(places, _SIGMA_M)}, log_odds)
    except SingularError:
        return found, found
    is_misplaced = any(abs(every.value(one)) >= LEAST_M and is_certain(every, one) for one in places)
    return every if is_misplaced else found, every
