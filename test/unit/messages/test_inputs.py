"""Inputs of every type: real CDR bytes in, measurements out, in the plane and in space."""

import math
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from messages import (
    STAMP_NS,
    border,
    closing,
    compass,
    counted,
    detection,
    detections,
    gnss,
    heard,
    imu,
    listening,
    odometry,
    only,
    pose,
    posed,
    quaternion,
    receiver,
    transforms,
)

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.measurements.reasons import warnings
from graph_slam_ros.measurements.types import Closure, Fix, Odometry, to_record
from graph_slam_ros.messages.inputs.fixes import east_north_up
from graph_slam_ros.messages.to_msg import make

IN_SPACE = {"world": {"dimensions": 3}}
POSE, POSE_STAMPED = "PoseWithCovarianceStamped", "PoseStamped"
TF = "tf2_msgs/msg/TFMessage"
NUMBERS = st.sampled_from([0.0, -1.0, 5e-324, 1e-300, 1.7e308, -1.7e308, math.nan, math.inf, 1e154, 1e9, 0.5])


def numbers(q):
    return q.x, q.y, q.z, q.w


def matrix(flat, size):
    return np.reshape(flat, (size, size))


def spread(size, seed):
    """A covariance with every entry, of about a centimetre and a hundredth of a radian."""
    root = np.random.default_rng(seed).standard_normal((size, size)) * 0.01
    return root @ root.T + 1e-5 * np.eye(size)


def samples_of(T, covariance, n=60_000, seed=7):
    """Poses (7, n) around T, spread as a message says it: position and fixed-axis rotation in the parent's axes."""
    drawn = np.random.default_rng(seed).multivariate_normal(np.zeros(6), covariance, n).T
    turned = so3.compose(so3.exp(tuple(drawn[3:])), se3.rotation(T))
    return (*(np.array(T[:3])[:, None] + drawn[:3]), *turned)


# -- in space -------------------------------------------------------------------------------------------------------


def test_in_space_odometry_keeps_its_whole_pose_and_twist_covariance():
    twist, q = spread(6, 1), quaternion(0.3, -0.4, 2.5)
    m = heard(border(**IN_SPACE), "odom", odometry(pose(1.5, -2.5, 0.3, q), twist=twist))
    assert m == Odometry(STAMP_NS, m.T_odom_base, m.twist_covariance, "odom")
    assert m.T_odom_base == pytest.approx((1.5, -2.5, 0.3, *numbers(q)), abs=1e-15)
    assert matrix(m.twist_covariance, 6) == pytest.approx(twist, rel=1e-12)


def test_in_space_a_twist_covariance_that_leaves_out_an_axis_is_not_used():
    for unused in (0.0, 1e6):
        b = border(**IN_SPACE)
        twist = np.diag([0.04, 0.01, unused, 0.1, 0.1, 0.02])
        assert heard(b, "odom", odometry(twist=twist)).twist_covariance is None
        assert counted(b) == {"odom": {"covariance_of_some_axes_unknown": 1}}


@pytest.mark.parametrize("variances", [(1e6, 1e6, 1e6), (0.04, 1e6, 0.02), (0.04, 0.01, 1e6)])
def test_in_the_plane_a_twist_of_which_an_axis_is_unknown_leaves_the_configured_noise(variances):
    b = border()
    x, y, turn = variances
    assert heard(b, "odom", odometry(twist=np.diag([x, y, 1e6, 1e6, 1e6, turn]))).twist_covariance is None
    assert counted(b) == {"odom": {"covariance_of_some_axes_unknown": 1}}


def test_in_space_the_lever_arm_of_a_linked_child_frame_is_applied_with_its_tilt():
    arm, q = (0.5, 0.2, 0.1), quaternion(0.1, 0.2, 0.3)
    T_base_imu = (*arm, *numbers(q))
    b = border(("base_link", "imu", arm, q), **IN_SPACE)
    m = heard(b, "odom", odometry(pose(3.0, 4.0, 5.0, quaternion(-0.2, 0.4, 1.0)), child="imu"))
    back = se3.compose(m.T_odom_base, T_base_imu)
    assert back == pytest.approx((3.0, 4.0, 5.0, *numbers(quaternion(-0.2, 0.4, 1.0))))


