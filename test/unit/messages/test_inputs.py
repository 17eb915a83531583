"""Inputs of every type: CDR bytes in, measurements out, in the plane and in space."""

import math

import numpy as np
import pytest
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
from rows import each

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.measurements.types import Closure, Fix, Odometry
from graph_slam_ros.messages.to_msg import covariance6, make

IN_SPACE = {"world": {"dimensions": 3}}
POSE, POSE_STAMPED, TF = "PoseWithCovarianceStamped", "PoseStamped", "tf2_msgs/msg/TFMessage"
FIX = "sensor_msgs/msg/NavSatFix"


def numbers(q):
    return q.x, q.y, q.z, q.w


def matrix(flat, size):
    return np.reshape(flat, (size, size))


def link(parent="base_link", child="eye", x=0.0, y=0.0, z=0.0, q=None):
    return parent, child, (x, y, z), q or quaternion()


def mast():
    """A sensor that is tilted and turned."""
    return link("base_link", "mast", 0.3, -0.1, 1.0, quaternion(0.4, -0.3, 2.0))


def camera():
    """0.3 m ahead of and 0.1 m left of the base, 1 m up; z forward, x right, y down."""
    q = make("geometry_msgs/msg/Quaternion", x=-0.5, y=0.5, z=-0.5, w=0.5)
    return link("base_link", "camera_optical", 0.3, 0.1, 1.0, q)


def seen(b, *found, **options):
    """What comes of detections."""
    m = heard(b, "detections", detections(*found, **options))
    return m.sightings if m else ()


def spread(size, seed):
    """A covariance with every entry, of about a centimetre and a hundredth of a radian."""
    root = np.random.default_rng(seed).standard_normal((size, size)) * 0.01
    return root @ root.T + 1e-5 * np.eye(size)


def samples_of(T, covariance, n=60_000, seed=7):
    """Poses (7, n) around T, spread as a message says it: position and fixed-axis rotation in the parent's axes."""
    drawn = np.random.default_rng(seed).multivariate_normal(np.zeros(6), covariance, n).T
    turned = so3.compose(so3.exp(tuple(drawn[3:])), se3.rotation(T))
    return (*(np.array(T[:3])[:, None] + drawn[:3]), *turned)


def in_plane(T):
    """Of poses in space, where they have the heading of their x axis."""
    x, y, _ = so3.act(se3.rotation(T), (1.0, 0.0, 0.0))
    return T[0], T[1], np.arctan2(y, x)


def test_odometry_becomes_its_pose_and_the_covariance_of_its_twist():
    twist, b = np.array([[0.04, -0.002, 0.001], [-0.002, 0.01, -0.003], [0.001, -0.003, 0.02]]), border()
    m = heard(b, "odom", odometry(pose(1.5, -2.5, 0.3, quaternion(yaw=2.5)), twist=covariance6(twist, 77.0)))
    assert (m.stamp_ns, m.T_odom_base) == (STAMP_NS, pytest.approx((1.5, -2.5, 2.5)))
    assert matrix(m.twist_covariance, 3) == pytest.approx(twist, rel=1e-15)
    assert counted(b) == {}
    tilted = odometry(pose(q=quaternion(roll=0.3, pitch=0.4, yaw=1.1)))
    assert heard(border(), "odom", tilted).T_odom_base[2] == pytest.approx(1.1), "the heading of its x axis"
    twist, q = spread(6, 1), quaternion(0.3, -0.4, 2.5)
    m = heard(border(**IN_SPACE), "odom", odometry(pose(1.5, -2.5, 0.3, q), twist=twist))
    assert m == Odometry(STAMP_NS, m.T_odom_base, m.twist_covariance, "odom")
    assert m.T_odom_base == pytest.approx((1.5, -2.5, 0.3, *numbers(q)), abs=1e-15)
    assert matrix(m.twist_covariance, 6) == pytest.approx(twist, rel=1e-12)
    arm = (0.5, 0.2, 0.1), quaternion(0.1, 0.2, 0.3)
    m = heard(border(("base_link", "imu", *arm), **IN_SPACE), "odom", odometry(pose(3.0, 4.0, 5.0, q), child="imu"))
    assert se3.compose(m.T_odom_base, (*arm[0], *numbers(arm[1]))) == pytest.approx((3.0, 4.0, 5.0, *numbers(q)))


