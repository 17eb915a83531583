"""Landmarks that move along with the robot or by themselves, a frame that does not move, and odometry of a part."""

import copy
import math

import numpy as np
import pytest
from recordings import short_drive
from rows import each

from graph_slam_ros.cli import main
from graph_slam_ros.lie import se3
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.check import check
from graph_slam_ros.runs.suggestion import Suggestion
from graph_slam_ros.tools.simulation import Drive, Fault, put_faults
from graph_slam_ros.tools.simulation.drive import Sightings


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    return short_drive(tmp_path_factory.mktemp("short") / "drive.mcap")


def posed(drive):
    return dict(zip(drive.odometry_ns.tolist(), drive.poses.tolist(), strict=True))


def with_another(drive, name, where):
    """Let each message have one more landmark, which is where a function of the robot's pose and the time puts it."""
    at, random = posed(drive), np.random.default_rng(0)
    for m in drive.landmarks:
        m.content.detections.append(copy.deepcopy(m.content.detections[0]))
        seen = Sightings(m)
        seen.ids[-1] = name
        seen.points[-1] = where(at[m.stamp_ns], (m.stamp_ns - drive.odometry_ns[0]) * 1e-9)
        seen.points[-1, :2] += random.normal(0.0, 0.02, 2)
        seen.store()
    return drive


def walking(pose, t):
    person = (10.0 + 6.0 * math.sin(t / 9.0), 10.0 + 6.0 * math.cos(t / 7.0), 0.0)
    return se3.act(se3.inverse(tuple(pose)), person)


@each(
    "where, said",
    [
        (lambda *_: (0.4, 0.1, 0.0), "landmark other moves along with the robot, at x 0.40 and y 0.10 m on it"),
        (walking, "landmark other moves: it is "),
    ],
)
def test_a_landmark_that_moves_is_named_alone(where, said, short, tmp_path):
    with_another(Drive(short), "other", where).write(tmp_path / "bad.mcap")
    before = {one.code for one in check(short).findings}
    found = check(tmp_path / "bad.mcap").findings
    assert {one.code for one in found} - before == {"landmark_moves"}
    assert said in next(one.text for one in found if one.code == "landmark_moves")


def in_odom(drive, frame=None):
    """Give every landmark where odometry has it, and call that a frame."""
    at = posed(drive)
    for m in drive.landmarks:
        seen = Sightings(m)
        seen.points = np.stack(se3.act(tuple(at[m.stamp_ns]), tuple(seen.points.T)), axis=1)
        seen.store()
        m.frame = frame or m.frame
    return drive


def test_landmarks_of_a_map_that_name_the_robot_s_frame_are_found(short, tmp_path, capsys):
    in_odom(Drive(short)).write(tmp_path / "bad.mcap")
    found = check(tmp_path / "bad.mcap").findings
    assert [one.code for one in found if one.severity != "note"] == ["seen_in_fixed_frame"]
    assert "they are given in a frame that does not move with the robot" in found[0].text
    assert main(["check", str(tmp_path / "bad.mcap")]) == 4
    assert "replay" not in capsys.readouterr().out


def test_landmarks_in_the_frame_of_odometry_need_no_mount_where_tf_has_the_robot(short, tmp_path):
    drive, file = in_odom(Drive(short), "odom"), tmp_path / "odom.mcap"
    put_faults(drive, [Fault.named("other_tf", distance=1.0)], 0)
    drive.write(file)
    found = Suggestion(open_bag(file), file)
    assert "detections.mount" not in found.settings
    assert any("/landmarks is given in odom: /tf says where the robot is in it" in note for note in found.notes)
    assert [one.code for one in check(file).findings if one.severity != "note"] == []


def test_a_frame_that_does_not_move_is_not_said_to_lack_a_mount(short, tmp_path, capsys):
    in_odom(Drive(short), "map").write(tmp_path / "map.mcap")
    assert main(["info", str(tmp_path / "map.mcap")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "given in map, a frame that does not move with the robot: publish it in the sensor's frame" in said
    assert "no transform has the pose of map" not in said


@each("part, begins, said", [(0.4, True, "s after the first of them"), (0.5, False, "s before the last of them")])
def test_odometry_of_a_part_of_the_drive_is_no_clock_that_differs(part, begins, said, short, tmp_path):
    drive = Drive(short)
    first_ns, last_ns = drive.odometry_ns[[0, -1]]
    at_ns = first_ns + int(part * (last_ns - first_ns))
    drive.drop([m for m in drive.odometry if (m.stamp_ns < at_ns) == begins])
    drive.write(tmp_path / "cut.mcap")
    found = check(tmp_path / "cut.mcap", quick=True).findings
    (one,) = [one for one in found if one.code in ("odometry_short", "no_overlap")]
    assert (one.code, one.severity) == ("odometry_short", "warning")
    assert said in one.text
    assert not one.settings


def test_a_clock_that_differs_is_named_as_such_where_all_was_recorded_at_once(short, tmp_path):
    drive = Drive(short)
    span_ns = int(np.ptp(drive.odometry_ns))
    drive.restamp(drive.landmarks, lambda stamps_ns: stamps_ns + span_ns // 2)
    drive.write(tmp_path / "late.mcap")
    found = {one.code for one in check(tmp_path / "late.mcap", quick=True).findings}
    assert "clock_domains" in found and "odometry_short" not in found
