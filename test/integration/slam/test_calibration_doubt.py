"""Where calibration must not be sure: nothing is let in, and the sentence names why."""

import pytest
from imperfect import Faults, driven, imperfect_drive
from reliability import times

from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Odometry, Sightings


def findings(view):
    return {one.parameter.name: one for one in view.trial_fit(is_to_correct=True)[1]}


def admitted(view):
    return {name: one.value for name, one in findings(view).items() if one.verdict == "admitted"}


def only(measurements, names):
    for m in measurements:
        seen = tuple(s for s in m.sightings if s.id in names) if isinstance(m, Sightings) else ()
        if isinstance(m, Odometry):
            yield m
        elif seen:
            yield Sightings(m.stamp_ns, m.topic, seen)


def test_with_one_landmark_nothing_is_corrected():
    slam = driven(list(only(imperfect_drive(Faults(yaw=0.1), seconds=20.0), {"3"})))
    assert not admitted(slam.view)
    assert all("1 landmark was seen, 3 are needed" in one.text for one in findings(slam.view).values())


def test_a_drive_without_turns_does_not_determine_the_turn_factor():
    slam = driven(imperfect_drive(Faults(turn=1.1), seconds=20.0, turns=0.0))
    assert findings(slam.view)["turn"].verdict == "not_determined"
    assert "figure of eight" in findings(slam.view)["turn"].text


def test_a_standing_robot_corrects_nothing():
    drive = imperfect_drive(Faults(), seconds=15.0)
    still = [Odometry(m.stamp_ns, (0.0, 0.0, 0.0)) if isinstance(m, Odometry) else m for m in drive]
    at_once = next(m for m in still if isinstance(m, Sightings))
    same = [m if isinstance(m, Odometry) else Sightings(m.stamp_ns, m.topic, at_once.sightings) for m in still]
    assert not admitted(driven(same).view)


@pytest.mark.parametrize("wrong", times([0.2], [0.05, 0.2]))
def test_wrong_identities_do_not_make_calibration_worse_than_none(wrong):
    faults = Faults(distance=0.95, clock_s=0.1, yaw=0.08, wrong_ids=wrong)
    measurements = imperfect_drive(faults, seconds=40.0)
    truth = {"distance": -0.05, "turn": 0.0, "clock": 0.1, "yaw": 0.08}
    for name, value in admitted(driven(measurements).view).items():
        assert abs(value - truth[name]) < 0.5 * abs(truth[name]) + 0.01, (name, value)


def test_a_robot_that_may_slide_does_not_tell_the_yaw_of_its_sensor():
    slam = driven(imperfect_drive(Faults(yaw=0.08), seconds=30.0), {"odometry.lateral_density": 0.006})
    one = findings(slam.view)["yaw"]
    assert one.verdict == "refused"
    assert "odometry.lateral_density (sideways) is 0.6 of odometry.translation_density" in one.text
    assert "drive 10 m straight past" in one.text


@pytest.mark.parametrize("straight", [1.0, 0.85])
def test_another_distance_in_bends_is_named_and_not_taken_for_a_setting(straight):
    drive, before, at = [], se2.IDENTITY, se2.IDENTITY
    for m in imperfect_drive(Faults(), seconds=60.0):
        if isinstance(m, Odometry):
            x, y, turn = se2.log(se2.between(before, m.T_odom_base))
            before, far = m.T_odom_base, 1.6 * straight if abs(turn) > 0.02 else straight
            at = se2.compose(at, se2.exp((far * x, far * y, turn)))
        drive.append(Odometry(m.stamp_ns, at) if isinstance(m, Odometry) else m)
    slam = driven(drive)
    assert not admitted(slam.view) and "not sure" in findings(slam.view)["distance"].text
    off = [one for one in slam.view.uncorrected() if one.code in ("odometry_scale", "mount_yaw", "mount_place")]
    assert [one.code for one in off] == ["odometry_scale"] * (straight < 1.0)
    assert all(not one.setting and "no setting corrects it" in one.text for one in off)