@each(
    "dimensions, variances",
    [
        (3, (0.04, 0.01, 0.0, 0.1, 0.1, 0.02)),
        (3, (0.04, 0.01, 1e6, 0.1, 0.1, 0.02)),
        *((2, (x, y, 1e6, 1e6, 1e6, turn)) for x, y, turn in ((1e6, 1e6, 1e6), (0.04, 1e6, 0.02), (0.04, 0.01, 1e6))),
    ],
)
def test_A41_a_twist_covariance_that_leaves_out_an_axis_is_not_used(dimensions, variances):
    b = border(world={"dimensions": dimensions})
    assert heard(b, "odom", odometry(twist=np.diag(variances))).twist_covariance is None
    assert counted(b) == {"odom": {"covariance_of_some_axes_unknown": 1}}


def test_a_detection_is_a_point_with_its_covariance_in_the_axes_of_the_base():
    covariance, b = np.array([[0.01, -0.003, 0.0], [-0.003, 0.04, 0.0], [0.0, 0.0, 9.0]]), border()
    m = heard(b, "detections", detections(detection(pose(2.0, 1.0, 0.7), covariance)))
    assert (m.stamp_ns, m.topic, only(m).id, only(m).measured) == (STAMP_NS, "detections", "a", (2.0, 1.0))
    assert matrix(only(m).covariance, 2) == pytest.approx(covariance[:2, :2], rel=1e-15)
    assert seen(b) == (), "a legal sign of life"
    assert counted(b) == {}
    # optical (x right, y down, z ahead) = base (ahead z, left -x, up -y); depth is the uncertain one
    covariance = np.array([[0.01, 0.0, 0.02], [0.0, 0.04, 0.0], [0.02, 0.0, 0.25]])
    (s,) = seen(border(camera()), detection(pose(0.5, 0.2, 4.0), covariance), frame="camera_optical")
    assert s.measured == pytest.approx((4.3, -0.4))
    assert matrix(s.covariance, 2) == pytest.approx(np.array([[0.25, -0.02], [-0.02, 0.01]]))
    covariance, turn = spread(3, 2), so3.matrix(numbers(mast()[3]))
    (s,) = seen(border(mast(), **IN_SPACE), detection(pose(2.0, 1.0, 0.7), covariance, frame="mast"))
    assert (s.kind, s.measured) == ("position", pytest.approx(turn @ (2.0, 1.0, 0.7) + np.array(mast()[2])))
    assert matrix(s.covariance, 3) == pytest.approx(turn @ covariance @ turn.T)

    b = border()
    (s,) = seen(b, detection(results=0, bbox=pose(4.0, -1.0, 0.5)))
    assert (s.measured, s.covariance) == ((4.0, -1.0), pytest.approx((0.01, 0.0, 0.0, 0.01)))
    assert counted(b) == {"detections": {"covariance_unknown": 1}}
    b = border(link("base_link", "mast", 0.0, 0.0, 1.0, quaternion(yaw=math.pi)))
    (s,) = seen(b, detection(pose(2.0, 1.0), frame="/mast"))
    assert s.measured == pytest.approx((-2.0, -1.0)), "its header goes before that of the array"
    assert counted(b) == {"detections": {"frame_slash_stripped": 1}}


def test_the_identity_is_the_id_or_the_class_where_that_is_configured():
    found = detection(name="x", class_id="tag7"), detection(name="y", class_id=""), detection(name="z", results=0)
    assert [s.id for s in seen(border(landmarks={"id_from": "class_id"}), *found)] == ["tag7", "", ""]
    assert [s.id for s in seen(border(), detection(), detection(name=""), detection(name=""))] == ["a", "", ""]