def mast():
    """A sensor that is tilted and turned."""
    return "base_link", "mast", (0.3, -0.1, 1.0), quaternion(0.4, -0.3, 2.0)


def test_in_space_a_landmark_of_unknown_orientation_is_a_point_with_its_covariance_in_the_axes_of_the_base():
    covariance = spread(3, 2)
    b = border(mast(), **IN_SPACE)
    s = only(heard(b, "detections", detections(detection(pose(2.0, 1.0, 0.7), covariance, frame="mast"))))
    turn = so3.matrix(numbers(mast()[3]))
    assert s.kind == "position"
    assert s.measured == pytest.approx(turn @ (2.0, 1.0, 0.7) + np.array(mast()[2]))
    assert matrix(s.covariance, 3) == pytest.approx(turn @ covariance @ turn.T)


def test_in_space_the_tangent_covariance_of_a_tag_is_what_samples_of_its_message_say():
    covariance, q = spread(6, 3), quaternion(0.5, 0.2, -1.0)
    b = border(mast(), **IN_SPACE)
    s = only(heard(b, "detections", detections(detection(pose(2.0, 1.0, 0.7, q), covariance, frame="mast"))))
    assert s.kind == "pose"
    T_base_mast = (*mast()[2], *numbers(mast()[3]))
    drawn = se3.compose(T_base_mast, samples_of((2.0, 1.0, 0.7, *numbers(q)), covariance))
    tangent = np.cov(np.stack(se3.local(drawn, s.measured)))
    assert matrix(s.covariance, 6) == pytest.approx(tangent, abs=0.03 * covariance.max())


def test_in_space_a_tag_is_a_pose_only_where_all_of_its_orientation_is_known():
    for unknown in (3, 4, 5):
        variances = np.full(6, 0.01)
        variances[unknown] = 0.26
        found = detections(detection(covariance=np.diag(variances)))
        assert only(heard(border(**IN_SPACE), "detections", found)).kind == "position"


# -- how an input is told -------------------------------------------------------------------------------------------


def test_what_cannot_be_an_input_is_refused_by_name():
    for sections, complaint in (
        (
            {"odom": {"type": "nav_msgs/msg/Path"}},
            "odom.type: 'nav_msgs/msg/Path' is no type of an input: docs/inputs.md has a row for each",
        ),
        (
            {"inputs": {"names": "odom imu"}, "imu": {"use": "gyro"}},
            "imu.type: it has none: imu.type=sensor_msgs/msg/Imu ",
        ),
        (
            {"inputs": {"names": "odom vo"}, "vo": {"type": "nav_msgs/msg/Odometry", "topic": "/odom"}},
            "vo.topic: /odom is odometry by odom already: name the topic of another odometry, or vo.use=none",
        ),
        ({"odom": {"use": "landmarks"}}, "odom.use: nav_msgs/msg/Odometry can be odometry or fix, not landmarks"),
        ({"odom": {"use": "none"}}, "inputs.names: none of 'odom detections' is used as odometry"),
        ({"odom": {"mount": "1 2 3"}}, "odom.mount: '1 2 3' is not 6 numbers"),
        ({"odom": {"mount": "0 0 0 0 0 nan"}}, "odom.mount: '0 0 0 0 0 nan' is not 6 numbers"),
        ({"inputs": {"names": "odom tf"}}, "inputs.names: 'tf' is reserved or given twice"),
        ({"inputs": {"names": "odom odom"}}, "inputs.names: 'odom' is reserved or given twice"),
        ({"inputs": {"names": "odom a-b"}}, "inputs.names: 'a-b' is not a name"),
        ({"gps": {"topic": "/fix"}}, r"did you mean .* 'gps' is not in inputs.names \(odom detections\)"),
    ):
        with pytest.raises(ConfigError, match=complaint):
            border(**sections)


def test_an_input_is_where_it_is_configured_to_be_if_tf_does_not_tell():
    turn = so3.matrix(numbers(quaternion(0.1, 0.2, 0.3)))  # roll first, about fixed axes
    mount = {"mount": "1 2 3 0.1 0.2 0.3"}
    found = detections(detection(pose(2.0, 1.0, 0.5)), frame="eye")
    seen = only(heard(border(**IN_SPACE, detections=mount), "detections", found)).measured
    assert seen == pytest.approx(turn @ (2.0, 1.0, 0.5) + np.array([1.0, 2.0, 3.0]))
    told = border(("base_link", "eye", (5.0, 0.0, 0.0), quaternion()), **IN_SPACE, detections=mount)
    assert only(heard(told, "detections", found)).measured == pytest.approx((7.0, 1.0, 0.5))


