"""The border: real CDR bytes in, measurements out; every refusal and every repair is counted by (source, reason)."""

import json
import math
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from messages import (
    STAMP_NS,
    border,
    counted,
    detection,
    detections,
    heard,
    odometry,
    only,
    pose,
    quaternion,
    transforms,
)

from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.types import from_record, to_record
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.messages.to_msg import covariance6, make
from graph_slam_ros.slam import Config, GraphSlam, Odometry, Sightings

# -- odometry: what is refused, what is repaired --------------------------------------------------------------------


def test_an_odometry_message_becomes_its_planar_pose_and_twist_covariance():
    twist = np.array([[0.04, -0.002, 0.001], [-0.002, 0.01, -0.003], [0.001, -0.003, 0.02]])
    b = border()
    m = heard(b, "odom", odometry(pose(1.5, -2.5, 0.3, quaternion(yaw=2.5)), twist=covariance6(twist, 77.0)))
    assert m.stamp_ns == STAMP_NS
    assert m.T_odom_base == pytest.approx((1.5, -2.5, 2.5))
    assert np.reshape(m.twist_covariance, (3, 3)) == pytest.approx(twist, rel=1e-15)
    assert counted(b) == {}


def test_a_tilted_robot_keeps_the_heading_of_its_x_axis():
    m = heard(border(), "odom", odometry(pose(q=quaternion(roll=0.3, pitch=0.4, yaw=1.1))))
    assert m.T_odom_base[2] == pytest.approx(1.1)


def test_a_repeated_twist_covariance_is_judged_each_time():
    b = border()
    bad = odometry(twist=np.diag([0.04, -0.01, 0.02]))
    assert [heard(b, "odom", cdr) is None for cdr in (bad, bad, odometry(), bad)] == [True, True, False, True]
    assert counted(b) == {"odom": {"covariance_not_positive_definite": 3}}


def test_a_twist_covariance_that_is_not_used_refuses_nothing():
    b = border(odometry={"noise": "density"})
    assert heard(b, "odom", odometry(twist=np.diag([0.04, math.nan, 0.02]))).twist_covariance is None
    assert counted(b) == {}


def test_frames_are_those_of_the_configuration():
    b = border(frames={"odom": "start", "base": "body"})
    assert heard(b, "odom", odometry(frame="start", child="body")) is not None
    assert heard(b, "odom", odometry()) is None


# -- landmarks ------------------------------------------------------------------------------------------------------


def test_a_detection_in_the_base_frame_is_a_point_with_its_planar_covariance():
    covariance = np.array([[0.01, -0.003, 0.0], [-0.003, 0.04, 0.0], [0.0, 0.0, 9.0]])
    b = border()
    m = heard(b, "detections", detections(detection(pose(2.0, 1.0, 0.7), covariance)))
    assert (m.stamp_ns, m.topic) == (STAMP_NS, "detections")
    assert only(m).id == "a"
    assert only(m).measured == (2.0, 1.0)
    assert np.reshape(only(m).covariance, (2, 2)) == pytest.approx(covariance[:2, :2], rel=1e-15)
    assert counted(b) == {}


def test_an_empty_array_is_a_legal_sign_of_life():
    b = border()
    assert heard(b, "detections", detections()) is None
    assert counted(b) == {}


def test_a_detection_without_results_is_the_centre_of_its_box_with_the_default_noise():
    b = border()
    m = heard(b, "detections", detections(detection(results=0, bbox=pose(4.0, -1.0, 0.5))))
    assert only(m).measured == (4.0, -1.0)
    assert only(m).covariance == pytest.approx((0.01, 0.0, 0.0, 0.01))
    assert counted(b) == {"detections": {"covariance_unknown": 1}}


def test_the_header_of_a_detection_goes_before_that_of_its_array():
    b = border(("base_link", "mast", (0.0, 0.0, 1.0), quaternion(yaw=math.pi)))
    m = heard(b, "detections", detections(detection(pose(2.0, 1.0), frame="/mast")))
    assert only(m).measured == pytest.approx((-2.0, -1.0))
    assert counted(b) == {"detections": {"frame_slash_stripped": 1}}