def test_class_and_size_of_a_detection_without_identity_are_kept():
    found = detection(name="", class_id="tree"), detection(name="x", class_id="tree"), detection(name="", results=0)
    assert [(s.id, s.sort) for s in seen(border(), *found)] == [("", "tree"), ("x", ""), ("", "")]
    boxes = (0.2, 0.4, 0.1), (0.3, 0.3, 0.0), (0.0, 0.0, 0.0), (-0.2, 0.4, 0.1), (math.nan, 0.4, 0.1), (1e12, 1.0, 1.0)
    b = border()
    found = seen(b, *(detection(name="", size=box) for box in boxes))
    assert [s.size for s in found] == pytest.approx([0.2, 0.3, 0.0, 0.0, 0.0, 0.0])
    assert counted(b) == {"detections": {"size_unknown": 3}}


def test_links_are_followed_over_several_frames_and_in_both_directions_and_a_loop_of_them_ends():
    b = border(link("body", "base_link", 1.0), link("body", "mast", 3.0))
    b.convert("tf_static", transforms(link("mast", "eye", 0.0, 0.5, 0.0, quaternion(yaw=math.pi / 2))))
    (s,) = seen(b, detection(pose(2.0, 0.0)), frame="eye")
    assert s.measured == pytest.approx((2.0, 2.5))
    b = border(link("a", "b"), link("b", "a"))
    assert seen(b, detection(), frame="a") == ()
    assert counted(b) == {"detections": {"frame_unknown": 1}}


def test_the_tangent_covariance_of_a_tag_is_what_samples_of_its_message_say():
    covariance, q = spread(6, 3), quaternion(0.5, 0.2, -1.0)
    (s,) = seen(border(mast(), **IN_SPACE), detection(pose(2.0, 1.0, 0.7, q), covariance, frame="mast"))
    T_base_mast = (*mast()[2], *numbers(mast()[3]))
    drawn = se3.compose(T_base_mast, samples_of((2.0, 1.0, 0.7, *numbers(q)), covariance))
    assert s.kind == "pose"
    assert matrix(s.covariance, 6) == pytest.approx(
        np.cov(np.stack(se3.local(drawn, s.measured))), abs=0.03 * covariance.max()
    )
    q = quaternion(yaw=0.8)
    (s,) = seen(border(), detection(pose(2.0, 1.0, 0.0, q), covariance))
    drawn = in_plane(samples_of((2.0, 1.0, 0.0, *numbers(q)), covariance))
    assert matrix(s.covariance, 3) == pytest.approx(
        np.cov(np.stack(se2.local(drawn, s.measured))), abs=0.03 * covariance.max()
    )


def test_a_landmark_is_a_pose_only_where_its_orientation_is_known():
    for variance, size in ((0.2499, 3), (0.2501, 2), (0.0, 2), (1e6, 2)):
        (s,) = seen(border(), detection(covariance=np.diag([0.01, 0.04, 1.0, 1.0, 1.0, variance])))
        assert len(s.measured) == size, variance
    flat = detection(pose(2.0, 1.0, 0.0, quaternion(pitch=-math.pi / 2)), np.diag([0.01] * 6))
    assert seen(border(), flat)[0].measured == (2.0, 1.0), "on the floor it has no heading"
    for unknown in (3, 4, 5):
        variances = np.where(np.arange(6) == unknown, 0.26, 0.01)
        assert seen(border(**IN_SPACE), detection(covariance=np.diag(variances)))[0].kind == "position"


@each(
    "sections, complaint",
    [
        ({"odom.type": "nav_msgs/msg/Path"}, "odom.type: 'nav_msgs/msg/Path' is no type of an input: docs/inputs.md"),
        ({"inputs.names": "odom imu", "imu.use": "gyro"}, "imu.type: it has none: imu.type=sensor_msgs/msg/Imu "),
        (
            {"inputs.names": "odom vo", "vo.type": "nav_msgs/msg/Odometry", "vo.topic": "/odom"},
            "vo.topic: /odom is odometry by odom already: name the topic of another odometry, or vo.use=none",
        ),
        ({"odom.use": "landmarks"}, "odom.use: nav_msgs/msg/Odometry can be odometry or fix, not landmarks"),
        ({"odom.use": "none"}, "inputs.names: none of 'odom detections' is used as odometry"),
        ({"odom.mount": "0 0 0 0 0 nan"}, "odom.mount: '0 0 0 0 0 nan' is not 6 numbers"),
        ({"inputs.names": "odom g", "g.type": FIX, "g.datum": "95 0 0"}, r"^g\.datum: latitude \S+ is not in"),
        ({"inputs.names": "odom tf"}, "inputs.names: 'tf' is reserved or given twice"),
        ({"inputs.names": "odom odom"}, "inputs.names: 'odom' is reserved or given twice"),
        ({"inputs.names": "odom a-b"}, "inputs.names: 'a-b' is not a name"),
        ({"gps.topic": "/fix"}, r"did you mean .* 'gps' is not in inputs.names \(odom detections\)"),
    ],
)
def test_what_cannot_be_an_input_is_refused_by_name(sections, complaint):
    with pytest.raises(ConfigError, match=complaint):
        border(**sections)