def test_a_configured_frame_goes_before_that_of_the_messages():
    b = border(("base_link", "eye", (5.0, 0.0, 0.0), quaternion()), detections={"frame": "eye"})
    assert only(heard(b, "detections", detections(detection(), frame="nonsense"))).measured == (7.0, 1.0)
    vo = listening("vo", "nav_msgs/msg/Odometry", settings={"frame": "odom"})
    assert heard(vo, "vo", odometry(frame="camera_init")).source == "vo"


def test_configured_noise_goes_before_the_messages_where_that_is_told_and_grows_with_distance():
    sigmas = {"sigma_m": 0.1, "sigma_per_m": 0.02, "noise": "sigmas"}
    found = detections(detection(pose(3.0, 4.0)))
    assert only(heard(border(detections=sigmas), "detections", found)).covariance == pytest.approx((0.04, 0, 0, 0.04))
    rest = sigmas | {"noise": "message"}
    assert only(heard(border(detections=rest), "detections", found)).covariance == pytest.approx((0.01, 0, 0, 0.04))


@pytest.mark.parametrize("association", ["id", "none", "joint"])
def test_landmarks_without_identity_are_passed_on_one_by_one_whatever_becomes_of_them(association):
    b = border(landmarks={"association": association})
    found = (detection(), detection(name=""), detection(name=""))
    assert [s.id for s in heard(b, "detections", detections(*found)).sightings] == ["a", "", ""]
    assert counted(b) == {}


def test_an_input_that_is_not_used_is_not_there():
    with pytest.raises(KeyError):
        border(detections={"use": "none"}).convert("detections", detections(detection()))


# -- poses in the map -----------------------------------------------------------------------------------------------


def located(dimensions=2, *links, type_name=POSE, **settings):
    return listening(
        "mocap", f"geometry_msgs/msg/{type_name}", *links, dimensions=dimensions, settings={"use": "fix", **settings}
    )


def test_a_pose_in_the_map_is_a_fix_with_its_covariance_in_its_own_tangent_space():
    planar = np.array([[0.04, 0.003, 0.002], [0.003, 0.01, -0.001], [0.002, -0.001, 0.02]])
    full = np.zeros((6, 6))
    full[np.ix_([0, 1, 5], [0, 1, 5])] = planar
    m = heard(located(), "mocap", posed(POSE, pose(3.0, 4.0, 9.0, quaternion(yaw=0.8)), covariance=full))
    assert (type(m), m.stamp_ns, m.topic, m.kind) == (Fix, STAMP_NS, "mocap", "pose")
    assert m.measured == pytest.approx((3.0, 4.0, 0.8))
    into = se2.adjoint((0.0, 0.0, -0.8))
    assert matrix(m.covariance, 3) == pytest.approx(into @ planar @ into.T)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_pose_of_a_sensor_in_a_linked_frame_is_that_of_the_base_and_so_are_samples_of_it(dimensions):
    hall = ("map", "hall", (10.0, 5.0, 0.0), quaternion(yaw=1.2))
    mount = (0.4, -0.2, 0.3, 0.0, 0.0, 0.7)
    b = located(dimensions, hall, mount=" ".join(map(str, mount)))
    covariance, q = spread(6, 5), quaternion(yaw=2.0)
    m = heard(b, "mocap", posed(POSE, pose(1.0, 2.0, 0.5, q), "hall", covariance))
    T_map_hall = (*hall[2], *numbers(hall[3]))
    T_sensor_base = se3.inverse((*mount[:3], *numbers(quaternion(yaw=0.7))))

    def base(T_hall_sensor):
        T = se3.compose(se3.compose(T_map_hall, T_hall_sensor), T_sensor_base)
        if dimensions == 3:
            return T
        x, y, _ = so3.act(se3.rotation(T), (1.0, 0.0, 0.0))
        return T[0], T[1], np.arctan2(y, x)

    assert m.measured == pytest.approx(base((1.0, 2.0, 0.5, *numbers(q))))
    group = se3 if dimensions == 3 else se2
    tangent = np.cov(np.stack(group.local(base(samples_of((1.0, 2.0, 0.5, *numbers(q)), covariance)), m.measured)))
    assert matrix(m.covariance, len(tangent)) == pytest.approx(tangent, abs=0.03 * tangent.max())


