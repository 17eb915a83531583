"""The trial fit: derivatives against differences, and what was wrong is found with an honest sigma."""

import math

import numpy as np
import pytest
from imperfect import Faults, driven, imperfect_drive
from rows import each

from graph_slam_ros.slam.calibration.answers import decide
from graph_slam_ros.slam.calibration.fit import TrialFit
from graph_slam_ros.slam.calibration.parameters import GROUPS, Parameter
from graph_slam_ros.slam.calibration.rows import Linearization

FAULTS = Faults(distance=0.95, turn=1.05, clock_s=0.12, yaw=0.08)
TRUTH = {"distance": -0.05, "turn": 0.05, "clock": 0.12, "yaw": 0.08}


@pytest.mark.parametrize("kind", ["range_bearing", "position"])
def test_derivatives_are_the_numeric_ones_and_a_fit_finds_what_was_wrong_and_changes_nothing(kind):
    # Beside a slip the vertices bend by 0.2 rad from one keyframe to the next. The derivatives are of the first
    # order in that motion: they differ from the numeric ones by 5 % there.
    wrong = driven(imperfect_drive(FAULTS, kind=kind, seconds=60.0), {"odometry.doubt": False})
    for check in (check_parameters, check_unknowns):
        check(wrong.view.trials.problem())
    before, measured = wrong.view.solver.values, [t.measured.values.copy() for t in wrong.view.graph.tables.values()]
    found, findings = wrong.view.trial_fit()
    assert (wrong.view.solver.values == before).all()
    for table, old in zip(wrong.view.graph.tables.values(), measured, strict=True):
        assert (table.measured.values == old).all()
    by_name = {one.parameter.name: one for one in findings}
    for name, truth in TRUTH.items():
        one = by_name[name]
        assert one.verdict == "admitted", one.text
        assert abs(one.value - truth) < 5.0 * one.sigma + 0.003, one.text
        assert one.sigma < one.parameter.quantity.determined_below / 2.0
    assert np.abs(found.correlation - np.eye(4)).max() < 0.95


def check_parameters(problem):
    """Their columns are the derivatives of the residuals."""
    chosen = problem.parameters([one for one in GROUPS if one != "clock"])
    parameters = (*chosen, *[Parameter(one.source, "bend") for one in chosen if one.name == "distance"])
    linear = Linearization(problem, parameters, problem.vertices)
    theta = np.full(len(parameters), 0.02)
    rows = linear.rows(problem.values, theta, {})
    for k, parameter in enumerate(parameters):
        step = 1e-3 * np.eye(len(theta))[k]
        sides = [linear.rows(problem.values, theta + side, {}).residual for side in (step, -step)]
        difference = (sides[0] - sides[1]) / 2e-3
        scale = np.abs(difference).max()
        assert scale > 0.0, parameter
        np.testing.assert_allclose(rows.columns[:, k], difference, atol=3e-3 * scale, err_msg=str(parameter))


def check_unknowns(problem):
    """Sightings late by more than the time between keyframes are seen from between others than their own."""
    linear = Linearization(problem, (Parameter("detections", "clock"),), problem.vertices)
    theta, x, keyframe = np.array([0.3]), problem.values, int(problem.keyframes[40])
    jacobian, at = linear.rows(x, theta, {}).jacobian.toarray(), problem.graph.vertex(keyframe).stored
    for d in range(3):
        sides = []
        for side in (1e-5, -1e-5):
            moved = x.copy()
            moved[at] = problem.space.pose.retract(x[at][None], side * np.eye(3)[d : d + 1])[0]
            sides.append(linear.rows(moved, theta, {}).residual)
        difference = (sides[0] - sides[1]) / 2e-5
        column = jacobian[:, linear.column[keyframe] + d]
        assert np.count_nonzero(np.abs(column) > 1e-3) > 6
        np.testing.assert_allclose(column, difference, atol=0.03 * np.abs(difference).max())


@each(
    "name, value, sigma, known, verdict",
    [
        ("clock", 0.3, 0.035, {}, "not_determined"),
        ("clock", 0.3, 0.025, {"is_unnamed": True, "sigma_per_m": math.inf}, "admitted"),
        ("yaw", -0.17, 0.01, {}, "admitted"),
        ("yaw", -0.17, 0.01, {"sigma_per_m": math.inf}, "refused"),  # of a robot that only turns
        ("distance", -0.11, 0.01, {}, "admitted"),
        ("distance", -0.11, 0.01, {"is_unnamed": True}, "refused"),  # odometry told the landmarks apart
    ],
)
def test_what_a_fit_finds_is_admitted_where_something_else_measured_it(name, value, sigma, known, verdict):
    rest, none, rows = np.full((2, 1), 0.5**0.5 / sigma), np.zeros(0), np.arange(2)
    found = np.array([value]), np.array([0.5]), rest, np.zeros(2), rows, rows, 0.0, none, none, none.astype(int), 0.0
    parameter = Parameter("odom" if name == "distance" else "detections", name)
    assert decide(TrialFit((parameter,), *found), 10, **known)[0].verdict == verdict