def test_place_frame_and_noise_may_be_configured():
    turn = so3.matrix(numbers(quaternion(0.1, 0.2, 0.3)))  # roll first, about fixed axes
    mount, found = {"mount": "1 2 3 0.1 0.2 0.3"}, detection(pose(2.0, 1.0, 0.5))
    (s,) = seen(border(**IN_SPACE, detections=mount), found, frame="eye")
    assert s.measured == pytest.approx(turn @ (2.0, 1.0, 0.5) + np.array([1.0, 2.0, 3.0]))
    (s,) = seen(border(link(x=5.0), **IN_SPACE, detections=mount), found, frame="eye")
    assert s.measured == pytest.approx((7.0, 1.0, 0.5)), "tf goes before it"
    assert seen(border(link(x=5.0), detections={"frame": "eye"}), found, frame="nonsense")[0].measured == (7.0, 1.0)
    sigmas, found = {"sigma_m": 0.1, "sigma_per_m": 0.02, "noise": "sigmas"}, detection(pose(3.0, 4.0))
    assert seen(border(detections=sigmas), found)[0].covariance == pytest.approx((0.04, 0, 0, 0.04))
    (s,) = seen(border(detections=sigmas | {"noise": "message"}), found)
    assert s.covariance == pytest.approx((0.01, 0, 0, 0.04))
    with pytest.raises(KeyError):
        seen(border(detections={"use": "none"}), found)


def located(dimensions=2, *links, type_name=POSE, **settings):
    given = {"use": "fix", **settings}
    return listening("mocap", f"geometry_msgs/msg/{type_name}", *links, dimensions=dimensions, settings=given)


@each("dimensions", [2, 3])
def test_a_pose_of_a_sensor_in_a_linked_frame_is_a_fix_of_the_base_and_so_are_samples_of_it(dimensions):
    hall = link("map", "hall", 10.0, 5.0, 0.0, quaternion(yaw=1.2))
    b, covariance, q = located(dimensions, hall, mount="0.4 -0.2 0.3 0 0 0.7"), spread(6, 5), quaternion(yaw=2.0)
    m = heard(b, "mocap", posed(POSE, pose(1.0, 2.0, 0.5, q), "hall", covariance))
    T_sensor_base = se3.inverse((0.4, -0.2, 0.3, *numbers(quaternion(yaw=0.7))))

    def base(T_hall_sensor):
        T = se3.compose(se3.compose((*hall[2], *numbers(hall[3])), T_hall_sensor), T_sensor_base)
        return T if dimensions == 3 else in_plane(T)

    assert (type(m), m.stamp_ns, m.topic, m.kind) == (Fix, STAMP_NS, "mocap", "pose")
    assert m.measured == pytest.approx(base((1.0, 2.0, 0.5, *numbers(q))))
    group = se3 if dimensions == 3 else se2
    tangent = np.cov(np.stack(group.local(base(samples_of((1.0, 2.0, 0.5, *numbers(q)), covariance)), m.measured)))
    assert matrix(m.covariance, len(tangent)) == pytest.approx(tangent, abs=0.03 * tangent.max())