def test_a_pose_of_unknown_orientation_is_the_position_of_the_mount():
    full = np.diag([0.01, 0.04, 1.0, 1.0, 1.0, 9.0])
    m = heard(located(mount="0.4 0.1 1 0 0 0"), "mocap", posed(POSE, pose(3.0, 4.0), covariance=full))
    assert (m.kind, m.measured, m.point) == ("position", (3.0, 4.0), (0.4, 0.1))
    assert m.covariance == pytest.approx((0.01, 0, 0, 0.04))


def test_a_pose_without_covariance_needs_configured_noise():
    cdr = posed(POSE_STAMPED, pose(3.0, 4.0, 0.0, quaternion(yaw=0.5)))
    b = located(type_name=POSE_STAMPED)
    assert heard(b, "mocap", cdr) is None
    assert counted(b) == {"mocap": {"noise_unknown": 1}}
    m = heard(located(type_name=POSE_STAMPED, sigma_m=0.2), "mocap", cdr)
    assert (m.kind, m.covariance) == ("position", pytest.approx((0.04, 0, 0, 0.04)))
    m = heard(located(type_name=POSE_STAMPED, sigma_m=0.2, sigma_rad=0.1), "mocap", cdr)
    assert (m.kind, m.covariance) == ("pose", pytest.approx((0.04, 0, 0, 0, 0.04, 0, 0, 0, 0.01)))


def test_a_pose_in_a_frame_that_is_not_linked_to_the_map_is_refused():
    b = located()
    assert heard(b, "mocap", posed(POSE, pose(), "lab", np.eye(6))) is None
    assert counted(b) == {"mocap": {"map_frame_unknown": 1}}


def test_a_pose_may_be_a_landmark_of_configured_identity_or_odometry():
    cdr = posed(POSE, pose(2.0, 1.0, 0.0, quaternion(yaw=0.5)), "base_link", np.eye(6) * 0.01)
    name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    s = only(heard(listening("dock", name, settings={"use": "landmarks", "id": "dock"}), "dock", cdr))
    assert (s.id, s.kind, s.measured) == ("dock", "pose", pytest.approx((2.0, 1.0, 0.5)))
    b = listening("vo", "geometry_msgs/msg/PoseStamped", settings={"use": "odometry", "mount": "1 0 0 0 0 0"})
    m = heard(b, "vo", posed(POSE_STAMPED, pose(5.0, 0.0, 0.0, quaternion(yaw=math.pi / 2)), "odom"))
    assert m == Odometry(STAMP_NS, m.T_odom_base, None, "vo")
    assert m.T_odom_base == pytest.approx((5.0, -1.0, math.pi / 2))


# -- satellites -----------------------------------------------------------------------------------------------------


def test_east_north_up_of_a_published_pair_of_points_is_the_published_range_azimuth_and_elevation():
    here = 42.002581974253744, -81.997751960067460, 1139.701799575106
    azimuth, elevation = math.radians(33.0), math.radians(70.0)  # of 1000 m, from 42 N, 82 W, 200 m
    level = 1000.0 * math.cos(elevation)
    expected = level * math.sin(azimuth), level * math.cos(azimuth), 1000.0 * math.sin(elevation)
    assert east_north_up(here, (42.0, -82.0, 200.0)) == pytest.approx(expected, abs=1e-6)


def test_the_first_fix_is_the_datum_where_none_is_configured():
    b = receiver()
    first, second = heard(b, "gps", gnss()), heard(b, "gps", gnss(48.00001, 11.00001, 502.0))
    assert (first.kind, first.measured, first.point) == ("position", (0.0, 0.0, 0.0), ())
    # at 48 degrees a degree of latitude is 111.2 km, one of longitude 74.6 km
    assert second.measured == pytest.approx((0.746, 1.112, 2.0), abs=2e-3)
    assert first.datum == second.datum == (48.0, 11.0, 500.0)
    assert heard(receiver(datum="48 11 400"), "gps", gnss()).measured == pytest.approx((0.0, 0.0, 100.0), abs=1e-6)


