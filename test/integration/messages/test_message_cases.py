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

from graph_slam_ros.graph import LANDMARK_POSITION, RELATIVE_POSE
from graph_slam_ros.lie import so3
from graph_slam_ros.slam import Closure, Config, Control, GraphSlam, Odometry, Sighting, Sightings

S = 1_000_000_000
POSE = "PoseWithCovarianceStamped"
TAG = np.diag([0.01] * 6)
POLAR = [("id", "i4"), ("range", "f8"), ("bearing", "f8")]
IN_SPACE = [*POLAR, ("elevation", "f8")]


def skew(value):
    """An entry above the diagonal alone."""
    return np.array([[0.0, value, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def posing(**settings):
    """A border that hears of the robot's pose in the map."""
    return listening("pose", f"geometry_msgs/msg/{POSE}", settings=settings)


def refused(reason, *odometries):
    """Each of these is, by a border of its own, for this reason and no other."""
    for cdr in odometries:
        b = border()
        assert heard(b, "odom", cdr) is None
        assert counted(b) == {"odom": {reason: 1}}


def left_out(reason, *found):
    """Each of these detections is, and the other of its message is not."""
    for bad in found:
        b = border()
        m = heard(b, "detections", detections(bad, detection(name="good")))
        assert [s.id for s in m.sightings] == ["good"]
        assert counted(b) == {"detections": {reason: 1}}


def none_of(b, name, cdr, reason):
    """Nothing comes of the message, and it is counted for this reason alone."""
    assert heard(b, name, cdr) is None
    assert counted(b) == {name: {reason: 1}}


def diagonal(flat):
    """Of a covariance."""
    return np.diag(np.reshape(flat, (math.isqrt(len(flat)), -1)))


# -- positions and rotations -------------------------------------------------------------------------------------------


def test_A1_a_position_that_is_no_number_or_beyond_any_map_is_refused_on_every_topic():
    refused("nonfinite", odometry(pose(math.nan, 0.0)), odometry(pose(0.0, -math.inf)))
    refused("nonfinite", odometry(pose(0.0, 0.0, math.nan)), odometry(pose(q=quaternion(norm=math.nan))))
    refused("too_far", odometry(pose(1e200, 0.0)))
    left_out("nonfinite", detection(pose(math.nan, 0.0)))
    left_out("too_far", detection(pose(-1e10, 0.0)))
    none_of(posing(), "pose", posed(POSE, pose(math.inf, 0.0), covariance=TAG), "nonfinite")
    none_of(receiver(), "gps", gnss(math.nan), "nonfinite")
    none_of(compass(3), "imu", imu(quaternion(norm=math.nan), np.eye(3)), "nonfinite")
    none_of(scanner(sigma_m=1.0, sigma_rad=1.0), "scan", cloud(POLAR, (1, math.nan, 0.0)), "nonfinite")
    none_of(scanner(sigma_m=1.0, sigma_rad=1.0), "scan", cloud(POLAR, (1, 2.0, math.inf)), "nonfinite")
    earlier = detection(pose(math.nan, 0.0), TAG, name="7")
    none_of(closing(2), "loops", detections(earlier), "nonfinite")
    none_of(border(), "tf_static", transforms(("base_link", "a", (math.nan, 0.0, 0.0), quaternion())), "nonfinite")


def test_A2_a_covariance_that_is_no_number_is_refused_but_where_another_is_configured():
    nan, inf = np.diag([0.04, math.nan, 0.02]), np.diag([0.01, math.inf])
    refused("nonfinite_covariance", odometry(twist=nan))
    left_out("nonfinite_covariance", detection(covariance=inf))
    inputs = {
        "gps": (receiver, gnss(covariance=nan)),
        "imu": (lambda **s: compass(3, **s), imu(quaternion(), nan)),
        "pose": (posing, posed(POSE, pose(1.0, 2.0), covariance=np.diag([math.nan] * 6))),
    }
    for name, (made, cdr) in inputs.items():
        none_of(made(), name, cdr, "nonfinite_covariance")
        b = made(noise="sigmas", sigma_m=0.3, sigma_rad=0.1)
        told = np.sqrt(diagonal(heard(b, name, cdr).covariance))
        assert told == pytest.approx({"gps": [0.3] * 3, "imu": [0.1] * 3, "pose": [0.3, 0.3, 0.1]}[name])
        assert counted(b) == {}
    b = border(odometry={"noise": "density"})
    assert heard(b, "odom", odometry(twist=nan)).twist_covariance is None
    assert counted(b) == {}


def test_A3_without_an_altitude_the_height_of_a_fix_is_not_known_and_that_is_counted():
    sent = gnss(altitude=math.nan, covariance=np.diag([1.0, 2.0, 3.0]))
    b = receiver(3)
    m = heard(b, "gps", sent)
    assert m.measured == (0.0, 0.0, 0.0)
    assert diagonal(m.covariance).tolist() == [1.0, 2.0, 1e6]
    assert counted(b) == {"gps": {"no_altitude": 1}}
    b = receiver(2)
    assert heard(b, "gps", sent).measured == (0.0, 0.0)
    assert counted(b) == {}, "nothing is lost in the plane"


def test_A4_zero_quaternion():
    refused("zero_quaternion", odometry(pose(q=quaternion(norm=0.0))))
    left_out("zero_quaternion", detection(pose(q=quaternion(norm=0.0)), TAG))
    none_of(compass(3), "imu", imu(quaternion(norm=0.0), np.eye(3)), "zero_quaternion")
    none_of(border(), "tf_static", transforms(("base_link", "a", (0, 0, 0), quaternion(norm=0.0))), "zero_quaternion")
    b = border()
    assert only(heard(b, "detections", detections(detection(pose(2.0, 1.0, 0.0, quaternion(norm=0.0))))))
    assert counted(b) == {}, "of a point the orientation says nothing"


@pytest.mark.parametrize("norm", [0.9001, 0.95, 1.0 + 1e-5, 1.0999])
def test_A5_a_nearly_unit_quaternion_is_normalised_and_counted(norm):
    b = border()
    m = heard(b, "odom", odometry(pose(q=quaternion(roll=0.2, yaw=0.7, norm=norm))))
    exact = heard(border(), "odom", odometry(pose(q=quaternion(roll=0.2, yaw=0.7))))
    assert m.T_odom_base == pytest.approx(exact.T_odom_base, abs=1e-12)
    assert counted(b) == {"odom": {"quaternion_normalized": 1}}


def test_A6_a_quaternion_far_from_unit_length_is_refused():
    refused("denormal_quaternion", *(odometry(pose(q=quaternion(norm=norm))) for norm in (0.89, 1.11, 1e-150)))
    refused("nonfinite", odometry(pose(q=quaternion(norm=1e200))))  # its square is not finite
    left_out("denormal_quaternion", detection(pose(q=quaternion(norm=2.0)), TAG))


# -- covariances -------------------------------------------------------------------------------------------------------


def test_A7_zero_covariance_means_unknown():
    b = border(landmarks={"sigma_m": 0.3})
    m = heard(b, "detections", detections(detection(covariance=np.zeros((2, 2)))))
    assert only(m).covariance == pytest.approx((0.09, 0.0, 0.0, 0.09))
    for _ in range(2):
        assert heard(b, "odom", odometry(twist=np.zeros((3, 3)))).twist_covariance is None, "the densities are used"
    assert counted(b) == {"detections": {"covariance_unknown": 1}, "odom": {"covariance_unknown": 2}}
    none_of(posing(), "pose", posed(POSE, pose(1.0, 2.0), covariance=np.zeros((6, 6))), "noise_unknown")
    none_of(compass(3), "imu", imu(quaternion(), np.zeros((3, 3))), "noise_unknown")
    assert heard(compass(2, sigma_rad=0.1), "imu", imu(quaternion(), np.zeros((3, 3)))).covariance == pytest.approx(
        (0.01,)
    )


def test_A8_a_covariance_that_is_not_symmetric():
    b = border()
    got = heard(b, "odom", odometry(twist=TWIST + skew(2e-4)))
    assert np.reshape(got.twist_covariance, (3, 3)) == pytest.approx(TWIST + skew(1e-4) + skew(1e-4).T)
    assert counted(b) == {"odom": {"covariance_symmetrized": 1}}
    refused("covariance_asymmetric", odometry(twist=TWIST + skew(1e-3)))
    left_out("covariance_asymmetric", detection(covariance=[[0.01, 0.005], [0.0, 0.01]]))


def test_A9_a_covariance_that_is_not_positive_definite():
    b = border()
    ones = np.ones((3, 3))  # of rank 1
    got = heard(b, "odom", odometry(twist=ones))
    assert np.linalg.eigvalsh(np.reshape(got.twist_covariance, (3, 3))) == pytest.approx([3e-9, 3e-9, 3.0], rel=1e-4)
    assert counted(b) == {"odom": {"covariance_floored": 1}}
    refused("covariance_not_positive_definite", odometry(twist=np.diag([0.04, -0.01, 0.02])))
    refused("covariance_not_positive_definite", odometry(twist=ones - 1e-6 * np.eye(3)))
    left_out("covariance_not_positive_definite", detection(covariance=[[0.01, 0.02], [0.02, 0.01]]))


def test_A10_negative_off_diagonals_are_legal():
    b = border()
    twist = TWIST.copy()
    twist[0, 1] = twist[1, 0] = -0.015
    got = heard(b, "odom", odometry(twist=twist)).twist_covariance
    assert np.reshape(got, (3, 3)) == pytest.approx(twist, rel=1e-15)
    assert counted(b) == {}


def test_A11_a_variance_beyond_any_meaning_is_clamped_with_its_correlations():
    b = border()
    m = heard(b, "detections", detections(detection(covariance=np.array([[4e6, 1e3], [1e3, 1.0]]))))
    assert np.reshape(only(m).covariance, (2, 2)) == pytest.approx(np.array([[1e6, 500.0], [500.0, 1.0]]))
    assert counted(b) == {"detections": {"covariance_clamped": 1}}


def test_A11_a_twist_of_which_a_variance_is_beyond_any_meaning_is_unknown():
    b = border()
    assert heard(b, "odom", odometry(twist=np.diag([1.7e308, 4e6, 1.0]))).twist_covariance is None


def test_A12_a_covariance_smaller_than_anything_measured_gets_a_floor_of_a_tenth_of_a_millimetre():
    b = border()
    m = heard(b, "detections", detections(detection(covariance=np.diag([5e-324, 1e-310]))))
    assert only(m).covariance == (1e-8, 0.0, 0.0, 1e-8)
    got = heard(b, "odom", odometry(twist=np.diag([0.04, 0.0, 1e-300]))).twist_covariance
    assert diagonal(got) == pytest.approx([0.04, 1e-8, 1e-10], rel=1e-12)
    assert counted(b) == {"detections": {"covariance_floored": 1}, "odom": {"covariance_floored": 1}}


def test_A12_one_axis_of_which_nothing_is_known_takes_nothing_from_the_others():
    b = receiver(3)
    got = heard(b, "gps", gnss(covariance=np.diag([4e-6, 4e-6, 1e6]))).covariance
    assert diagonal(got).tolist() == [4e-6, 4e-6, 1e6], "of condition 2.5e11: a fix to 2 mm without a height"
    assert counted(b) == {}


def test_A13_an_imu_that_flags_its_orientation_as_absent():
    none_of(compass(3), "imu", imu(quaternion(), np.diag([-1.0, 0.0, 0.0])), "no_orientation")
    none_of(compass(2, sigma_rad=0.1), "imu", imu(quaternion(), np.diag([-1.0, 0.0, 0.0])), "no_orientation")


def test_A13_an_imu_that_flags_its_angular_velocity_as_absent():
    absent = imu(quaternion(), np.zeros((3, 3)), rate_covariance=np.diag([-1.0, 0.0, 0.0]))
    for dimensions in (2, 3):
        none_of(compass(dimensions, use="gyro"), "imu", absent, "no_angular_velocity")


# -- frames ------------------------------------------------------------------------------------------------------------


def test_A14_empty_frames():
    refused("frame_empty", odometry(frame=""), odometry(child=""))
    b = border()
    assert heard(b, "odom", odometry(frame="/")) is None
    assert counted(b) == {"odom": {"frame_empty": 1, "frame_slash_stripped": 1}}
    none_of(border(), "detections", detections(detection(), frame=""), "frame_empty")


def test_A15_a_frame_that_is_not_the_odometrys_is_transformed_where_it_is_linked_and_refused_elsewhere():
    b = border(("odom", "start", (10.0, 5.0, 0.0), quaternion(yaw=math.pi / 2)))
    m = heard(b, "odom", odometry(pose(2.0, 1.0, 0.0, quaternion(yaw=0.3)), frame="start"))
    assert m.T_odom_base == pytest.approx((9.0, 7.0, math.pi / 2 + 0.3))
    assert counted(b) == {}
    refused("odom_frame_unknown", odometry(frame="world"))
    left_out("frame_unknown", detection(frame="camera"))


def test_A16_one_leading_slash_is_stripped_and_counted():
    b = border()
    assert heard(b, "odom", odometry(frame="/odom", child="/base_link")).T_odom_base == (0.0, 0.0, 0.0)
    assert counted(b) == {"odom": {"frame_slash_stripped": 2}}
    assert heard(b, "odom", odometry(frame="//odom")) is None
    assert counted(b)["odom"]["odom_frame_unknown"] == 1
    b = border(("/base_link", "/wheel", (0.5, 0.0, 0.0), quaternion()))
    assert heard(b, "odom", odometry(child="wheel")).T_odom_base == pytest.approx((-0.5, 0.0, 0.0))
    assert counted(b) == {"tf_static": {"frame_slash_stripped": 2}}


def test_A17_the_lever_arm_of_a_linked_child_frame_is_applied_and_one_that_is_not_linked_is_refused():
    # the wheel is 0.5 m ahead and 0.2 m left of the base, turned by 90 degrees
    b = border(("base_link", "wheel", (0.5, 0.2, 0.1), quaternion(yaw=math.pi / 2)))
    m = heard(b, "odom", odometry(pose(3.0, 4.0, 0.0, quaternion(yaw=math.pi)), child="wheel"))
    # base heading pi - pi/2 = pi/2; base = wheel - R(pi/2) (0.5, 0.2) = (3, 4) - (-0.2, 0.5)
    assert m.T_odom_base == pytest.approx((3.2, 3.5, math.pi / 2))
    assert m.twist_covariance is None, "that of another point of the robot"
    assert counted(b) == {}
    refused("child_frame_unknown", odometry(child="wheel"))


def test_A18_a_child_frame_that_changes_is_taken_for_what_it_is_or_refused_and_named():
    b = border(("base_link", "wheel", (0.5, 0.0, 0.0), quaternion()))
    children = {"base_link": 0.0, "wheel": 0.5}
    sent = [
        odometry(pose(k + children[c], 0.0), child=c, stamp_ns=STAMP_NS + k * 10**9) for k, c in enumerate(children)
    ]
    assert [heard(b, "odom", cdr).T_odom_base[0] for cdr in sent] == pytest.approx([0.0, 1.0]), "no jump of 0.5 m"
    assert heard(b, "odom", odometry(child="arm")) is None
    assert counted(b) == {"odom": {"child_frame_unknown": 1}}
    assert b.unlinked("odom") == (("arm", "base_link"),)


def test_A19_a_frame_in_itself():
    refused("frame_in_itself", odometry(frame="base_link"), odometry(child="odom"))
    b = border(("base_link", "mast", (1.0, 0.0, 0.0), quaternion()))
    b.convert("tf_static", transforms(("mast", "mast", (9.0, 0.0, 0.0), quaternion())))
    assert counted(b) == {"tf_static": {"frame_in_itself": 1}}
    assert only(heard(b, "detections", detections(detection(pose(2.0, 1.0)), frame="mast"))).measured == (3.0, 1.0)


# -- landmarks ---------------------------------------------------------------------------------------------------------


def test_A20_an_identity_is_any_number_or_text_of_at_most_128_bytes_and_never_cut():
    names = ["-5", str(2**31 + 1), str(2**63 - 1), "ä" * 64, "line\nfeed"]
    b = border()
    m = heard(b, "detections", detections(*(detection(name=name) for name in names)))
    assert [s.id for s in m.sightings] == names
    assert counted(b) == {}
    left_out("id_too_long", detection(name="ä" * 65))
    layout = [("x", "f4"), ("y", "f4"), ("id", "f8")]
    numbers = [-5.0, float(2**53), 1.5]
    m = heard(scanner(sigma_m=0.1), "scan", cloud(layout, *((1.0, k, n) for k, n in enumerate(numbers))))
    assert [s.id for s in m.sightings] == ["-5", str(2**53), "1.5"]


def test_A21_identities_of_two_inputs_are_kept_apart_by_a_prefix():
    b = border(detections={"id_prefix": "front/"})
    m = heard(b, "detections", detections(detection(name="5"), detection(name="")))
    assert [s.id for s in m.sightings] == ["front/5", ""]


def test_A22_a_range_of_zero_or_less_is_refused_and_a_long_one_is_not():
    for reach in (0.0, -2.0, -math.inf):
        none_of(
            scanner(sigma_m=0.1, sigma_rad=0.1),
            "scan",
            cloud(POLAR, (1, reach, 0.2)),
            "range_not_positive" if math.isfinite(reach) else "nonfinite",
        )
    b = scanner(sigma_m=0.1, sigma_rad=0.1)
    assert only(heard(b, "scan", cloud(POLAR, (1, 500.0, 0.2)))).measured == (500.0, 0.2)
    assert counted(b) == {}


@pytest.mark.parametrize("layout, tail", [(POLAR, ()), (IN_SPACE, (0.1,))], ids=["plane", "space"])
def test_A23_a_bearing_beyond_half_a_turn_is_wrapped_and_one_beyond_two_turns_refused(layout, tail):
    def told(bearing):
        b = scanner(2 + len(tail), sigma_m=0.1, sigma_rad=0.1)
        return heard(b, "scan", cloud(layout, (1, 5.0, bearing, *tail))), counted(b)

    within, _ = told(0.3)
    for turns in (1, -1):
        m, counts = told(0.3 + turns * 2.0 * math.pi)
        assert only(m).measured == pytest.approx(only(within).measured)
        assert counts == {"scan": {"bearing_wrapped": 1}}
    assert told(math.pi)[1] == {}
    for bearing in (12.6, -12.6, 1e300):
        assert told(bearing) == (None, {"scan": {"bearing_out_of_range": 1}})


def test_A23_an_elevation_beyond_the_zenith_is_none():
    b = scanner(3, sigma_m=0.1, sigma_rad=0.1)
    assert heard(b, "scan", cloud(IN_SPACE, (1, 5.0, 0.3, 1.6))) is None
    assert only(heard(b, "scan", cloud(IN_SPACE, (1, 5.0, 0.3, 0.2 - 2.0 * math.pi)))).measured[2] == pytest.approx(0.2)
    assert counted(b) == {"scan": {"bearing_out_of_range": 1, "bearing_wrapped": 1}}


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


def covariance_of(slam, edge_type, row=-1):
    root = slam.graph.tables[edge_type].sqrt_information.values[row]
    return np.linalg.inv(root.T @ root)


def test_A24_what_is_told_twice_is_used_once_and_makes_nothing_surer():
    b = border()
    m = heard(b, "detections", detections(detection(), detection()))
    assert only(m) == only(heard(border(), "detections", detections(detection())))
    assert counted(b) == {"detections": {"id_merged": 1}}
    told = [at(0), seen(0), at(1, 0.5), seen(1, where=(1.5, 1.0))]
    once, twice = run(pipeline(), *told), run(pipeline(), *told, told[1], told[3], told[1], at(2, 1.0))
    assert twice.counters.as_dict() == {"/landmarks": {"duplicate": 3}}
    assert len(twice.graph.tables[LANDMARK_POSITION]) == len(once.graph.tables[LANDMARK_POSITION]) == 2
    again = run(pipeline(), *told, seen(1, where=(1.5, 1.1)))
    assert len(again.graph.tables[LANDMARK_POSITION]) == 3, "another value is another measurement"


def test_A24_of_each_topic_only_the_last_messages_are_remembered():
    slam = run(pipeline(), at(0), *(seen(-1 - k) for k in range(100)), seen(-1), seen(-101), seen(-1), seen(-101))
    assert slam.counters.as_dict() == {"/landmarks": {"before_odometry": 102, "duplicate": 2}}


def test_A25_repeats_that_agree_are_merged_by_their_information():
    b = border()
    pair = (
        detection(pose(2.0, 1.0), np.diag([0.01, 0.04])),
        detection(pose(2.1, 1.2), np.diag([0.03, 0.04])),
        detection(name="b"),
    )
    m = heard(b, "detections", detections(*pair))
    assert [s.id for s in m.sightings] == ["a", "b"]
    assert m.sightings[0].measured == pytest.approx((2.025, 1.1))
    assert np.reshape(m.sightings[0].covariance, (2, 2)) == pytest.approx(np.diag([0.0075, 0.02]))
    assert counted(b) == {"detections": {"id_merged": 1}}


def test_A25_repeats_that_disagree_are_all_dropped_and_counted():
    b = border()
    near, near_too, far = (detection(pose(x, 1.0), np.diag([0.01, 0.01])) for x in (2.0, 2.1, 4.0))
    m = heard(b, "detections", detections(near, near_too, far, detection(name="b")))
    assert [s.id for s in m.sightings] == ["b"]
    assert counted(b) == {"detections": {"id_conflict": 3}}


def test_A25_a_pose_and_a_point_of_one_name_are_a_conflict():
    b = border()
    assert heard(b, "detections", detections(detection(), detection(covariance=TAG))) is None
    assert counted(b) == {"detections": {"id_conflict": 2}}


def test_A25_two_poses_either_side_of_half_a_turn_are_merged_between_them():
    pair = [detection(pose(2.0, 1.0, 0.0, quaternion(yaw=math.pi + d)), TAG) for d in (-0.05, 0.05)]
    s = only(heard(border(), "detections", detections(*pair)))
    assert math.cos(s.measured[2]) == pytest.approx(-1.0)
    assert s.measured[:2] == pytest.approx((2.0, 1.0), abs=1e-12)


def test_A30_of_100_000_landmarks_in_one_message_the_nearest_are_taken_and_the_others_counted():
    b = border(landmarks={"max_per_message": 3})
    xs = (5.0, -1.0, math.nan, 40.0, 2.0, -3.0)
    m = heard(b, "detections", detections(*(detection(pose(x, 0.0), name=str(k)) for k, x in enumerate(xs))))
    assert [s.id for s in m.sightings] == ["1", "4", "5"]
    assert counted(b) == {"detections": {"too_many": 3}}
    b = scanner(sigma_m=0.1)
    points = np.stack([np.linspace(1e3, 1.0, 100_000), np.zeros(100_000), np.arange(100_000.0)], axis=1)
    sent = cloud([("x", "f8"), ("y", "f8"), ("id", "f8")], *map(tuple, points.tolist()))
    m = heard(b, "scan", sent)
    assert [s.id for s in m.sightings] == [str(k) for k in range(99_000, 100_000)]
    assert counted(b) == {"scan": {"too_many": 99_000}}


# -- odometry ----------------------------------------------------------------------------------------------------------


def test_A26_a_jump_of_odometry_begins_a_segment_and_is_no_motion():
    drive = [at(0.1 * k, 0.1 * k + (9.0 if k > 5 else 0.0)) for k in range(12)]
    slam = run(pipeline(), *drive)
    assert slam.counters.as_dict() == {"odometry": {"jump": 1}}
    assert slam.segments == [0, 6]
    edges = slam.graph.tables[RELATIVE_POSE]
    assert edges.measured.values[5].tolist() == [0.0, 0.0, 0.0], "not of 9.1 m"
    assert np.sqrt(np.diag(covariance_of(slam, RELATIVE_POSE, 5))) == pytest.approx([10.0, 10.0, 3.0])
    assert np.diff(slam.trajectory()[:, 0]).max() < 0.2, "the path goes on where it was"


@pytest.mark.parametrize("far_s", [0.1, 4.0])
def test_A27_odometry_that_begins_anew_at_zero_does_so_however_near_or_late(far_s):
    drive = [at(0.1 * k, 0.02 * k, 0.01 * k) for k in range(31)]
    slam = run(pipeline(), *drive, at(3.0 + far_s), at(3.1 + far_s, 0.02))
    assert slam.counters.as_dict() == {"odometry": {"reset_to_zero": 1}}
    assert slam.segments == [0, 31]
    assert slam.trajectory()[-1] == pytest.approx(slam.trajectory()[30] + [0.02, 0.0, 0.0], abs=0.01)


def test_A27_a_robot_that_drives_home_or_turns_on_the_spot_has_not_begun_anew():
    there = [at(0.1 * k, 0.02 * abs(30 - k)) for k in range(61)]
    turning = [at(7.0 + 0.1 * k, 0.6, 0.05 * abs(20 - k) - 0.0) for k in range(41)]
    slam = run(pipeline(), *there, *turning)
    assert slam.counters.as_dict() == {}
    assert slam.segments == [0]


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


# -- fixes and closures ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fields, reason",
    [
        ({"status": -1}, "no_fix"),
        ({"kind": 0}, "noise_unknown"),
        ({"latitude": 91.0}, "not_on_earth"),
        ({"longitude": 361.0}, "not_on_earth"),
        ({"latitude": 0.0, "longitude": 0.0}, "no_position"),
        ({"latitude": 50.0}, "far_from_datum"),
        ({"covariance": np.diag([1.0, -1.0, 1.0])}, "covariance_not_positive_definite"),
    ],
)
def test_A31_a_fix_that_cannot_be_used_is_refused_and_counted_under_its_reason(fields, reason):
    none_of(receiver(datum="48 11 500"), "gps", gnss(**fields), reason)


def test_A31_what_is_refused_is_not_the_datum():
    b = receiver()
    assert heard(b, "gps", gnss(0.0, 0.0)) is None
    assert heard(b, "gps", gnss()).measured == (0.0, 0.0, 0.0)
    assert heard(receiver(sigma_m=3.0), "gps", gnss(kind=0)).covariance == pytest.approx(tuple(9 * np.eye(3).ravel()))


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
    for name, reason in (("dock", "id_not_a_stamp"), ("", "id_not_a_stamp"), ("9" * 20, "id_not_a_stamp")):
        none_of(closing(2), "loops", detections(detection(covariance=TAG, name=name)), reason)


@pytest.mark.parametrize(
    "found, reason",
    [
        ({"name": str(STAMP_NS)}, "closure_with_itself"),
        ({"name": "5", "results": 0}, "no_result"),
        ({"name": "5", "covariance": np.zeros((6, 6))}, "noise_unknown"),
    ],
)
def test_A33_a_closure_with_itself_or_of_nothing_is_refused_and_the_others_of_its_message_are_not(found, reason):
    b = closing(2)
    m = heard(b, "loops", detections(detection(**found), detection(covariance=np.eye(6), name="7")))
    assert m.from_stamp_ns == 7
    assert counted(b) == {"loops": {reason: 1}}


def test_A33_a_closure_within_one_keyframe_is_no_edge():
    slam = GraphSlam(Config.from_mapping({"ordering.window_s": 0.0}))
    covariance = tuple(np.diag([0.01, 0.01, 0.01]).ravel())
    close = Closure(STAMP_NS + S // 10, STAMP_NS + S // 20, "/loops", (0.0, 0.0, 0.0), covariance)
    run(slam, at(0), at(0.1, 0.01), close)
    assert slam.counters.as_dict() == {"/loops": {"within_one_keyframe": 1}}
    assert not slam.graph.edges_of("closures").size
