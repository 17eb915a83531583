"""Landmarks that move along with the robot, or by themselves, and a frame that does not move."""

import copy
import math

import numpy as np
from recordings import short_drive
from rows import each

from graph_slam_ros.cli import main
from graph_slam_ros.lie import se3
from graph_slam_ros.runs.check import check
from graph_slam_ros.tools.simulation import Drive
from graph_slam_ros.tools.simulation.drive import Sightings


def posed(drive):
    return dict(zip(drive.odometry_ns.tolist(), drive.poses.tolist(), strict=True))


def with_another(drive, name, where):
    """Let each message have one more landmark, which is where a function of the robot's pose and the time puts it."""
    at, random = posed(drive), np.random.default_rng(0)
    for m in drive.landmarks:
        added = copy.deepcopy(m.content.detections[0])
        m.content.detections.append(added)
        seen = Sightings(m)
        seen.ids[-1] = name
        seen.points[-1] = where(at[m.stamp_ns], (m.stamp_ns - drive.odometry_ns[0]) * 1e-9)
        seen.points[-1, :2] += random.normal(0.0, 0.02, 2)
        seen.store()
    return drive


def on_robot(_pose, _t):
    return 0.4, 0.1, 0.0


def walking(pose, t):
    person = (10.0 + 6.0 * math.sin(t / 9.0), 10.0 + 6.0 * math.cos(t / 7.0), 0.0)
    return se3.act(se3.inverse(tuple(pose)), person)


@each(
    "where, said",
    [
        (on_robot, "landmark other moves along with the robot, at x 0.40 and y 0.10 m on it"),
        (walking, "landmark other moves: it is "),
    ],
)
def test_a_landmark_that_moves_is_named_alone(where, said, tmp_path):
    with_another(Drive(short_drive(tmp_path / "drive.mcap")), "other", where).write(tmp_path / "bad.mcap")
    before = {one.code for one in check(tmp_path / "drive.mcap").findings}
    found = check(tmp_path / "bad.mcap").findings
    assert {one.code for one in found} - before == {"landmark_moves"}
    assert said in next(one.text for one in found if one.code == "landmark_moves")


def test_landmarks_of_a_map_that_name_the_robot_s_frame_are_found(tmp_path, capsys):
    drive = Drive(short_drive(tmp_path / "drive.mcap"))
    at = posed(drive)
    for m in drive.landmarks:
        seen = Sightings(m)
        seen.points = np.stack(se3.act(tuple(at[m.stamp_ns]), tuple(seen.points.T)), axis=1)
        seen.store()
    drive.write(tmp_path / "bad.mcap")
    found = check(tmp_path / "bad.mcap").findings
    assert [one.code for one in found if one.severity != "note"] == ["seen_in_fixed_frame"]
    assert "they are given in a frame that does not move with the robot" in found[0].text
    assert main(["check", str(tmp_path / "bad.mcap")]) == 4
    assert "replay" not in capsys.readouterr().out