def test_in_a_map_that_was_taken_up_fixes_are_from_its_datum():
    b = receiver()
    b.begin_at((48.0, 11.0, 400.0))
    fix = heard(b, "gps", gnss())
    assert fix.measured == pytest.approx((0.0, 0.0, 100.0), abs=1e-6)
    assert fix.datum == (48.0, 11.0, 400.0)


def test_the_covariance_of_a_fix_and_where_its_antenna_sits_are_kept():
    covariance = spread(3, 4)
    antenna = ("base_link", "antenna", (0.2, -0.3, 1.5), quaternion())
    m = heard(receiver(3, antenna), "gps", gnss(covariance=covariance, frame="antenna"))
    assert (matrix(m.covariance, 3), m.point) == (pytest.approx(covariance), (0.2, -0.3, 1.5))
    m = heard(receiver(2, antenna), "gps", gnss(covariance=covariance, frame="antenna"))
    assert (matrix(m.covariance, 2), m.point) == (pytest.approx(covariance[:2, :2]), (0.2, -0.3))


def test_an_antenna_of_which_nothing_is_told_is_at_the_base_and_counted():
    for frame in ("gps", ""):
        b = listening("gps", "sensor_msgs/msg/NavSatFix")
        (fix,) = [*b.convert("gps", gnss(frame=frame)), *b.finish()]
        assert (fix.kind, fix.point) == ("position", ())
        assert counted(b) == {"gps": {"mount_unknown": 1}}
    said = warnings({"gps": {"mount_unknown": 7, "no_altitude": 2}})
    assert said == [
        "gps: 7 times, no transform has the position of the antenna on the robot: the base is assumed;"
        ' mend it by --set gps.mount="X Y Z 0 0 0", its place from the base in metres; zeros say that it is there'
    ]
    told = listening("gps", "sensor_msgs/msg/NavSatFix", settings={"mount": "0 0 0 0 0 0"})
    assert heard(told, "gps", gnss(frame="gps")).point == ()
    assert counted(told) == {}


# -- attitude -------------------------------------------------------------------------------------------------------


def test_an_imu_gives_the_attitude_of_the_base_in_space_and_its_heading_in_the_plane():
    mount = ("base_link", "chip", (0.1, 0.0, 0.0), quaternion(2.0, 0.3, -0.6))
    attitude, covariance = numbers(quaternion(0.1, -0.2, 1.3)), np.diag([0.01, 0.02, 0.09]) + 0.001
    q = so3.compose(attitude, numbers(mount[3]))
    sent = imu(
        make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, q), strict=True))), covariance, "chip"
    )
    m = heard(compass(3, mount), "imu", sent)
    assert (m.kind, m.point) == ("attitude", ())
    assert abs(np.dot(m.measured, attitude)) == pytest.approx(1.0)
    turn = so3.matrix(attitude)
    assert matrix(m.covariance, 3) == pytest.approx(turn.T @ covariance @ turn)
    m = heard(compass(2, mount), "imu", sent)
    assert (m.kind, m.measured) == ("heading", pytest.approx((1.3,)))
    assert m.covariance == pytest.approx((0.091,))


@pytest.mark.parametrize("dimensions", [2, 3])
def test_an_imu_as_gyro_gives_the_rate_about_the_axes_of_the_base(dimensions):
    mount = ("base_link", "chip", (0.1, 0.0, 0.0), quaternion(2.0, 0.3, -0.6))
    turn, covariance = so3.matrix(numbers(mount[3])), np.diag([1e-4, 2e-4, 9e-4]) + 1e-5
    rate = np.array([0.1, -0.2, 0.7])
    sent = imu(quaternion(), -np.eye(3), "chip", rate=tuple(turn.T @ rate), rate_covariance=turn.T @ covariance @ turn)
    m = heard(compass(dimensions, mount, use="gyro"), "imu", sent)
    axes = slice(2, 3) if dimensions == 2 else slice(0, 3)
    assert (m.stamp_ns, m.topic) == (STAMP_NS, "imu")
    assert m.rate == pytest.approx(rate[axes])
    assert matrix(m.covariance, len(m.rate)) == pytest.approx(covariance[axes, axes])
    unknown = imu(quaternion(), np.eye(3), "chip", rate=tuple(turn.T @ rate))
    assert heard(compass(dimensions, mount, use="gyro"), "imu", unknown).covariance is None
    assert heard(compass(dimensions, mount, use="gyro", noise="sigmas"), "imu", sent).covariance is None
    out = compass(dimensions, mount, use="gyro")
    assert out.convert("imu", imu(quaternion(), np.eye(3), "chip", rate=(0.0, math.nan, 0.0))) == []