def test_a_pose_of_unknown_orientation_is_the_position_of_the_mount_and_one_without_noise_needs_sigmas():
    full = np.diag([0.01, 0.04, 1.0, 1.0, 1.0, 9.0])
    m = heard(located(mount="0.4 0.1 1 0 0 0"), "mocap", posed(POSE, pose(3.0, 4.0), covariance=full))
    assert (m.kind, m.measured, m.point) == ("position", (3.0, 4.0), (0.4, 0.1))
    assert m.covariance == pytest.approx((0.01, 0, 0, 0.04))
    cdr, b = posed(POSE_STAMPED, pose(3.0, 4.0, 0.0, quaternion(yaw=0.5))), located(type_name=POSE_STAMPED)
    assert heard(b, "mocap", cdr) is None
    assert counted(b) == {"mocap": {"noise_unknown": 1}}
    m = heard(located(type_name=POSE_STAMPED, sigma_m=0.2), "mocap", cdr)
    assert (m.kind, m.covariance) == ("position", pytest.approx((0.04, 0, 0, 0.04)))
    m = heard(located(type_name=POSE_STAMPED, sigma_m=0.2, sigma_rad=0.1), "mocap", cdr)
    assert (m.kind, m.covariance) == ("pose", pytest.approx((0.04, 0, 0, 0, 0.04, 0, 0, 0, 0.01)))
    b = located()
    assert heard(b, "mocap", posed(POSE, pose(), "lab", np.eye(6))) is None
    assert counted(b) == {"mocap": {"map_frame_unknown": 1}}


def test_a_pose_may_be_a_landmark_of_configured_identity_or_odometry():
    cdr = posed(POSE, pose(2.0, 1.0, 0.0, quaternion(yaw=0.5)), "base_link", np.eye(6) * 0.01)
    dock = listening("dock", f"geometry_msgs/msg/{POSE}", settings={"use": "landmarks", "id": "dock"})
    s = only(heard(dock, "dock", cdr))
    assert (s.id, s.kind, s.measured) == ("dock", "pose", pytest.approx((2.0, 1.0, 0.5)))
    vo = {"use": "odometry", "mount": "1 0 0 0 0 0"}
    b = listening("vo", f"geometry_msgs/msg/{POSE_STAMPED}", settings=vo)
    m = heard(b, "vo", posed(POSE_STAMPED, pose(5.0, 0.0, 0.0, quaternion(yaw=math.pi / 2)), "odom"))
    assert m == Odometry(STAMP_NS, m.T_odom_base, None, "vo")
    assert m.T_odom_base == pytest.approx((5.0, -1.0, math.pi / 2))


def test_the_datum_is_configured_or_that_of_the_map():
    assert heard(receiver(datum="48 11 400"), "gps", gnss()).measured == pytest.approx((0.0, 0.0, 100.0), abs=1e-6)
    b = receiver()
    b.begin_at((48.0, 11.0, 400.0))
    fix = heard(b, "gps", gnss())
    assert (fix.measured, fix.datum) == (pytest.approx((0.0, 0.0, 100.0), abs=1e-6), (48.0, 11.0, 400.0))
    covariance, antenna = spread(3, 4), link("base_link", "antenna", 0.2, -0.3, 1.5)
    for n in (2, 3):
        m = heard(receiver(n, antenna), "gps", gnss(covariance=covariance, frame="antenna"))
        assert (matrix(m.covariance, n), m.point) == (pytest.approx(covariance[:n, :n]), (0.2, -0.3, 1.5)[:n])


@each("frame, mount, counts", [("gps", "", 1), ("", "", 1), ("gps", "0 0 0 0 0 0", 0)])
def test_A40_an_antenna_of_which_nothing_is_told_is_at_the_base_and_counted(frame, mount, counts):
    b = listening("gps", "sensor_msgs/msg/NavSatFix", settings={"mount": mount} if mount else {})
    (fix,) = [*b.convert("gps", gnss(frame=frame)), *b.finish()]
    assert (fix.kind, fix.point) == ("position", ())
    assert counted(b) == ({"gps": {"mount_unknown": 1}} if counts else {})


CHIP = link("base_link", "chip", 0.1, 0.0, 0.0, quaternion(2.0, 0.3, -0.6))


