"""Odometry whose pose and twist differ, and landmarks that seem too noisy by the pose."""

from graph_slam_ros.check.finding import Finding
from graph_slam_ros.check.odometry import of_pose_or_twist

TWIST = Finding("twist_scale", "warning", 3.3, 0.1, "times", "moves 3.3 times as far", "/odom", settings=("a=1",))
NOISY = Finding("over_confident", "warning", 18.9, 3.0, "times", "differ by 18.9 times", "/tags", settings=("b=2",))
OTHER = Finding("outliers", "note", 0.1, 0.02, "part", "some are far from their landmark", "/tags")


def test_landmarks_that_contradict_the_pose_make_it_an_error_without_a_setting_that_hides_it():
    found, other = of_pose_or_twist([TWIST, NOISY, OTHER])
    assert (found.code, found.severity, found.settings) == ("twist_scale", "error", ())
    assert "Is the pose wrong?" in found.text
    assert other is OTHER


def test_each_alone_stays_as_it_is():
    assert of_pose_or_twist([TWIST, OTHER]) == [TWIST, OTHER]
    assert of_pose_or_twist([NOISY]) == [NOISY]