# -- closures -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_detection_of_where_the_robot_was_is_a_closure_and_so_are_samples_of_it(dimensions):
    lidar = ("base_link", "lidar", (0.3, 0.1, 0.5), quaternion(yaw=0.6))
    covariance, q = spread(6, 6), quaternion(yaw=-1.1)
    earlier = STAMP_NS - 60_000_000_000
    found = detection(pose(2.0, -1.0, 0.2, q), covariance, name=str(earlier))
    m = heard(closing(dimensions, lidar), "loops", detections(found, frame="lidar"))
    assert (type(m), m.stamp_ns, m.from_stamp_ns, m.topic) == (Closure, STAMP_NS, earlier, "loops")

    def robot(T_lidar_earlier):
        T = se3.inverse(se3.compose((*lidar[2], *numbers(lidar[3])), T_lidar_earlier))
        if dimensions == 3:
            return T
        x, y, _ = so3.act(se3.rotation(T), (1.0, 0.0, 0.0))
        return T[0], T[1], np.arctan2(y, x)

    assert m.T_from_base == pytest.approx(robot((2.0, -1.0, 0.2, *numbers(q))))
    group = se3 if dimensions == 3 else se2
    drawn = robot(samples_of((2.0, -1.0, 0.2, *numbers(q)), covariance))
    tangent = np.cov(np.stack(group.local(drawn, m.T_from_base)))
    assert matrix(m.covariance, len(tangent)) == pytest.approx(tangent, abs=0.03 * tangent.max())


# -- transforms -----------------------------------------------------------------------------------------------------


def test_frames_of_a_prefix_are_landmarks_in_their_parent_each_at_its_stamp_once():
    b = listening("tags", TF, mast(), settings={"use": "landmarks", "frame_prefix": "tag36h11:", "sigma_m": 0.2})
    sent = [("mast", "tag36h11:3", (2.0, 1.0, 0.5), quaternion()), ("mast", "hand", (0, 0, 0), quaternion())]
    s = only(heard(b, "tags", transforms(*sent)))
    expected = so3.matrix(numbers(mast()[3])) @ (2.0, 1.0, 0.5) + np.array(mast()[2])
    assert (s.id, s.kind, s.measured) == ("tag36h11:3", "position", pytest.approx(expected[:2]))
    assert s.covariance == pytest.approx((0.04, 0, 0, 0.04))
    assert heard(b, "tags", transforms(*sent)) is None
    assert counted(b) == {"tags": {"sent_again": 1}}
    assert heard(b, "tags", transforms(*sent, stamp_ns=STAMP_NS + 1)).stamp_ns == STAMP_NS + 1


def test_the_transform_from_odom_to_the_base_is_odometry_and_no_other_is():
    b = border(("foot", "base_link", (0.0, 0.0, 0.2), quaternion()), odom={"type": TF})
    others = [("map", "odom", (9.0, 0, 0), quaternion()), ("base_link", "arm", (1.0, 0, 0), quaternion())]
    m = heard(b, "odom", transforms(*others, ("odom", "foot", (3.0, 4.0, 0.0), quaternion(yaw=0.5))))
    assert m == Odometry(STAMP_NS, m.T_odom_base, None, "odom")
    assert m.T_odom_base == pytest.approx((3.0, 4.0, 0.5))
    assert heard(b, "odom", transforms(*others)) is None
    assert counted(b) == {}
    assert b.not_found("odom") == ""


