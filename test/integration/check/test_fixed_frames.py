"""Landmarks in a frame that does not move with the robot: /tf puts them back, or nothing does."""

import numpy as np
import pytest
from recordings import short_drive

from graph_slam_ros.cli import main
from graph_slam_ros.lie import se3
from graph_slam_ros.overview.contents import recording_of
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.check import check
from graph_slam_ros.runs.suggestion import Suggestion
from graph_slam_ros.tools.simulation import Drive, Fault, spoil_messages
from graph_slam_ros.tools.simulation.drive import Sightings


def in_odom(drive, frame):
    """Give every landmark where odometry has it, and call that a frame."""
    at = dict(zip(drive.odometry_ns.tolist(), drive.poses.tolist(), strict=True))
    for m in drive.landmarks:
        seen = Sightings(m)
        seen.points = np.stack(se3.act(tuple(at[m.stamp_ns]), tuple(seen.points.T)), axis=1)
        seen.store()
        m.frame = frame
    return drive


def suggested(file):
    bag = open_bag(file)
    return Suggestion(bag, recording_of(bag), file)


@pytest.fixture
def with_tf(tmp_path):
    drive = in_odom(Drive(short_drive(tmp_path / "drive.mcap")), "odom")
    spoil_messages(drive, [Fault.named("other_tf", distance=1.0)], 0)
    drive.write(tmp_path / "odom.mcap")
    return tmp_path / "odom.mcap"


def test_landmarks_in_the_frame_of_odometry_need_no_mount_where_tf_has_the_robot(with_tf):
    found = suggested(with_tf)
    assert "detections.mount" not in found.settings
    assert any("/landmarks is given in odom: /tf says where the robot is in it" in note for note in found.notes)
    findings = check(with_tf).findings
    assert [(one.code, one.severity) for one in findings if one.severity != "note"] == []


def test_a_frame_that_does_not_move_is_not_said_to_lack_a_mount(tmp_path, capsys):
    in_odom(Drive(short_drive(tmp_path / "drive.mcap")), "map").write(tmp_path / "map.mcap")
    assert main(["info", str(tmp_path / "map.mcap")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "given in map, a frame that does not move with the robot: publish it in the sensor's frame" in said
    assert "no transform has the pose of map" not in said