def test_class_id_is_the_identity_where_that_is_configured():
    b = border(landmarks={"id_from": "class_id"})
    found = (detection(name="x", class_id="tag7"), detection(name="y", class_id=""), detection(name="z", results=0))
    assert [s.id for s in heard(b, "detections", detections(*found)).sightings] == ["tag7", "", ""]
    assert counted(b) == {"detections": {"covariance_unknown": 1}}  # of z, which has no result


def test_the_class_of_a_detection_without_identity_is_the_sort_of_its_landmark():
    found = (detection(name="", class_id="tree"), detection(name="x", class_id="tree"), detection(name="", results=0))
    seen = heard(border(), "detections", detections(*found)).sightings
    assert [(s.id, s.sort) for s in seen] == [("", "tree"), ("x", ""), ("", "")]


def test_the_size_of_a_detection_without_identity_is_that_of_its_box():
    boxes = (0.2, 0.4, 0.1), (0.3, 0.3, 0.0), (0.0, 0.0, 0.0), (-0.2, 0.4, 0.1), (math.nan, 0.4, 0.1), (1e12, 1.0, 1.0)
    b = border()
    found = [detection(name="", size=box) for box in boxes]
    seen = heard(b, "detections", detections(*found, detection(name="x", size=boxes[0]))).sightings
    assert [s.size for s in seen] == pytest.approx([0.2, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert counted(b) == {"detections": {"size_unknown": 3}}
    record = json.loads(json.dumps(to_record(heard(border(), "detections", detections(*found[:1], found[2])))))
    assert [one.get("size") for one in record["sightings"]] == [pytest.approx(0.2), None]
    assert [s.size for s in from_record(record).sightings] == [pytest.approx(0.2), 0.0]


def camera():
    """0.3 m ahead of and 0.1 m left of the base, 1 m up; z forward, x right, y down."""
    half = 0.5
    q = make("geometry_msgs/msg/Quaternion", x=-half, y=half, z=-half, w=half)
    return ("base_link", "camera_optical", (0.3, 0.1, 1.0), q)


def test_a_landmark_in_an_optical_frame_arrives_in_the_base_frame_with_its_covariance_turned():
    # optical (x right, y down, z ahead) = base (ahead z, left -x, up -y); depth is the uncertain one
    covariance = np.array([[0.01, 0.0, 0.02], [0.0, 0.04, 0.0], [0.02, 0.0, 0.25]])
    b = border(camera())
    m = heard(b, "detections", detections(detection(pose(0.5, 0.2, 4.0), covariance), frame="camera_optical"))
    assert only(m).measured == pytest.approx((4.3, -0.4))
    assert np.reshape(only(m).covariance, (2, 2)) == pytest.approx(np.array([[0.25, -0.02], [-0.02, 0.01]]))
    assert counted(b) == {}


def test_links_are_followed_over_several_frames_and_in_both_directions():
    b = border(("body", "base_link", (1.0, 0.0, 0.0), quaternion()), ("body", "mast", (3.0, 0.0, 0.0), quaternion()))
    b.convert("tf_static", transforms(("mast", "eye", (0.0, 0.5, 0.0), quaternion(yaw=math.pi / 2))))
    m = heard(b, "detections", detections(detection(pose(2.0, 0.0)), frame="eye"))
    assert only(m).measured == pytest.approx((2.0, 2.5))


def test_a_loop_of_static_transforms_ends():
    b = border(("a", "b", (0, 0, 0), quaternion()), ("b", "a", (0, 0, 0), quaternion()))
    assert heard(b, "detections", detections(detection(), frame="a")) is None
    assert counted(b) == {"detections": {"frame_unknown": 1}}


def test_a_bad_static_transform_is_counted_and_the_others_are_kept():
    b = border(
        ("base_link", "a", (math.nan, 0, 0), quaternion()),
        ("base_link", "b", (0, 0, 0), quaternion(norm=0.0)),
        ("base_link", "", (0, 0, 0), quaternion()),
        ("base_link", "good", (1, 0, 0), quaternion()),
    )
    b.convert("tf_static", b"\x00\x01\x00\x00\xff\xff\xff")
    assert counted(b) == {"tf_static": {"nonfinite": 1, "zero_quaternion": 1, "frame_empty": 1, "undecodable": 1}}
    assert only(heard(b, "detections", detections(detection(pose(2.0, 1.0)), frame="good"))).measured == (3.0, 1.0)


def test_a_tag_of_known_heading_is_a_pose_with_its_covariance_in_its_own_tangent_space():
    covariance = np.zeros((6, 6))
    covariance[np.ix_([0, 1, 5], [0, 1, 5])] = [[0.01, 0.001, 0.002], [0.001, 0.04, -0.003], [0.002, -0.003, 0.09]]
    covariance[[2, 3, 4], [2, 3, 4]] = 1.0
    b = border()
    s = only(
        heard(b, "detections", detections(detection(pose(2.0, 1.0, 0.3, quaternion(yaw=math.pi / 2)), covariance)))
    )
    assert s.measured == pytest.approx((2.0, 1.0, math.pi / 2))
    # the tag's x is the base's y, its y the base's -x
    expected = [[0.04, -0.001, -0.003], [-0.001, 0.01, -0.002], [-0.003, -0.002, 0.09]]
    assert np.reshape(s.covariance, (3, 3)) == pytest.approx(np.array(expected))


def test_the_tangent_covariance_of_a_tag_is_what_samples_of_its_message_say():
    rng, yaw = np.random.default_rng(4), 0.8
    root = rng.standard_normal((3, 3)) * [[0.02], [0.01], [0.02]]
    planar = root @ root.T
    full = covariance6(planar, 0.5).reshape(6, 6)
    s = only(heard(border(), "detections", detections(detection(pose(2.0, 1.0, 0.0, quaternion(yaw=yaw)), full))))
    samples = np.array([2.0, 1.0, yaw]) + rng.multivariate_normal(np.zeros(3), planar, 40_000)
    tangent = np.stack(se2.local(tuple(samples.T), s.measured), axis=1)
    scale = np.sqrt(np.outer(np.diag(planar), np.diag(planar))).max()
    # 40,000 samples: 0.7 %; the curvature of 0.03 rad adds as little
    assert np.cov(tangent.T) == pytest.approx(np.reshape(s.covariance, (3, 3)), abs=0.03 * scale)


def test_a_tag_in_an_optical_frame_has_the_heading_of_its_x_axis_in_the_base():
    # seen by the camera, the tag's x axis points back at it: along the optical -z
    q = quaternion(pitch=math.pi / 2)
    covariance = np.diag([0.01, 0.04, 0.25, 0.03, 0.02, 0.05])
    b = border(camera())
    s = only(heard(b, "detections", detections(detection(pose(0.5, 0.2, 4.0, q), covariance), frame="camera_optical")))
    assert s.measured[:2] == pytest.approx((4.3, -0.4))
    assert abs(s.measured[2]) == pytest.approx(math.pi)
    # the base's z is the optical -y: heading variance 0.02; turned by 180 degrees x and y keep their variances
    assert np.reshape(s.covariance, (3, 3)) == pytest.approx(np.diag([0.25, 0.01, 0.02]), abs=1e-12)


@pytest.mark.parametrize(
    "heading_variance, size", [(0.2499, 3), (0.2501, 2), (0.0, 2), (1e6, 2)], ids=["known", "vague", "zero", "unused"]
)
def test_a_landmark_is_a_pose_only_where_its_heading_is_known(heading_variance, size):
    covariance = np.diag([0.01, 0.04, 1.0, 1.0, 1.0, heading_variance])
    assert len(only(heard(border(), "detections", detections(detection(covariance=covariance)))).measured) == size


def test_a_tag_that_lies_on_the_floor_has_no_heading():
    covariance = np.diag([0.01] * 6)
    b = border()
    flat = detection(pose(2.0, 1.0, 0.0, quaternion(pitch=-math.pi / 2)), covariance)
    assert only(heard(b, "detections", detections(flat))).measured == (2.0, 1.0)


# -- the same landmark twice ----------------------------------------------------------------------------------------


# -- anything at all ------------------------------------------------------------------------------------------------

REPAIRS = {
    "quaternion_normalized",
    "frame_slash_stripped",
    "covariance_unknown",
    "covariance_symmetrized",
    "covariance_floored",
    "covariance_clamped",
    "covariance_of_some_axes_unknown",
}
FUZZ = settings(max_examples=400, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
SEEDS = SimpleNamespace(
    odometry=odometry(pose(1.0, 2.0, 0.0, quaternion(yaw=0.5))),
    detections=detections(
        detection(),
        detection(pose(3.0, 0.0, 0.0, quaternion(yaw=0.4)), np.diag([0.01, 0.02, 0.03, 0.04, 0.05, 0.06]), "tag"),
        detection(pose(1.0, 0.2, 4.0), name="c", frame="camera_optical"),
        detection(name="a"),
    ),
)
NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True, width=64),
    st.sampled_from([0.0, -1.0, 5e-324, 1e-300, 1.7e308, -1.7e308, math.nan, math.inf, 1e154, 1e9]),
)
EDITS = st.lists(
    st.one_of(
        st.tuples(st.just("double"), st.integers(0, 10_000), NUMBERS),
        st.tuples(st.just("byte"), st.integers(0, 10_000), st.integers(0, 255)),
        st.tuples(st.just("cut"), st.integers(0, 10_000), st.just(0)),
    ),
    min_size=1,
    max_size=6,
)


def mutated(cdr, edits):
    out = bytearray(cdr)
    for kind, at, value in edits:
        if kind == "cut":
            del out[4 + at % max(len(out) - 3, 1) :]
        elif kind == "byte" and out:
            out[at % len(out)] = value
        elif kind == "double" and len(out) >= 16:
            struct.pack_into("<d", out, 4 + 8 * (at % ((len(out) - 4) // 8)), value)
    return bytes(out)


def refusals(b, source):
    return sum(n for reason, n in counted(b).get(source, {}).items() if reason not in REPAIRS)


def check_covariance(flat, size):
    matrix = np.reshape(flat, (size, size))
    assert np.isfinite(matrix).all()
    assert np.linalg.eigvalsh(matrix)[0] > 0.0


@FUZZ
@given(EDITS)
def test_whatever_odometry_bytes_come_they_are_accepted_or_counted_and_nothing_nonfinite_leaves(edits):
    b = border(camera())
    m = heard(b, "odom", mutated(SEEDS.odometry, edits))
    assert (m is not None) + refusals(b, "odom") == 1
    if m is not None:
        assert np.isfinite(m.T_odom_base).all()
        assert m.stamp_ns > 0
        if m.twist_covariance is not None:
            check_covariance(m.twist_covariance, 3)


@FUZZ
@given(EDITS)
def test_whatever_detection_bytes_come_each_is_accepted_or_counted_and_nothing_nonfinite_leaves(edits):
    b = border(camera())
    cdr = mutated(SEEDS.detections, edits)
    m = heard(b, "detections", cdr)
    try:
        message = typestore().deserialize_cdr(cdr, "vision_msgs/msg/Detection3DArray")
        sent = len(message.detections)
    except Exception:
        sent = 1  # the whole message is one refusal
    if counted(b).get("detections", {}).keys() & {"undecodable", "zero_stamp", "bad_stamp"}:
        sent = 1
    assert (len(m.sightings) if m else 0) + refusals(b, "detections") == sent
    for s in m.sightings if m else ():
        assert np.isfinite(s.measured).all()
        check_covariance(s.covariance, len(s.measured))


@FUZZ
@given(st.lists(st.tuples(st.booleans(), EDITS), min_size=1, max_size=8))
def test_whatever_comes_the_pipeline_behind_the_border_stays_finite_and_never_raises(messages):
    b = border(camera())
    slam = GraphSlam(Config.from_mapping({"solve": {"every_keyframes": 1}, "ordering": {"window_s": 0.0}}))
    good = [
        Odometry(STAMP_NS - 10**9, (0.0, 0.0, 0.0), None),
        heard(b, "detections", detections(detection(), stamp_ns=STAMP_NS - 10**9)),
    ]
    bad = []
    for is_odometry, edits in messages:
        cdr = mutated(SEEDS.odometry if is_odometry else SEEDS.detections, edits)
        bad.append(heard(b, "odom", cdr) if is_odometry else heard(b, "detections", cdr))
    last = Odometry(STAMP_NS + 10**9, (3.0, 0.0, 0.0), None)
    for m in [*good, *bad, last]:
        if isinstance(m, Odometry | Sightings):
            slam.process(m)
    assert np.isfinite(slam.trajectory()).all()
    assert np.isfinite(slam.pose_covariance).all()