@pytest.mark.parametrize(
    ("link", "settings", "said"),
    [
        (("wheels", "base_link"), {}, "odom -> base_link has come, but wheels -> base_link: correct frames.odom"),
        (
            ("odom", "chassis"),
            {},
            "odom -> base_link has come, but odom -> chassis: correct frames.odom or frames.base",
        ),
        (("wheels", "foot"), {"frame": "ekf"}, "ekf -> base_link has come, but wheels -> foot: correct odom.frame or"),
        (("map", "base_link"), {}, "odom -> base_link has come: correct frames.odom or frames.base"),
    ],
)
def test_odometry_on_tf_by_other_names_is_said_to_be_missing_with_what_may_be_meant(link, settings, said):
    b = border(("foot", "base_link", (0.0, 0.0, 0.2), quaternion()), odom={"type": TF, **settings})
    assert heard(b, "odom", transforms(("base_link", "arm", (1.0, 0, 0), quaternion()))) is None
    assert heard(b, "odom", transforms((*link, (1.0, 0, 0), quaternion()))) is None
    assert f"no transform {said}" in b.not_found("odom")
    assert b.not_found("detections") == ""


# -- sensors that move ----------------------------------------------------------------------------------------------


MOVING = {"inputs": {"tf": True}}


def turret(at_s, yaw):
    return transforms(
        ("base_link", "turret", (1.0, 0.0, 0.0), quaternion(yaw=yaw)), stamp_ns=STAMP_NS + round(at_s * 1e9)
    )


def seen_by_turret(at_s=0.0):
    return detections(detection(pose(2.0, 0.0)), frame="turret", stamp_ns=STAMP_NS + round(at_s * 1e9))


def test_a_sensor_on_a_joint_is_where_it_was_at_the_stamp_of_what_it_saw():
    b = border(**MOVING)
    b.convert("tf", turret(-0.1, 0.0))
    b.convert("tf", turret(0.1, 1.0))
    for at_s, yaw in ((0.0, 0.5), (0.05, 0.75), (0.1, 1.0)):
        seen = only(heard(b, "detections", seen_by_turret(at_s))).measured
        assert seen == pytest.approx((1.0 + 2.0 * math.cos(yaw), 2.0 * math.sin(yaw)))


def test_what_is_seen_before_tf_has_told_where_the_sensor_was_waits_for_it():
    b = border(**MOVING)
    b.convert("tf", turret(-0.1, 0.0))
    assert heard(b, "detections", seen_by_turret()) is None
    m = heard(b, "tf", turret(0.1, 1.0))
    assert m.stamp_ns == STAMP_NS
    assert only(m).measured == pytest.approx((1.0 + 2.0 * math.cos(0.5), 2.0 * math.sin(0.5)))
    assert counted(b) == {}


def test_what_no_transform_links_is_not_tried_again_with_each_message(monkeypatch):
    b, tried = border(**MOVING, frames={"base": "base_lnk"}), []
    converted = b._converted
    monkeypatch.setattr(b, "_converted", lambda *args: tried.append(args) or converted(*args))
    for k in range(20):
        assert heard(b, "detections", seen_by_turret()) is None
        b.convert("odom", odometry(stamp_ns=STAMP_NS + k))
        b.convert("tf", turret(0.1 * k, 0.0))
    assert len(tried) < 100, "not 20 * 20: a wrong frames.base took 39 s for a recording of two minutes"
    assert b.finish() == []
    assert counted(b)["detections"] == {"frame_unknown": 20}


def test_a_tag_on_tf_that_waits_for_its_sensors_joint_is_not_taken_for_one_that_is_sent_again():
    b = listening("tags", TF, settings={"use": "landmarks", "frame_prefix": "tag"}, **MOVING)
    b.convert("tf", turret(-0.1, 0.0))
    assert heard(b, "tags", transforms(("turret", "tag1", (2.0, 0.0, 0.0), quaternion()))) is None
    assert only(heard(b, "tf", turret(0.1, 0.0))).measured == pytest.approx((3.0, 0.0))
    assert counted(b) == {}


def test_a_configured_mount_does_not_stand_in_for_a_joint_that_tf_is_late_to_tell_of():
    b = border(**MOVING, detections={"mount": "9 0 0 0 0 0"})
    assert only(heard(b, "detections", seen_by_turret())).measured == pytest.approx((11.0, 0.0))
    b.convert("tf", turret(-0.1, 0.0))
    assert heard(b, "detections", seen_by_turret()) is None
    assert only(heard(b, "tf", turret(0.1, 0.0))).measured == pytest.approx((3.0, 0.0))


