"""What messages may hold, case by case: what is refused, what is repaired, what counts, and what comes of it."""

import math

import numpy as np
import pytest
from messages import (
    STAMP_NS,
    TWIST,
    border,
    closing,
    cloud,
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
    scanner,
    transforms,
)
from rows import each

from graph_slam_ros.graph import LANDMARK_POSITION, RELATIVE_POSE
from graph_slam_ros.lie import so3
from graph_slam_ros.slam import Closure, Config, Control, GraphSlam, Odometry, Sighting, Sightings

S = 1_000_000_000
POSE = "PoseWithCovarianceStamped"
TAG, ONES, ZERO = np.diag([0.01] * 6), np.ones((3, 3)), np.zeros((3, 3))
POLAR = [("id", "i4"), ("range", "f8"), ("bearing", "f8")]
IN_SPACE = [*POLAR, ("elevation", "f8")]
NAN, INF = math.nan, math.inf


def skew(value):
    return np.array([[0.0, value, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def posing(**settings):
    return listening("pose", f"geometry_msgs/msg/{POSE}", settings=settings)


def ranging(dimensions=2):
    return scanner(dimensions, sigma_m=0.1, sigma_rad=0.1)


def diagonal(flat):
    return np.diag(np.reshape(flat, (math.isqrt(len(flat)), -1)))


def turned(norm):
    return pose(q=quaternion(norm=norm))


def fixed(parent, child, x=0.0, norm=1.0):
    return transforms((parent, child, (x, 0.0, 0.0), quaternion(norm=norm)))


ODOMETRY = [  # of odometry, each is refused for this reason and no other
    *(("A1", "nonfinite", {"at": at}) for at in (pose(NAN, 0.0), pose(0.0, -INF), pose(0.0, 0.0, NAN), turned(NAN))),
    ("A1", "too_far", {"at": pose(1e200, 0.0)}),
    ("A2", "nonfinite_covariance", {"twist": np.diag([0.04, NAN, 0.02])}),
    ("A4", "zero_quaternion", {"at": turned(0.0)}),
    *(("A6", "denormal_quaternion", {"at": turned(norm)}) for norm in (0.89, 1.11, 1e-150)),
    ("A6", "nonfinite", {"at": turned(1e200)}),  # its square is not finite
    ("A8", "covariance_asymmetric", {"twist": TWIST + skew(1e-3)}),
    ("A9", "covariance_not_positive_definite", {"twist": np.diag([0.04, -0.01, 0.02])}),
    ("A9", "covariance_not_positive_definite", {"twist": ONES - 1e-6 * np.eye(3)}),
    *(("A14", "frame_empty", {which: ""}) for which in ("frame", "child")),
    ("A15", "odom_frame_unknown", {"frame": "world"}),
    ("A17", "child_frame_unknown", {"child": "wheel"}),
    ("A19", "frame_in_itself", {"frame": "base_link"}),
    ("A19", "frame_in_itself", {"child": "odom"}),
]
DETECTIONS = [  # of a message with another, which is used
    ("A1", "nonfinite", {"at": pose(NAN, 0.0)}),
    ("A1", "too_far", {"at": pose(-1e10, 0.0)}),
    ("A2", "nonfinite_covariance", {"covariance": np.diag([0.01, INF])}),
    ("A4", "zero_quaternion", {"at": turned(0.0), "covariance": TAG}),
    ("A6", "denormal_quaternion", {"at": turned(2.0), "covariance": TAG}),
    ("A8", "covariance_asymmetric", {"covariance": [[0.01, 0.005], [0.0, 0.01]]}),
    ("A9", "covariance_not_positive_definite", {"covariance": [[0.01, 0.02], [0.02, 0.01]]}),
    ("A15", "frame_unknown", {"frame": "camera"}),
    ("A20", "id_too_long", {"name": "ä" * 65}),
]
SPACE, NO_TURN = lambda: compass(3), np.diag([-1.0, 0.0, 0.0])
STILL = imu(quaternion(), ZERO, rate_covariance=NO_TURN)
OTHERS = [
    ("A1", "nonfinite", posing, "pose", posed(POSE, pose(INF, 0.0), covariance=TAG)),
    ("A1", "nonfinite", SPACE, "imu", imu(quaternion(norm=NAN), np.eye(3))),
    ("A1", "nonfinite", ranging, "scan", cloud(POLAR, (1, NAN, 0.0))),
    ("A1", "nonfinite", ranging, "scan", cloud(POLAR, (1, 2.0, INF))),
    ("A1", "nonfinite", lambda: closing(2), "loops", detections(detection(pose(NAN, 0.0), TAG, name="7"))),
    ("A1", "nonfinite", border, "tf_static", fixed("base_link", "a", NAN)),
    ("A4", "zero_quaternion", SPACE, "imu", imu(quaternion(norm=0.0), np.eye(3))),
    ("A4", "zero_quaternion", border, "tf_static", fixed("base_link", "a", norm=0.0)),
    ("A7", "noise_unknown", posing, "pose", posed(POSE, pose(1.0, 2.0), covariance=np.zeros((6, 6)))),
    ("A7", "noise_unknown", SPACE, "imu", imu(quaternion(), ZERO)),
    ("A13", "no_orientation", SPACE, "imu", imu(quaternion(), NO_TURN)),
    ("A13", "no_orientation", lambda: compass(2, sigma_rad=0.1), "imu", imu(quaternion(), NO_TURN)),
    *(("A13", "no_angular_velocity", lambda n=n: compass(n, use="gyro"), "imu", STILL) for n in (2, 3)),
    ("A14", "frame_empty", border, "detections", detections(detection(), frame="")),
    ("A22", "range_not_positive", ranging, "scan", cloud(POLAR, (1, 0.0, 0.2))),
    ("A22", "range_not_positive", ranging, "scan", cloud(POLAR, (1, -2.0, 0.2))),
    *(("A23", "bearing_out_of_range", ranging, "scan", cloud(POLAR, (1, 5.0, far))) for far in (12.6, -12.6, 1e300)),
    ("A23", "bearing_out_of_range", lambda: ranging(3), "scan", cloud(IN_SPACE, (1, 5.0, 12.6, 0.1))),
    ("A23", "bearing_out_of_range", lambda: ranging(3), "scan", cloud(IN_SPACE, (1, 5.0, 0.3, 1.6))),
    ("A31", "no_fix", receiver, "gps", gnss(status=-1)),
    ("A31", "noise_unknown", receiver, "gps", gnss(kind=0)),
    ("A31", "covariance_not_positive_definite", receiver, "gps", gnss(covariance=np.diag([1.0, -1.0, 1.0]))),
    *(
        ("A32", "id_not_a_stamp", lambda: closing(2), "loops", detections(detection(covariance=TAG, name=name)))
        for name in ("dock", "", "9" * 20)
    ),
]


@each("case, reason, given", ODOMETRY)
def test_odometry_that_cannot_be_used_is_refused_and_counted(case, reason, given):
    b = border()
    assert heard(b, "odom", odometry(**given)) is None
    assert counted(b) == {"odom": {reason: 1}}


@each("case, reason, given", DETECTIONS)
def test_a_detection_that_cannot_be_used_is_refused_and_counted_and_others_are_used(case, reason, given):
    b = border()
    m = heard(b, "detections", detections(detection(**given), detection(name="good")))
    assert [s.id for s in m.sightings] == ["good"]
    assert counted(b) == {"detections": {reason: 1}}


@each("case, reason, made, name, cdr", OTHERS)
def test_what_cannot_be_used_of_other_inputs_is_refused_and_counted(case, reason, made, name, cdr):
    b = made()
    assert heard(b, name, cdr) is None
    assert counted(b) == {name: {reason: 1}}


def test_A2_a_covariance_that_is_no_number_is_refused_but_where_another_is_configured():
    nan = np.diag([0.04, NAN, 0.02])
    for name, made, cdr, sigmas in (
        ("gps", receiver, gnss(covariance=nan), [0.3] * 3),
        ("imu", lambda **s: compass(3, **s), imu(quaternion(), nan), [0.1] * 3),
        ("pose", posing, posed(POSE, pose(1.0, 2.0), covariance=np.diag([NAN] * 6)), [0.3, 0.3, 0.1]),
    ):
        b = made()
        assert heard(b, name, cdr) is None
        assert counted(b) == {name: {"nonfinite_covariance": 1}}
        b = made(noise="sigmas", sigma_m=0.3, sigma_rad=0.1)
        assert np.sqrt(diagonal(heard(b, name, cdr).covariance)) == pytest.approx(sigmas)
        assert counted(b) == {}
    b = border(odometry={"noise": "density"})
    assert heard(b, "odom", odometry(twist=nan)).twist_covariance is None
    assert counted(b) == {}


def test_A7_zero_covariance_means_unknown():
    b = border(landmarks={"sigma_m": 0.3})
    m = heard(b, "detections", detections(detection(covariance=np.zeros((2, 2)))))
    assert only(m).covariance == pytest.approx((0.09, 0.0, 0.0, 0.09))
    for _ in range(2):
        assert heard(b, "odom", odometry(twist=ZERO)).twist_covariance is None, "the densities are used"
    assert counted(b) == {"detections": {"covariance_unknown": 1}, "odom": {"covariance_unknown": 2}}
    told = heard(compass(2, sigma_rad=0.1), "imu", imu(quaternion(), ZERO))
    assert told.covariance == pytest.approx((0.01,))
    assert heard(receiver(sigma_m=3.0), "gps", gnss(kind=0)).covariance == pytest.approx(tuple(9 * np.eye(3).ravel()))


def twist_of(given, dimensions=3):
    """Of a twist covariance: what is made of it, and what is counted."""
    b = border()
    out = heard(b, "odom", odometry(twist=given)).twist_covariance
    return out and np.reshape(out, (3, 3)), counted(b).get("odom", {})


def test_A9_a_covariance_of_too_low_a_rank_gets_a_floor():
    got, counts = twist_of(ONES)  # of rank 1
    assert np.linalg.eigvalsh(got) == pytest.approx([3e-9, 3e-9, 3.0], rel=1e-4)
    assert counts == {"covariance_floored": 1}


def test_A12_a_covariance_smaller_than_anything_measured_gets_a_floor_and_an_unknown_axis_takes_nothing_from_others():
    b = border()
    m = heard(b, "detections", detections(detection(covariance=np.diag([5e-324, 1e-310]))))
    assert only(m).covariance == (1e-8, 0.0, 0.0, 1e-8)
    assert counted(b) == {"detections": {"covariance_floored": 1}}
    got, counts = twist_of(np.diag([0.04, 0.0, 1e-300]))
    assert (np.diag(got), counts) == (pytest.approx([0.04, 1e-8, 1e-10], rel=1e-12), {"covariance_floored": 1})
    b = receiver(3)
    got = heard(b, "gps", gnss(covariance=np.diag([4e-6, 4e-6, 1e6]))).covariance
    assert diagonal(got).tolist() == [4e-6, 4e-6, 1e6], "of condition 2.5e11: a fix to 2 mm without a height"
    assert counted(b) == {}


def test_A16_one_leading_slash_is_stripped_and_counted():
    b = border()
    assert heard(b, "odom", odometry(frame="/odom", child="/base_link")).T_odom_base == (0.0, 0.0, 0.0)
    assert counted(b) == {"odom": {"frame_slash_stripped": 2}}
    assert heard(b, "odom", odometry(frame="//odom")) is None
    assert counted(b)["odom"]["odom_frame_unknown"] == 1
    assert heard(b, "odom", odometry(frame="/")) is None
    assert counted(b)["odom"]["frame_empty"] == 1
    b = border(("/base_link", "/wheel", (0.5, 0.0, 0.0), quaternion()))
    assert heard(b, "odom", odometry(child="wheel")).T_odom_base == pytest.approx((-0.5, 0.0, 0.0))
    assert counted(b) == {"tf_static": {"frame_slash_stripped": 2}}


def test_A17_A18_the_lever_arm_of_a_linked_child_frame_is_applied_also_where_the_child_changes():
    # the wheel is 0.5 m ahead and 0.2 m left of the base, turned by 90 degrees
    b = border(("base_link", "wheel", (0.5, 0.2, 0.1), quaternion(yaw=math.pi / 2)))
    m = heard(b, "odom", odometry(pose(3.0, 4.0, 0.0, quaternion(yaw=math.pi)), child="wheel"))
    # base heading pi - pi/2 = pi/2; base = wheel - R(pi/2) (0.5, 0.2) = (3, 4) - (-0.2, 0.5)
    assert m.T_odom_base == pytest.approx((3.2, 3.5, math.pi / 2))
    assert m.twist_covariance is None, "that of another point of the robot"
    assert counted(b) == {}
    b = border(("base_link", "wheel", (0.5, 0.0, 0.0), quaternion()))
    for k, (child, x) in enumerate((("base_link", 0.0), ("wheel", 1.5))):
        m = heard(b, "odom", odometry(pose(x, 0.0), child=child, stamp_ns=STAMP_NS + k * S))
        assert m.T_odom_base[0] == pytest.approx(k), "no jump of 0.5 m"
    assert heard(b, "odom", odometry(child="arm")) is None
    assert counted(b) == {"odom": {"child_frame_unknown": 1}}
    assert b.unlinked("odom") == (("arm", "base_link"),)


def test_A20_A21_an_identity_is_any_number_or_text_never_cut_with_the_prefix_of_its_input():
    names = ["-5", str(2**31 + 1), str(2**63 - 1), "ä" * 64, "line\nfeed"]
    b = border()
    m = heard(b, "detections", detections(*(detection(name=name) for name in names)))
    assert [s.id for s in m.sightings] == names
    assert counted(b) == {}
    points = [(1.0, k, n) for k, n in enumerate((-5.0, float(2**53), 1.5))]
    m = heard(scanner(sigma_m=0.1), "scan", cloud([("x", "f4"), ("y", "f4"), ("id", "f8")], *points))
    assert [s.id for s in m.sightings] == ["-5", str(2**53), "1.5"]
    m = heard(
        border(detections={"id_prefix": "front/"}), "detections", detections(detection(name="5"), detection(name=""))
    )
    assert [s.id for s in m.sightings] == ["front/5", ""]


def pipeline(**values):
    """No window, exact sightings, a keyframe at each odometry message."""
    base = {"ordering.window_s": 0.0, "landmarks.added_sigma_m": 0.0, "keyframes.min_distance_m": 1e-3}
    return GraphSlam(Config.from_mapping(base | {name.replace("__", "."): value for name, value in values.items()}))


def at(t_s, x=0.0, theta=0.0):
    return Odometry(STAMP_NS + round(t_s * S), (x, 0.0, theta))


def seen(t_s, name="a", where=(2.0, 1.0)):
    return Sightings(
        STAMP_NS + round(t_s * S), "/landmarks", (Sighting(name, "position", where, (0.01, 0.0, 0.0, 0.01)),)
    )


def run(slam, *measurements):
    for m in measurements:
        slam.process(m)
    return slam


def test_A24_what_is_told_twice_is_used_once_and_makes_nothing_surer():
    b = border()
    m = heard(b, "detections", detections(detection(), detection()))
    assert only(m) == only(heard(border(), "detections", detections(detection())))
    assert counted(b) == {"detections": {"id_merged": 1}}
    told = [at(0), seen(0), at(1, 0.5), seen(1, where=(1.5, 1.0))]
    once, twice = run(pipeline(), *told), run(pipeline(), *told, told[1], told[3], told[1], at(2, 1.0))
    assert twice.counters.as_dict() == {"/landmarks": {"duplicate": 3}}
    assert len(twice.view.graph.tables[LANDMARK_POSITION]) == len(once.view.graph.tables[LANDMARK_POSITION]) == 2
    again = run(pipeline(), *told, seen(1, where=(1.5, 1.1)))
    assert len(again.view.graph.tables[LANDMARK_POSITION]) == 3, "another value is another measurement"


def test_A25_repeats_that_agree_are_merged_by_their_information_and_those_that_disagree_are_all_dropped():
    near, wide = np.diag([0.01, 0.04]), np.diag([0.03, 0.04])
    b, pair = border(), (detection(pose(2.0, 1.0), near), detection(pose(2.1, 1.2), wide), detection(name="b"))
    m = heard(b, "detections", detections(*pair))
    assert [s.id for s in m.sightings] == ["a", "b"]
    assert m.sightings[0].measured == pytest.approx((2.025, 1.1))
    assert np.reshape(m.sightings[0].covariance, (2, 2)) == pytest.approx(np.diag([0.0075, 0.02]))
    assert counted(b) == {"detections": {"id_merged": 1}}
    three = [detection(pose(x, 1.0), np.diag([0.01, 0.01])) for x in (2.0, 2.1, 4.0)]
    for repeats in (three, [detection(), detection(covariance=TAG)]):  # or a pose and a point of one name
        b = border()
        m = heard(b, "detections", detections(*repeats, detection(name="b")))
        assert [s.id for s in m.sightings] == ["b"]
        assert counted(b) == {"detections": {"id_conflict": len(repeats)}}
    either_side = [detection(pose(2.0, 1.0, 0.0, quaternion(yaw=math.pi + d)), TAG) for d in (-0.05, 0.05)]
    s = only(heard(border(), "detections", detections(*either_side)))
    assert math.cos(s.measured[2]) == pytest.approx(-1.0)
    assert s.measured[:2] == pytest.approx((2.0, 1.0), abs=1e-12)


def test_A28_of_a_robot_that_leaves_the_plane_the_projection_is_used_and_it_is_counted():
    tilted = pose(1.0, 2.0, 0.0, quaternion(roll=0.4, yaw=0.5))
    for sent, counts in (
        (pose(1.0, 2.0, 0.6, quaternion(yaw=0.5)), {"odom": {"out_of_plane": 1}}),
        (tilted, {"odom": {"out_of_plane": 1}}),
        (pose(1.0, 2.0, -0.4, quaternion(roll=0.2, pitch=0.2, yaw=0.5)), {}),
    ):
        b = border()
        heard(b, "odom", odometry(pose(1.0, 1.9), stamp_ns=STAMP_NS - 10**9))
        assert heard(b, "odom", odometry(sent)).T_odom_base == pytest.approx((1.0, 2.0, 0.5))
        assert counted(b) == counts
    b = posing()
    assert heard(b, "pose", posed(POSE, tilted, covariance=TAG)).measured == pytest.approx((1.0, 2.0, 0.5))
    assert counted(b) == {"pose": {"out_of_plane": 1}}
    b = border(world={"dimensions": 3})
    q = heard(b, "odom", odometry(tilted, twist=np.eye(6))).T_odom_base[3:]
    assert so3.act(q, (0.0, 0.0, 1.0))[2] == pytest.approx(math.cos(0.4))
    assert counted(b) == {}


def test_A32_a_closure_from_where_there_was_no_odometry_is_refused():
    def closure(t_s, from_s):
        stamp_ns, from_ns = (STAMP_NS + round(s * S) for s in (t_s, from_s))
        return Closure(stamp_ns, from_ns, "/loops", (0.0, 0.0, 0.0), tuple(np.diag([0.01] * 3).ravel()))

    slam = run(pipeline(), *(at(k, 0.5 * k) for k in range(10)), closure(9, -1), closure(5, 9.5))
    assert slam.counters.as_dict() == {"/loops": {"from_where_there_was_no_odometry": 2}}
    slam = run(slam, closure(12, 3))
    assert slam.counters["/loops", "from_where_there_was_no_odometry"] == 2, "waits for the odometry of 12 s"
    run(slam, Control("end"))
    assert slam.counters["/loops", "after_odometry"] == 1


def test_A3_A4_A5_what_a_fix_or_a_rotation_lacks_is_unknown_or_repaired_and_counted():
    cdr, b = gnss(altitude=NAN, covariance=np.diag([1.0, 2.0, 3.0])), receiver(3)
    m = heard(b, "gps", cdr)
    assert (m.measured, diagonal(m.covariance).tolist()) == ((0.0, 0.0, 0.0), [1.0, 2.0, 1e6])
    assert counted(b) == {"gps": {"no_altitude": 1}}
    b = receiver(2)
    assert (heard(b, "gps", cdr).measured, counted(b)) == ((0.0, 0.0), {}), "nothing is lost in the plane"
    b = border()
    assert only(heard(b, "detections", detections(detection(pose(2.0, 1.0, 0.0, quaternion(norm=0.0))))))
    assert counted(b) == {}, "of a point the orientation says nothing"
    exact = heard(border(), "odom", odometry(pose(q=quaternion(roll=0.2, yaw=0.7)))).T_odom_base
    for norm in (0.9001, 0.95, 1.0 + 1e-5, 1.0999):
        b = border()
        m = heard(b, "odom", odometry(pose(q=quaternion(roll=0.2, yaw=0.7, norm=norm))))
        assert m.T_odom_base == pytest.approx(exact, abs=1e-12), norm
        assert counted(b) == {"odom": {"quaternion_normalized": 1}}


def test_A8_A10_A11_a_covariance_is_made_symmetric_or_clamped_with_its_correlations_or_left_alone():
    for given, made, counts in (
        (TWIST + skew(2e-4), TWIST + skew(1e-4) + skew(1e-4).T, {"covariance_symmetrized": 1}),
        (TWIST + skew(-0.015) + skew(-0.015).T, TWIST + skew(-0.015) + skew(-0.015).T, {}),
    ):
        assert twist_of(given) == (pytest.approx(made), counts)
    b = border()
    m = heard(b, "detections", detections(detection(covariance=np.array([[4e6, 1e3], [1e3, 1.0]]))))
    assert np.reshape(only(m).covariance, (2, 2)) == pytest.approx(np.array([[1e6, 500.0], [500.0, 1.0]]))
    assert counted(b) == {"detections": {"covariance_clamped": 1}}
    assert twist_of(np.diag([1.7e308, 4e6, 1.0]))[0] is None, "of a twist it is unknown"


def test_A15_A19_a_frame_that_is_not_the_odometrys_is_transformed_where_it_is_linked_and_one_in_itself_is_not():
    b = border(("odom", "start", (10.0, 5.0, 0.0), quaternion(yaw=math.pi / 2)))
    m = heard(b, "odom", odometry(pose(2.0, 1.0, 0.0, quaternion(yaw=0.3)), frame="start"))
    assert m.T_odom_base == pytest.approx((9.0, 7.0, math.pi / 2 + 0.3))
    assert counted(b) == {}
    b = border(("base_link", "mast", (1.0, 0.0, 0.0), quaternion()))
    b.convert("tf_static", fixed("mast", "mast", 9.0))
    assert counted(b) == {"tf_static": {"frame_in_itself": 1}}
    assert only(heard(b, "detections", detections(detection(pose(2.0, 1.0)), frame="mast"))).measured == (3.0, 1.0)


def test_A22_A23_A30_long_ranges_are_used_angles_wrapped_and_of_100_000_landmarks_the_nearest_taken():
    def told(layout, bearing, *tail):
        b = ranging(2 + len(tail))
        return only(heard(b, "scan", cloud(layout, (1, 500.0, bearing, *tail)))).measured, counted(b)

    turn = 2.0 * math.pi
    for layout, tail in ((POLAR, ()), (IN_SPACE, (0.1,))):
        for given in ((0.3 + turn, *tail), (0.3 - turn, *tail), *((0.3, one - turn) for one in tail)):
            right = told(layout, 0.3, *tail)[0]
            assert told(layout, *given) == (pytest.approx(right), {"scan": {"bearing_wrapped": 1}})
        assert told(layout, math.pi, *tail)[1] == {}
        assert right == (500.0, 0.3, *tail)
    b = scanner(sigma_m=0.1)
    points = np.stack([np.linspace(1e3, 1.0, 100_000), np.zeros(100_000), np.arange(100_000.0)], axis=1)
    m = heard(b, "scan", cloud([("x", "f8"), ("y", "f8"), ("id", "f8")], *map(tuple, points.tolist())))
    assert [s.id for s in m.sightings] == [str(k) for k in range(99_000, 100_000)]
    assert counted(b) == {"scan": {"too_many": 99_000}}


def test_A26_A27_odometry_that_jumps_or_begins_anew_begins_a_segment_and_a_robot_that_drives_home_or_turns_does_not():
    slam = run(pipeline(), *(at(0.1 * k, 0.1 * k + (9.0 if k > 5 else 0.0)) for k in range(12)))
    assert slam.counters.as_dict() == {"odometry": {"jump": 1}}
    assert slam.view.segments == [0, 6]
    edges = slam.view.graph.tables[RELATIVE_POSE]
    assert edges.measured.values[5].tolist() == [0.0, 0.0, 0.0], "not of 9.1 m"
    sigmas = np.sqrt(np.diag(np.linalg.inv(edges.sqrt_information.values[5].T @ edges.sqrt_information.values[5])))
    assert sigmas == pytest.approx([10.0, 10.0, 3.0])
    assert np.diff(slam.view.trajectory()[:, 0]).max() < 0.2, "the path goes on where it was"
    there = [at(0.1 * k, 0.02 * abs(30 - k)) for k in range(61)]
    slam = run(pipeline(), *there, *(at(7.0 + 0.1 * k, 0.6, 0.05 * abs(20 - k)) for k in range(41)))
    assert slam.counters.as_dict() == {}
    assert slam.view.segments == [0]
    slam = run(pipeline(), *(at(0.1 * k, 0.02 * k, 0.01 * k) for k in range(31)), at(3.1), at(3.2, 0.02))
    assert slam.counters.as_dict() == {"odometry": {"reset_to_zero": 1}}
    assert slam.view.segments == [0, 31]
    assert slam.view.trajectory()[-1] == pytest.approx(slam.view.trajectory()[30] + [0.02, 0.0, 0.0], abs=0.01)


def test_A33_a_closure_with_itself_within_one_keyframe_or_of_nothing_is_refused_and_the_others_of_its_message_are_not():
    for found, reason in (
        ({"name": str(STAMP_NS)}, "closure_with_itself"),
        ({"name": "5", "results": 0}, "no_result"),
        ({"name": "5", "covariance": np.zeros((6, 6))}, "noise_unknown"),
    ):
        b = closing(2)
        m = heard(b, "loops", detections(detection(**found), detection(covariance=np.eye(6), name="7")))
        assert m.from_stamp_ns == 7
        assert counted(b) == {"loops": {reason: 1}}
    slam, covariance = GraphSlam(Config.from_mapping({"ordering.window_s": 0.0})), tuple(np.diag([0.01] * 3).ravel())
    run(slam, at(0), at(0.1, 0.01), Closure(STAMP_NS + S // 10, STAMP_NS + S // 20, "/loops", (0.0,) * 3, covariance))
    assert slam.counters.as_dict() == {"/loops": {"within_one_keyframe": 1}}
    assert not slam.view.graph.edges_of("closures").size
