"""Where calibration must not be sure: nothing is corrected, and the sentence names why."""

import numpy as np
import pytest
from imperfect import Faults, driven, error_m, imperfect_drive
from random_drives import random_drive

from graph_slam_ros.slam import Odometry, Sightings
from graph_slam_ros.slam.slip_review import Slip

ON = {"calibrate.groups": "auto"}


def findings(slam):
    return {one["name"]: one for one in slam.calibration_report["parameters"]}


def slips_of(slam):
    return [one for one in slam.alarms if isinstance(one, Slip)]


def only(measurements, names):
    """The same with the sightings of some landmarks."""
    for m in measurements:
        seen = tuple(s for s in m.sightings if s.id in names) if isinstance(m, Sightings) else ()
        if isinstance(m, Odometry):
            yield m
        elif seen:
            yield Sightings(m.stamp_ns, m.topic, seen)


def test_with_one_landmark_nothing_is_corrected():
    slam = driven(list(only(imperfect_drive(Faults(yaw=0.1), seconds=40.0), {"3"})), ON)
    assert not slam.calibration_report["settings"]
    assert all("1 landmark was seen, 3 are needed" in one["text"] for one in findings(slam).values())


def test_a_drive_without_turns_does_not_determine_the_turn_factor():
    slam = driven(imperfect_drive(Faults(turn=1.1), seconds=20.0, turns=0.0), ON)
    assert "odometry.turn_factor" not in slam.calibration_report["settings"]
    assert findings(slam)["turn"]["verdict"] == "not_determined"
    assert "figure of eight" in findings(slam)["turn"]["text"]


def test_a_standing_robot_corrects_nothing():
    still = [
        Odometry(m.stamp_ns, (0.0, 0.0, 0.0)) if isinstance(m, Odometry) else m
        for m in imperfect_drive(Faults(), seconds=15.0)
    ]
    at_once = next(m for m in still if isinstance(m, Sightings))
    same = [m if isinstance(m, Odometry) else Sightings(m.stamp_ns, m.topic, at_once.sightings) for m in still]
    slam = driven(same, ON)
    assert not slam.calibration_report["settings"]


def test_a_clock_that_jumps_half_way_is_not_reproducible():
    half = 35 * 10**9
    first = imperfect_drive(Faults(), seconds=70.0)
    middle_ns = first[0].stamp_ns + half
    jumped = [
        Sightings(m.stamp_ns - 200_000_000, m.topic, m.sightings)
        if isinstance(m, Sightings) and m.stamp_ns > middle_ns
        else m
        for m in first
    ]
    slam = driven(sorted(jumped, key=lambda m: m.stamp_ns), ON)
    one = findings(slam)["clock"]
    assert "detections.offset_s" not in slam.calibration_report["settings"], one["text"]
    assert one["verdict"] in ("not_reproducible", "refused", "not_determined"), one["text"]


@pytest.mark.parametrize("wrong", [0.05, 0.2])
def test_wrong_identities_do_not_make_calibration_worse_than_none(wrong):
    faults = Faults(distance=0.95, clock_s=0.1, yaw=0.08, wrong_ids=wrong)
    measurements = imperfect_drive(faults, seconds=50.0)
    found = driven(measurements, ON)._frontend.corrections.found
    truth = {"distance": -0.05, "turn": 0.0, "clock": 0.1, "yaw": 0.08}
    for (_, name), value in found.items():
        assert abs(value - truth[name]) < 0.5 * abs(truth[name]) + 0.01, (name, value)


def test_a_prior_that_contradicts_is_named():
    measurements = imperfect_drive(Faults(yaw=0.3), seconds=40.0)
    slam = driven(measurements, ON | {"calibrate.yaw_sigma_rad": 0.05})
    one = findings(slam)["yaw"]
    assert one["verdict"] == "refused", one["text"]
    assert "correct the configuration first" in one["text"]


def test_factors_apart_find_what_is_configured_wrong():
    """``odometry.distance_factor`` that is wrong is as odometry that is wrong."""
    slam = driven(imperfect_drive(Faults(), seconds=50.0), ON | {"odometry.distance_factor": 1.06})
    assert slam.calibration_report["settings"]["odometry.distance_factor"] == pytest.approx(1.0, abs=0.01)
    assert np.isfinite(slam.solver.values).all()


def test_a_robot_that_may_slide_does_not_tell_the_yaw_of_its_sensor():
    """Its direction of motion, against which a yaw is measured, may be that in which it slides."""
    measurements = imperfect_drive(Faults(yaw=0.08), seconds=30.0)
    slam = driven(measurements, ON | {"odometry.lateral_density": 0.006})
    one = findings(slam)["yaw"]
    assert not slam.calibration_report["settings"]
    assert one["verdict"] == "refused"
    assert "odometry.lateral_density (sideways) is 0.6 of odometry.translation_density" in one["text"]
    assert "drive 10 m straight past" in one["text"]
    assert findings(driven(measurements, ON))["yaw"]["verdict"] != "refused"


def test_where_nothing_is_corrected_slips_are_found_as_without_calibration():
    drive, settings, _, _ = random_drive("a prior that contradicts", 1002)
    configured = {"robust.noise_scale": "configured"}  # estimated noise allows for these slips
    on, off = driven(drive, ON | settings | configured), driven(drive, configured)
    assert not on.calibration_report["settings"]
    assert findings(on)["yaw"]["verdict"] == "refused"
    assert len(slips_of(off)) > 0
    assert slips_of(on) == slips_of(off)
    assert (on.solver.values == off.solver.values).all()


def test_a_slip_for_which_a_turned_sensor_has_passed_is_taken_back_with_its_correction():
    drive, settings, truth, _ = random_drive("no turns", 1006)
    on, off = driven(drive, ON | settings), driven(drive)
    (slip,) = slips_of(on)
    assert slips_of(off)[0].edges > 0
    assert slip.edges == 0
    assert slip.outcome == "taken back: a wrong parameter, which is corrected now, passed for it"
    assert on.counters["odometry", "slip_taken_back"] == 1
    assert error_m(on, truth) < 0.2 * error_m(off, truth)


def test_slips_stay_if_a_parameter_that_is_not_used_passes_for_them():
    """The turn factor is corrected, the yaw is refused: without the slips the path would bend by it."""
    drive, settings, truth, _ = random_drive("a prior that contradicts", 1006)
    on, off = driven(drive, ON | settings), driven(drive)
    assert list(on.calibration_report["settings"]) == ["odometry.turn_factor"]
    assert sum(slip.edges for slip in slips_of(on)) > 0
    assert error_m(on, truth) < 1.2 * error_m(off, truth)