def test_a_configured_mount_counts_where_tf_knows_the_frame_in_a_tree_of_its_own():
    b = border(("chassis", "eye", (5.0, 0.0, 0.0), quaternion()), detections={"mount": "9 0 0 0 0 0"})
    found = detections(detection(pose(2.0, 0.0), np.eye(6) * 0.01, "dock"), frame="eye", stamp_ns=STAMP_NS)
    assert only(heard(b, "detections", found)).measured[0] == pytest.approx(11.0)
    assert counted(b) == {}


def test_what_tf_never_tells_of_is_refused_when_odometry_has_moved_on_or_ends():
    b = border(**MOVING)
    b.convert("tf", turret(-0.1, 0.0))
    assert heard(b, "detections", seen_by_turret()) is None
    for at_s, refused in ((0.2, {}), (0.21, {"detections": {"transform_gaps": 1}})):
        assert isinstance(heard(b, "odom", odometry(stamp_ns=STAMP_NS + round(at_s * 1e9))), Odometry)
        assert counted(b) == refused
    assert heard(b, "detections", seen_by_turret(-5.0)) is None, "older than all that is known: refused at once"
    assert counted(b) == {"detections": {"transform_gaps": 2}}
    assert heard(b, "detections", seen_by_turret(0.5)) is None
    assert b.finish() == []
    assert counted(b) == {"detections": {"transform_gaps": 3}}


def test_of_what_waits_for_tf_only_so_much_is_kept():
    b = border(**MOVING, ordering={"max_waiting": 3})
    for k in range(5):
        b.convert("detections", seen_by_turret(0.01 * k))
    assert counted(b) == {"detections": {"frame_unknown": 2}}
    assert [m.stamp_ns - STAMP_NS for m in b.convert("tf", turret(0.02, 0.0)) + b.convert("tf", turret(0.1, 0.0))] == [
        20_000_000,
        30_000_000,
        40_000_000,
    ]


def test_what_we_estimate_ourselves_is_no_transform_to_measure_by():
    b = border(**MOVING)
    b.convert("tf", transforms(("map", "base_link", (5.0, 0.0, 0.0), quaternion())))
    assert heard(b, "detections", detections(detection(), frame="map")) is None
    assert b.finish() == []
    assert counted(b) == {"detections": {"frame_unknown": 1}}


# -- anything at all ------------------------------------------------------------------------------------------------

SEEDS = {
    "sensor_msgs/msg/NavSatFix": ("fix", gnss()),
    "sensor_msgs/msg/Imu": ("fix", imu(quaternion(0.1, 0.2, 0.3), np.eye(3) * 0.01)),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("fix", posed(POSE, pose(1.0, 2.0), covariance=np.eye(6) * 0.01)),
    "vision_msgs/msg/Detection3DArray": ("closure", detections(detection(covariance=np.eye(6), name="7"))),
    TF: ("landmarks", transforms(("base_link", "tag1", (1.0, 2.0, 0.0), quaternion()))),
}


@pytest.mark.parametrize("type_name", SEEDS)
@pytest.mark.parametrize("dimensions", [2, 3])
def test_whatever_bytes_come_nothing_nonfinite_leaves_and_nothing_is_raised(type_name, dimensions):
    use, seed = SEEDS[type_name]

    @settings(max_examples=200, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(st.lists(st.tuples(st.integers(0, 10_000), NUMBERS), min_size=1, max_size=4))
    def check(edits):
        cdr = bytearray(seed)
        for at, value in edits:
            struct.pack_into("<d", cdr, 4 + 4 * (at % ((len(cdr) - 12) // 4)), value)
        b = listening("any", type_name, dimensions=dimensions, settings={"use": use, "frame_prefix": "tag"})
        for m in b.convert("any", bytes(cdr)):
            record = to_record(m)
            for part in record.pop("sightings", [record]):
                values = [value for value in part.values() if isinstance(value, tuple)]
                assert all(np.isfinite(value).all() for value in values)
                size = math.isqrt(len(part["covariance"]))
                assert np.linalg.eigvalsh(matrix(part["covariance"], size))[0] > 0.0

    check()
