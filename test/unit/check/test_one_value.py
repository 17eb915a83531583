"""Findings give each parameter one value."""

from graph_slam_ros.check.finding import Finding, with_one_value
from graph_slam_ros.check.gyro import of_gyro_or_wheels


def finding(code, value, *settings):
    return Finding(code, "warning", value, 0.1, "times", f"/imu: {code}", settings=settings)


def test_a_second_value_of_a_parameter_is_not_printed():
    first = finding("gyro_scale", 1.2, "odometry.turn_factor=1.2")
    other = finding("turn_scale", -0.2, "odometry.turn_factor=0.8")
    same, free = finding("over_confident", 3.0, "a.b=1"), finding("odometry_over_confident", 3.0, "a.b=1")
    out = with_one_value([first, other, same, free])
    assert [one.settings for one in out] == [first.settings, (), same.settings, free.settings]
    assert "mend what is above first" in out[1].text


def test_a_place_that_is_assumed_gives_way_whatever_the_order():
    assumed = finding("frame_unlinked", 1.0, "a.mount=0 0 0 0 0 0")
    measured = finding("axes", 12.0, "a.frame=b", "a.mount=0 0 0 0 0 1.5708")
    out = with_one_value([assumed, measured])
    assert [one.settings for one in out] == [(), measured.settings]
    assert out[0].text.endswith("(axes has the setting)")


def test_a_gyro_that_does_not_explain_a_wrong_heading_keeps_its_finding_alone():
    gyro = finding("gyro_scale", 1.2, "odometry.turn_factor=1.2")
    right, both = finding("turn_scale", -1.0 / 6.0), finding("turn_scale", 0.2)
    (mended,) = of_gyro_or_wheels([gyro, right], "imu")
    assert mended.settings == ("imu.use=none",)
    assert of_gyro_or_wheels([gyro, both], "imu") == [gyro]
    assert of_gyro_or_wheels([gyro], "imu") == [gyro]
    assert of_gyro_or_wheels([both], "imu") == [both]