def test_an_imu_gives_the_attitude_of_the_base_in_space_and_its_heading_in_the_plane():
    attitude, covariance = numbers(quaternion(0.1, -0.2, 1.3)), np.diag([0.01, 0.02, 0.09]) + 0.001
    q = dict(zip("xyzw", map(float, so3.compose(attitude, numbers(CHIP[3]))), strict=True))
    cdr = imu(make("geometry_msgs/msg/Quaternion", **q), covariance, "chip")
    m = heard(compass(3, CHIP), "imu", cdr)
    assert (m.kind, m.point, abs(np.dot(m.measured, attitude))) == ("attitude", (), pytest.approx(1.0))
    turn = so3.matrix(attitude)
    assert matrix(m.covariance, 3) == pytest.approx(turn.T @ covariance @ turn)
    m = heard(compass(2, CHIP), "imu", cdr)
    assert (m.kind, m.measured, m.covariance) == ("heading", pytest.approx((1.3,)), pytest.approx((0.091,)))


@each("dimensions", [2, 3])
def test_an_imu_as_gyro_gives_the_rate_about_the_axes_of_the_base(dimensions):
    turn, covariance = so3.matrix(numbers(CHIP[3])), np.diag([1e-4, 2e-4, 9e-4]) + 1e-5
    rate, axes = np.array([0.1, -0.2, 0.7]), slice(2, 3) if dimensions == 2 else slice(0, 3)

    def told(**settings):
        known = {"rate": tuple(turn.T @ rate), "rate_covariance": turn.T @ covariance @ turn} | settings.pop("imu", {})
        b = compass(dimensions, CHIP, use="gyro", **settings)
        return heard(b, "imu", imu(quaternion(), -np.eye(3), "chip", **known))

    m = told()
    assert (m.stamp_ns, m.topic, m.rate) == (STAMP_NS, "imu", pytest.approx(rate[axes]))
    assert matrix(m.covariance, len(m.rate)) == pytest.approx(covariance[axes, axes])
    assert told(imu={"rate_covariance": (0.0,) * 9}).covariance is None
    assert told(noise="sigmas").covariance is None
    assert told(imu={"rate": (0.0, math.nan, 0.0)}) is None


@each("dimensions", [2, 3])
def test_a_detection_of_where_the_robot_was_is_a_closure_and_so_are_samples_of_it(dimensions):
    lidar = link("base_link", "lidar", 0.3, 0.1, 0.5, quaternion(yaw=0.6))
    covariance, q, earlier = spread(6, 6), quaternion(yaw=-1.1), STAMP_NS - 60_000_000_000
    found = detection(pose(2.0, -1.0, 0.2, q), covariance, name=str(earlier))
    m = heard(closing(dimensions, lidar), "loops", detections(found, frame="lidar"))
    assert (type(m), m.stamp_ns, m.from_stamp_ns, m.topic) == (Closure, STAMP_NS, earlier, "loops")

    def robot(T_lidar_earlier):
        T = se3.inverse(se3.compose((*lidar[2], *numbers(lidar[3])), T_lidar_earlier))
        return T if dimensions == 3 else in_plane(T)

    assert m.T_from_base == pytest.approx(robot((2.0, -1.0, 0.2, *numbers(q))))
    group, drawn = se3 if dimensions == 3 else se2, robot(samples_of((2.0, -1.0, 0.2, *numbers(q)), covariance))
    tangent = np.cov(np.stack(group.local(drawn, m.T_from_base)))
    assert matrix(m.covariance, len(tangent)) == pytest.approx(tangent, abs=0.03 * tangent.max())


def test_frames_of_a_prefix_are_landmarks_in_their_parent_each_at_its_stamp_once():
    b = listening("tags", TF, mast(), settings={"use": "landmarks", "frame_prefix": "tag36h11:", "sigma_m": 0.2})
    told = link("mast", "tag36h11:3", 2.0, 1.0, 0.5), link("mast", "hand")
    s = only(heard(b, "tags", transforms(*told)))
    expected = so3.matrix(numbers(mast()[3])) @ (2.0, 1.0, 0.5) + np.array(mast()[2])
    assert (s.id, s.kind, s.measured) == ("tag36h11:3", "position", pytest.approx(expected[:2]))
    assert s.covariance == pytest.approx((0.04, 0, 0, 0.04))
    assert heard(b, "tags", transforms(*told)) is None
    assert counted(b) == {"tags": {"sent_again": 1}}
    assert heard(b, "tags", transforms(*told, stamp_ns=STAMP_NS + 1)).stamp_ns == STAMP_NS + 1


