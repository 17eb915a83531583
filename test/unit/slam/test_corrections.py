"""Corrections of sightings and odometry: as a trial fit has them, and about the sensor's own origin."""

from dataclasses import replace

import numpy as np
import pytest
from imperfect import Faults, driven, imperfect_drive

from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Config, Sighting, Sightings
from graph_slam_ros.slam.calibration.parameters import Parameter
from graph_slam_ros.slam.frontend.corrections import AXES, Corrections
from graph_slam_ros.slam.frontend.odometry_selector import Step

PLACE = (0.6, 0.1, 0.0)


def corrected(sighting, settings):
    of_input = {f"detections.{key}": value for key, value in settings.items()}
    m = Corrections(Config.from_mapping(of_input)).observation(Sightings(10**9, "detections", (sighting,)))
    return m.sightings[0]


@pytest.mark.parametrize("kind", ["position", "range_bearing"])
def test_what_comes_is_corrected_as_what_is_in_the_graph(kind):
    """A sighting through ``Corrections``, and its edge through the model, are the same afterwards."""
    drive = imperfect_drive(Faults(), seconds=8.0, kind=kind)
    placed = [
        replace(m, sightings=tuple(replace(s, T_base_sensor=PLACE) for s in m.sightings))
        if isinstance(m, Sightings)
        else m
        for m in drive
    ]
    slam = driven(placed)
    problem = slam.backend.trial_problem(slam.space, slam._frontend.path, slam._landmarks.map.origins)
    found = {"yaw": 0.1, "x": 0.05, "y": -0.02} | ({"range_factor": -0.1} if kind == "range_bearing" else {})
    values = {Parameter("detections", name): value for name, value in found.items()}
    (edges,) = problem.model().sightings
    after = problem.model().seen(edges, values)
    axes = " ".join(str(found.get(axis, 0.0)) for axis in AXES)
    configured = {"mount_correction": axes, "range_factor": 1.0 + found.get("range_factor", 0.0)}
    for k, row in enumerate(edges.seen[:40]):
        measured = tuple(row[:2])
        s = Sighting("a", kind, measured, (0.01, 0.0, 0.0, 0.01), PLACE)
        out = corrected(s, configured)
        expected = out.measured if kind == "position" else (*out.measured, *out.T_base_sensor)
        np.testing.assert_allclose(after[k], expected, atol=1e-9)


def test_odometry_is_scaled_and_its_own_frame_kept():
    settings = {"odometry.distance_factor": 0.9, "odometry.turn_factor": 1.1, "odometry.turn_bias_rad_s": 0.02}
    corrections = Corrections(Config.from_mapping(settings))
    motion = tuple(map(float, se2.exp((0.1, 0.0, 0.05))))
    step = corrections.step(Step(10**9, motion, (5.0, 6.0, 0.7)), 0.1)
    assert se2.log(step.T_last_base) == pytest.approx((0.09, 0.0, 0.057))
    assert step.T_odom_base == (5.0, 6.0, 0.7)
    assert corrections.step(Step(10**9, (0.0, 0.0, 0.0), (5.0, 6.0, 0.7)), 0.1).T_last_base == (0.0, 0.0, 0.0)
