"""The trial fit: derivatives against differences, and what was wrong is found with an honest sigma."""

from dataclasses import replace

import numpy as np
import pytest
from imperfect import START_NS, Faults, driven, imperfect_drive

from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Odometry
from graph_slam_ros.slam.calibration.choice import parameters_of
from graph_slam_ros.slam.calibration.fit import fit
from graph_slam_ros.slam.calibration.parameters import GROUPS, Parameter
from graph_slam_ros.slam.calibration.rows import Linearization
from graph_slam_ros.slam.robust.odometry_errors import odometry_errors
from graph_slam_ros.slam.slip_review import covariance_of

FAULTS = Faults(distance=0.95, turn=1.05, clock_s=0.12, yaw=0.08)
TRUTH = {"distance": -0.05, "turn": 0.05, "clock": 0.12, "yaw": 0.08}


def trial_problem(slam):
    return slam.backend.trial_problem(slam.space, slam._frontend.path, slam._landmarks.map.origins)


@pytest.fixture(scope="module", params=["range_bearing", "position"])
def wrong(request):
    drive = imperfect_drive(FAULTS, kind=request.param, seconds=60.0)
    # Beside a slip the vertices bend by 0.2 rad from one keyframe to the next. The derivatives are of the first
    # order in that motion: they differ from the numeric ones by 5 % there.
    return driven(drive, {"odometry.doubt": False})


def test_columns_of_the_parameters_are_the_derivatives_of_the_residuals(wrong):
    problem = trial_problem(wrong)
    chosen = parameters_of(problem, [one for one in GROUPS if one != "clock"])
    parameters = (*chosen, *[Parameter(one.source, "bend") for one in chosen if one.name == "distance"])
    linear = Linearization(problem, parameters, problem.vertices)
    theta = np.full(len(parameters), 0.02)
    rows = linear.rows(problem.values, theta, {})
    for k, parameter in enumerate(parameters):
        sides = []
        for side in (1e-3, -1e-3):
            there = theta.copy()
            there[k] += side
            sides.append(linear.rows(problem.values, there, {}).residual)
        difference = (sides[0] - sides[1]) / 2e-3
        scale = np.abs(difference).max()
        assert scale > 0.0, parameter
        np.testing.assert_allclose(rows.columns[:, k], difference, atol=3e-3 * scale, err_msg=str(parameter))


def test_unknowns_between_two_keyframes_have_their_derivatives(wrong):
    """Sightings late by more than the time between keyframes are seen from between others than their own."""
    problem = trial_problem(wrong)
    parameters = (Parameter("detections", "clock"),)
    linear = Linearization(problem, parameters, problem.vertices)
    theta = np.array([0.3])
    x = problem.values
    jacobian = linear.rows(x, theta, {}).jacobian.toarray()
    graph, keyframe = problem.graph, int(problem.keyframes[40])
    at = int(graph.offset.values[keyframe])
    for d in range(3):
        sides = []
        for side in (1e-5, -1e-5):
            moved = x.copy()
            step = np.zeros((1, 3))
            step[0, d] = side
            moved[at : at + 3] = problem.space.pose.retract(x[at : at + 3][None], step)[0]
            sides.append(linear.rows(moved, theta, {}).residual)
        difference = (sides[0] - sides[1]) / 2e-5
        column = jacobian[:, linear.column[keyframe] + d]
        assert np.count_nonzero(np.abs(column) > 1e-3) > 6
        np.testing.assert_allclose(column, difference, atol=0.03 * np.abs(difference).max())


def test_a_fit_finds_what_was_wrong_and_changes_nothing(wrong):
    before, measured = wrong.solver.values, [t.measured.values.copy() for t in wrong.graph.tables.values()]
    found, findings = wrong.trial_fit()
    assert (wrong.solver.values == before).all()
    for table, old in zip(wrong.graph.tables.values(), measured, strict=True):
        assert (table.measured.values == old).all()
    by_name = {one.parameter.name: one for one in findings}
    for name, truth in TRUTH.items():
        one = by_name[name]
        assert one.verdict == "admitted", one.text
        assert abs(one.value - truth) < 5.0 * one.sigma + 0.003, one.text
        assert one.sigma < one.parameter.quantity.determined_below / 2.0
    assert np.abs(found.correlation - np.eye(4)).max() < 0.95


def slipped(factor, seconds=60.0):
    """A drive in which odometry tells a multiple of the way from 40 s on for 8 s, and its trial problem with slips."""
    told, out, odom, last = (40.0, 48.0), [], (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for m in imperfect_drive(Faults(), seconds=seconds):
        if isinstance(m, Odometry):
            motion = se2.log(se2.between(last, m.T_odom_base))
            is_slipping = told[0] < (m.stamp_ns - START_NS) * 1e-9 < told[1]
            odom = se2.compose(odom, se2.exp((motion[0] * (factor if is_slipping else 1.0), *motion[1:])))
            last, m = m.T_odom_base, replace(m, T_odom_base=odom)
        out.append(m)
    slam = driven(out, {"robust.noise_scale": "configured"})  # with less noise the loss leaves some sightings no weight
    return slam, replace(trial_problem(slam), slips=slam._kidnaps.slipped(slam.keyframes))


def test_evidence_of_a_slip_is_that_of_the_errors_of_odometry():
    """Computed in two ways: all unknowns integrated out, and from the joint covariance of the stretch's poses."""
    slam, problem = slipped(1.4)
    (pairs,) = problem.slips
    errors = odometry_errors(slam.graph, slam.solver, [edge for _, edge in pairs], 1.0)
    ratio = errors.log_ratio_of(covariance_of(slam.graph, [own for own, _ in pairs], 0, errors.covariance))
    problem = replace(problem, settings=replace(slam.solver.settings, losses={}))
    without, found = fit(problem.without_slips(), {}), fit(problem, {})  # a fit overwrites its graph
    assert ratio < -20.0
    assert without.evidence - found.evidence == pytest.approx(ratio, rel=0.03)