FOOT = link("foot", "base_link", 0.0, 0.0, 0.2)


def test_the_transform_from_odom_to_the_base_is_odometry_and_no_other_is():
    b, others = border(FOOT, odom={"type": TF}), [link("map", "odom", 9.0), link("base_link", "arm", 1.0)]
    m = heard(b, "odom", transforms(*others, link("odom", "foot", 3.0, 4.0, 0.0, quaternion(yaw=0.5))))
    assert m == Odometry(STAMP_NS, m.T_odom_base, None, "odom")
    assert m.T_odom_base == pytest.approx((3.0, 4.0, 0.5))
    assert heard(b, "odom", transforms(*others)) is None
    assert (counted(b), b.not_found("odom")) == ({}, "")


MOVING = {"inputs": {"tf": True}}


def turret(at_s, yaw):
    at = link("base_link", "turret", 1.0, 0.0, 0.0, quaternion(yaw=yaw))
    return transforms(at, stamp_ns=STAMP_NS + round(at_s * 1e9))


def by_turret(b, at_s=0.0):
    """What comes of a detection two metres ahead of the turret."""
    cdr = detections(detection(pose(2.0, 0.0)), frame="turret", stamp_ns=STAMP_NS + round(at_s * 1e9))
    return heard(b, "detections", cdr)


def moving():
    b = border(**MOVING)
    b.convert("tf", turret(-0.1, 0.0))
    return b


def test_a_sensor_on_a_joint_is_where_it_was_at_the_stamp_of_what_it_saw_which_waits_until_tf_has_told_it():
    b = moving()
    assert by_turret(b) is None
    waited = heard(b, "tf", turret(0.1, 1.0))
    assert (waited.stamp_ns, counted(b)) == (STAMP_NS, {})
    for m, yaw in ((waited, 0.5), (by_turret(b, 0.05), 0.75), (by_turret(b, 0.1), 1.0)):
        assert only(m).measured == pytest.approx((1.0 + 2.0 * math.cos(yaw), 2.0 * math.sin(yaw)))


def test_a_configured_mount_stands_in_for_a_frame_that_tf_does_not_link_but_not_for_a_joint_that_is_late():
    b = border(**MOVING, detections={"mount": "9 0 0 0 0 0"})
    assert only(by_turret(b)).measured == pytest.approx((11.0, 0.0))
    b.convert("tf", turret(-0.1, 0.0))
    assert by_turret(b) is None
    assert only(heard(b, "tf", turret(0.1, 0.0))).measured == pytest.approx((3.0, 0.0))
    b = border(link("chassis", "eye", 5.0), detections={"mount": "9 0 0 0 0 0"})
    assert seen(b, detection(pose(2.0, 0.0), np.eye(6) * 0.01), frame="eye")[0].measured[0] == pytest.approx(11.0)
    assert counted(b) == {}


def test_A15_what_tf_never_tells_of_is_refused_when_odometry_has_moved_on_or_ends():
    b = moving()
    assert by_turret(b) is None
    for at_s, refused in ((0.2, {}), (0.21, {"detections": {"transform_gaps": 1}})):
        assert isinstance(heard(b, "odom", odometry(stamp_ns=STAMP_NS + round(at_s * 1e9))), Odometry)
        assert counted(b) == refused
    assert by_turret(b, -5.0) is None, "older than all that is known: refused at once"
    assert counted(b) == {"detections": {"transform_gaps": 2}}
    assert by_turret(b, 0.5) is None
    assert b.finish() == []
    assert counted(b) == {"detections": {"transform_gaps": 3}}

    b = border(**MOVING, ordering={"max_waiting": 3})
    assert [by_turret(b, 0.01 * k) for k in range(5)] == [None] * 5
    assert counted(b) == {"detections": {"frame_unknown": 2}}, "only so much waits"
    late = b.convert("tf", turret(0.02, 0.0)) + b.convert("tf", turret(0.1, 0.0))
    assert [m.stamp_ns - STAMP_NS for m in late] == [20_000_000, 30_000_000, 40_000_000]
