"""Landmarks from every type of message: point clouds, markers, ranges, and packages that need not be installed."""

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from foreign import DEFINITIONS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from messages import (
    CLOUD,
    STAMP_NS,
    cloud,
    counted,
    heard,
    listening,
    odometry,
    only,
    pose,
    quaternion,
    recorded,
    scanner,
    transforms,
)

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.lie import so3
from graph_slam_ros.messages.to_msg import encode, header, make, vector
from graph_slam_ros.recordings.bag import BagError, Topic
from graph_slam_ros.recordings.definitions import recorded_decoder

MARKERS = "visualization_msgs/msg/MarkerArray"


XYZ = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("id", "u4"), ("sigma", "f8")]


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("height", [1, 2])
def test_a_cloud_is_read_by_name_datatype_offset_step_and_byte_order(big, height):
    points = (1.5, -2.0, 0.25, 7, 0.1), (3.0, 4.0, 0.5, 8, 0.2)
    sent = cloud(XYZ, *points, big=big, height=height, row_padding=5)
    m = heard(scanner(3), "scan", sent)
    assert [(s.id, s.kind, s.measured) for s in m.sightings] == [
        ("7", "position", (1.5, -2.0, 0.25)),
        ("8", "position", (3.0, 4.0, 0.5)),
    ]
    assert m.sightings[1].covariance == pytest.approx(tuple(0.04 * np.eye(3).ravel()))


def test_points_in_the_plane_need_no_height_and_without_sigma_take_the_configured_noise():
    m = heard(scanner(sigma_m=0.3), "scan", cloud([("y", "f8"), ("id", "i2"), ("x", "f8")], (2.0, 5, 1.0)))
    assert (only(m).id, only(m).measured) == ("5", (1.0, 2.0))
    assert only(m).covariance == pytest.approx((0.09, 0, 0, 0.09))


@pytest.mark.parametrize(("name", "size"), [("size", 0.3), ("diameter", 0.3), ("radius", 0.6)])
def test_the_size_of_a_point_without_identity_is_that_of_its_field(name, size):
    at = cloud([("x", "f8"), ("y", "f8"), (name, "f8")], (1.0, 2.0, 0.3))
    assert only(heard(scanner(sigma_m=0.3), "scan", at)).size == size
    polar = cloud([("range", "f8"), ("bearing", "f8"), ("sigma", "f8"), (name, "f8")], (1.0, 0.1, 0.1, 0.3))
    assert only(heard(scanner(sigma_rad=0.1), "scan", polar)).size == size


@pytest.mark.parametrize("name", ["class_id", "class"])
def test_the_class_of_a_point_without_identity_is_that_of_its_field(name):
    at = cloud([("x", "f8"), ("y", "f8"), (name, "i2")], (1.0, 2.0, 4), (3.0, 4.0, -1))
    assert [s.sort for s in heard(scanner(sigma_m=0.3), "scan", at).sightings] == ["4", ""]
    polar = cloud([("range", "f8"), ("bearing", "f8"), ("sigma", "f8"), (name, "u1")], (1.0, 0.1, 0.1, 2))
    assert only(heard(scanner(sigma_rad=0.1), "scan", polar)).sort == "2"
    named = cloud([("x", "f8"), ("y", "f8"), ("id", "u4"), (name, "u1")], (1.0, 2.0, 7, 4))
    assert only(heard(scanner(sigma_m=0.3), "scan", named)).sort == "", "it has an identity"


def test_a_range_and_a_bearing_are_those_of_a_sensor_that_may_be_turned():
    eye = ("base_link", "eye", (1.0, 2.0, 0.5), quaternion(yaw=0.5))
    layout = [("id", "u4"), ("range", "f8"), ("bearing", "f8"), ("sigma", "f8"), ("sigma_bearing", "f8")]
    s = only(heard(scanner(2, eye), "scan", cloud(layout, (3, 4.0, 0.2, 0.1, 0.02), frame="eye")))
    assert (s.id, s.kind, s.measured) == ("3", "range_bearing", pytest.approx((4.0, 0.7)))
    assert s.covariance == pytest.approx((0.01, 0, 0, 0.0004))
    assert s.T_base_sensor == pytest.approx((1.0, 2.0, 0.0))


def test_a_position_has_the_place_of_its_sensor_where_that_may_be_turned():
    eye = ("base_link", "eye", (1.0, 2.0, 0.5), quaternion(yaw=0.5))
    sent = cloud(XYZ, (1.5, -2.0, 0.25, 7, 0.1), frame="eye")
    assert only(heard(scanner(2, eye), "scan", sent)).T_base_sensor is None
    turned = scanner(2, eye, mount_correction="0 0 0 0 0 0.1")
    assert only(heard(turned, "scan", sent)).T_base_sensor == pytest.approx((1.0, 2.0, 0.0))


def test_in_space_a_bearing_needs_an_elevation_and_stays_in_the_frame_of_its_sensor():
    eye = ("base_link", "eye", (1.0, 2.0, 0.5), quaternion(0.1, 0.2, 0.5))
    layout = [("bearing", "f8"), ("elevation", "f8"), ("id", "u1")]
    s = only(heard(scanner(3, eye, sigma_rad=0.02), "scan", cloud(layout, (0.2, 0.1, 3), frame="eye")))
    assert (s.kind, s.measured) == ("bearing", (0.2, 0.1))
    q = quaternion(0.1, 0.2, 0.5)
    assert s.T_base_sensor == pytest.approx((1.0, 2.0, 0.5, q.x, q.y, q.z, q.w))
    assert s.covariance == pytest.approx((0.0004, 0, 0, 0.0004))
    b = scanner(3, eye, sigma_rad=0.02)
    assert heard(b, "scan", cloud([("bearing", "f8"), ("id", "u1")], (0.2, 3), frame="eye")) is None
    assert counted(b) == {"scan": {"no_elevation": 1}}


def test_in_the_plane_a_tilted_sensors_direction_is_levelled():
    """A landmark at a known place: what a tilted sensor tells of it is what a level one there would."""
    roll_pitch_yaw, at, there = (0.3, -0.4, 0.9), np.array([0.5, 0.2, 1.0]), np.array([4.0, -3.0, 2.5])
    q = quaternion(*roll_pitch_yaw)
    local = so3.act(so3.inverse((q.x, q.y, q.z, q.w)), tuple(there - at))
    reach = float(np.linalg.norm(local))
    azimuth, elevation = math.atan2(local[1], local[0]), math.asin(local[2] / reach)
    layout = [("id", "u4"), ("range", "f8"), ("bearing", "f8"), ("elevation", "f8")]
    b = scanner(2, ("base_link", "eye", tuple(at), q), sigma_m=0.1, sigma_rad=0.01)
    s = only(heard(b, "scan", cloud(layout, (1, reach, azimuth, elevation), frame="eye")))
    level = there - at
    assert s.measured == pytest.approx((math.hypot(level[0], level[1]), math.atan2(level[1], level[0])))
    assert heard(b, "scan", cloud(layout[:3], (1, reach, azimuth), frame="eye")) is None
    assert counted(b) == {"scan": {"sensor_tilted": 1}}


def test_a_range_alone_is_a_range():
    s = only(heard(scanner(2), "scan", cloud([("id", "u4"), ("range", "f8"), ("sigma", "f4")], (9, 3.0, 0.5))))
    assert (s.kind, s.measured, s.covariance) == ("range", (3.0,), (0.25,))


@pytest.mark.parametrize(
    "sent, reason",
    [
        (lambda: cloud([("intensity", "f4")], (1.0,)), "fields_unknown"),
        (lambda: cloud(XYZ, (1.0, 2.0, 3.0, 4, 0.1), point_step=10), "fields_beyond_point"),
        (lambda: cloud(XYZ, (1.0, 2.0, 3.0, 4, 0.1), width=2), "cut_off"),
        (lambda: cloud(XYZ, (1.0, 2.0, 3.0, 4, 0.1), width=2**31), "too_many_points"),
        (lambda: cloud(XYZ, (math.nan, 2.0, 3.0, 4, 0.1)), "nonfinite"),
        (lambda: cloud(XYZ, (1.0, 2.0, 3.0, 4, math.nan)), "nonfinite_covariance"),
        (lambda: cloud([("id", "u4"), ("range", "f8")], (1, -2.0)), "range_not_positive"),
        (lambda: cloud([("id", "u4"), ("bearing", "f8")], (1, 0.2)), "noise_unknown"),
    ],
)
def test_a_cloud_that_cannot_be_used_is_counted_under_its_reason(sent, reason):
    b = scanner(2)
    assert heard(b, "scan", sent()) is None
    assert counted(b) == {"scan": {reason: 1}}


@pytest.mark.parametrize("number", [{}, {"id": -1}])
def test_a_point_of_a_cloud_without_a_field_id_or_with_a_negative_one_has_no_identity(number):
    layout = [("x", "f4"), ("y", "f4"), *((name, "i4") for name in number)]
    s = only(heard(scanner(2, sigma_m=0.1), "scan", cloud(layout, (1.0, 2.0, *number.values()))))
    assert (s.id, s.measured) == ("", (1.0, 2.0))


@pytest.mark.parametrize("changes", [{}, {"point_step": 2**32 - 1}])
def test_an_empty_cloud_is_a_legal_sign_of_life_whatever_its_layout(changes):
    b = scanner(2)
    assert heard(b, "scan", cloud(XYZ, **changes)) is None
    assert counted(b) == {}


def test_repeated_bearings_are_merged_across_half_a_turn():
    layout = [("id", "u4"), ("bearing", "f8"), ("sigma", "f8")]
    b = scanner(2)
    s = only(heard(b, "scan", cloud(layout, (1, math.pi - 0.01, 0.02), (1, 0.01 - math.pi, 0.02))))
    assert math.cos(s.measured[0]) == pytest.approx(-1.0)
    assert s.covariance == pytest.approx((0.0002,))
    assert counted(b) == {"scan": {"id_merged": 1}}


# -- markers --------------------------------------------------------------------------------------------------------


def marker(number, action=0, ns="cones", at=None, stamp_ns=STAMP_NS, frame="base_link"):
    nothing = make("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
    colour = make("std_msgs/msg/ColorRGBA", r=1.0, g=0.0, b=0.0, a=1.0)
    return make(
        "visualization_msgs/msg/Marker",
        header=header(stamp_ns, frame),
        ns=ns,
        id=number,
        type=3,
        action=action,
        pose=at or pose(2.0, 1.0),
        scale=vector(1, 1, 1),
        color=colour,
        lifetime=nothing,
        frame_locked=False,
        points=[],
        colors=[],
        texture_resource="",
        texture=make("sensor_msgs/msg/CompressedImage", header=header(0, ""), format="", data=np.zeros(0, np.uint8)),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )


def markers(*several):
    return encode(make(MARKERS, markers=list(several)))


def test_A21_markers_that_are_added_are_landmarks_by_namespace_and_number_and_deleted_ones_are_not():
    b = listening("cones", MARKERS)
    sent = markers(marker(0, 3), marker(1), marker(2, 2), marker(3, ns=""), marker(4, 7))
    m = heard(b, "cones", sent)
    assert [(s.id, s.kind, s.measured) for s in m.sightings] == [
        ("cones/1", "position", (2.0, 1.0)),
        ("3", "position", (2.0, 1.0)),
    ]
    assert counted(b) == {"cones": {"unknown_action": 1}}


def test_markers_of_several_stamps_are_several_measurements():
    b = listening("cones", MARKERS)
    out = b.convert("cones", markers(marker(1), marker(2, stamp_ns=STAMP_NS + 5), marker(3), marker(4, stamp_ns=0)))
    assert [(m.stamp_ns, [s.id for s in m.sightings]) for m in out] == [
        (STAMP_NS, ["cones/1", "cones/3"]),
        (STAMP_NS + 5, ["cones/2"]),
    ]
    assert counted(b) == {"cones": {"zero_stamp": 1}}


# -- packages that need not be there --------------------------------------------------------------------------------

HEAD = header(STAMP_NS, "base_link")


def foreign(type_name, *links, dimensions=2, inputs=None, **settings):
    """(border, maker of parts, encoder of whole messages) of a type that only a recording defines."""
    decode, message, encoded = recorded(type_name, DEFINITIONS[type_name])
    sections = {"dimensions": dimensions, "decoders": {type_name: decode}, "inputs": inputs, "settings": settings}
    return listening("seen", type_name, *links, **sections), message, encoded


def with_covariance(at, diagonal):
    covariance = np.diag(np.asarray(diagonal, dtype=float)).ravel()
    return make("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=covariance)


TAGS = "apriltag_msgs/msg/AprilTagDetectionArray"


def tags_seen(message, encoded, *tags, stamp_ns=STAMP_NS, frame="eye"):
    """An AprilTagDetectionArray of tags (number, hamming, margin)."""
    corner = message("apriltag_msgs/msg/Point", x=0.0, y=0.0)
    parts = [
        message(
            "apriltag_msgs/msg/AprilTagDetection",
            family="tag36h11",
            id=number,
            hamming=hamming,
            goodness=0.0,
            decision_margin=margin,
            centre=corner,
            corners=[corner] * 4,
            homography=np.eye(3).ravel(),
        )
        for number, hamming, margin in tags
    ]
    return encoded(header=header(stamp_ns, frame), detections=parts)


def test_apriltags_are_where_tf_says_at_their_stamp_and_poor_ones_are_left_out():
    eye = ("base_link", "eye", (1.0, 0.0, 0.0), quaternion())
    settings = {"hamming_max": 1, "decision_margin_min": 30.0, "sigma_m": 0.2}
    b, message, encoded = foreign(TAGS, eye, **settings, inputs={"tf": True})
    sent = tags_seen(message, encoded, (3, 0, 60.0), (4, 2, 60.0), (5, 0, 29.0))
    assert heard(b, "seen", sent) is None, "the detector publishes the transforms after the detections"
    m = heard(b, "tf", transforms(("eye", "tag36h11:3", (2.0, 1.0, 0.0), quaternion())))
    assert (only(m).id, only(m).measured) == ("tag36h11:3", pytest.approx((3.0, 1.0)))
    assert only(m).covariance == pytest.approx((0.04, 0, 0, 0.04))
    assert counted(b) == {"seen": {"poor_tag": 2}}


def test_the_mount_of_apriltags_is_that_of_the_camera():
    b, message, encoded = foreign(TAGS, inputs={"tf": True}, mount="0.2 0 0 -1.5707963 0 -1.5707963")
    heard(b, "tf", transforms(("eye", "tag36h11:3", (-1.0, 0.3, 2.0), quaternion())))
    m = heard(b, "seen", tags_seen(message, encoded, (3, 0, 60.0)))
    assert only(m).measured == pytest.approx((2.2, 1.0)), "z of the camera is ahead, x to the right"


@pytest.mark.parametrize("later_s", [11, 300])
def test_a_tag_that_is_seen_again_after_a_while_counts_at_once(later_s):
    eye = ("base_link", "eye", (1.0, 0.0, 0.0), quaternion())
    b, message, encoded = foreign(TAGS, eye, inputs={"tf": True})
    for elapsed_s in range(later_s + 1):
        stamp_ns = STAMP_NS + elapsed_s * 10**9
        b.convert("odom", odometry(stamp_ns=stamp_ns))
        if elapsed_s not in (0, later_s):
            continue
        tag = ("eye", "tag36h11:3", (2.0, 1.0, 0.0), quaternion())
        assert heard(b, "tf", transforms(tag, stamp_ns=stamp_ns)) is None
        m = heard(b, "seen", tags_seen(message, encoded, (3, 0, 60.0), stamp_ns=stamp_ns))
        assert (m.stamp_ns, only(m).measured) == (stamp_ns, pytest.approx((3.0, 1.0)))
    assert "tf" not in counted(b)


def test_aruco_markers_have_headers_of_their_own():
    b, message, encoded = foreign("aruco_msgs/msg/MarkerArray")
    at = with_covariance(pose(2.0, 1.0), [0.01, 0.04, 1, 1, 1, 1])
    parts = [
        message("aruco_msgs/msg/Marker", header=head, id=k, pose=at, confidence=1.0)
        for k, head in ((12, header(0, "")), (13, header(STAMP_NS + 7, "base_link")))
    ]
    first, second = b.convert("seen", encoded(header=HEAD, markers=parts))
    assert (first.stamp_ns, only(first).id, only(first).covariance) == (
        STAMP_NS,
        "12",
        pytest.approx((0.01, 0, 0, 0.04)),
    )
    assert (second.stamp_ns, only(second).id) == (STAMP_NS + 7, "13")


def test_A29_arrays_of_marker_numbers_and_poses_must_be_of_one_length():
    b, _, encoded = foreign("ros2_aruco_interfaces/msg/ArucoMarkers", sigma_m=0.2, sigma_rad=0.1)
    at = pose(2.0, 1.0, 0.0, quaternion(yaw=0.3))
    m = heard(b, "seen", encoded(header=HEAD, marker_ids=np.array([5], np.int64), poses=[at]))
    assert (only(m).id, only(m).kind, only(m).measured) == ("5", "pose", pytest.approx((2.0, 1.0, 0.3)))
    assert only(m).covariance == pytest.approx(tuple(np.diag([0.04, 0.04, 0.01]).ravel()))
    assert heard(b, "seen", encoded(header=HEAD, marker_ids=np.array([5, 6], np.int64), poses=[at])) is None
    assert counted(b) == {"seen": {"lengths_differ": 1}}


def test_aruco_boards_are_landmarks_by_name():
    b, message, encoded = foreign("aruco_opencv_msgs/msg/ArucoDetection")
    single = message("aruco_opencv_msgs/msg/MarkerPose", marker_id=4, pose=pose(1.0, 2.0))
    board = message("aruco_opencv_msgs/msg/BoardPose", board_name="door", pose=pose(3.0, 4.0))
    m = heard(b, "seen", encoded(header=HEAD, markers=[single], boards=[board]))
    assert [(s.id, s.measured) for s in m.sightings] == [("4", (1.0, 2.0)), ("door", (3.0, 4.0))]


def test_poses_of_aruco_markers_have_a_header_each_that_goes_before_that_of_the_marker_and_of_the_array():
    """The detector fills the array's stamp with the time of sending, and the others with that of the image."""
    eye = ("base_link", "eye", (1.0, 0.0, 0.0), quaternion())
    b, message, encoded = foreign("aruco_markers_msgs/msg/MarkerArray", eye, sigma_m=0.2, sigma_rad=0.1)
    own, none = header(STAMP_NS + 7, "eye"), header(0, "")

    def marker_of(number, of_pose, of_marker):
        at = make("geometry_msgs/msg/PoseStamped", header=of_pose, pose=pose(2.0, 1.0, 0.0, quaternion(yaw=0.3)))
        return message("aruco_markers_msgs/msg/Marker", header=of_marker, id=number, pose=at, pixel_x=9.0, pixel_y=9.0)

    parts = [marker_of(1, own, HEAD), marker_of(2, none, own), marker_of(2**32 - 1, none, none)]
    found = [(m.stamp_ns, s) for m in b.convert("seen", encoded(header=HEAD, markers=parts)) for s in m.sightings]
    assert [(stamp_ns, s.id, s.measured[0]) for stamp_ns, s in sorted(found, key=lambda f: f[1].id)] == [
        (STAMP_NS + 7, "1", 3.0),
        (STAMP_NS + 7, "2", 3.0),
        (STAMP_NS, "4294967295", 2.0),
    ]
    assert {s.kind for _, s in found} == {"pose"}
    assert found[0][1].covariance == pytest.approx(tuple(np.diag([0.04, 0.04, 0.01]).ravel()))
    assert counted(b) == {}


def test_fiducial_transforms_are_landmarks_in_the_frame_of_the_camera_as_the_bytes_say():
    """The bytes are written out by the rules of CDR here, not by the encoder that the decoder belongs to."""
    eye = ("base_link", "eye", (1.0, 0.0, 0.5), quaternion())
    b, _, _ = foreign("fiducial_msgs/msg/FiducialTransformArray", eye, sigma_m=0.2, sigma_rad=0.1)
    q = quaternion(yaw=0.3)
    sent = struct.pack("<4sIII4sii", b"\0\1\0\0", STAMP_NS // 10**9, STAMP_NS % 10**9, 4, b"eye\0", 41, 2)
    for number, x in ((7, 2.0), (107, 3.0)):
        sent += struct.pack("<i", number) + b"\0" * (-(len(sent) - 4 + 4) % 8)
        sent += struct.pack("<10d", x, 1.0, 0.0, q.x, q.y, q.z, q.w, 0.5, 0.01, 900.0)
    m = heard(b, "seen", sent)
    assert [(s.id, s.kind, s.measured) for s in m.sightings] == [
        ("7", "pose", pytest.approx((3.0, 1.0, 0.3))),
        ("107", "pose", pytest.approx((4.0, 1.0, 0.3))),
    ]
    assert m.stamp_ns == STAMP_NS
    assert m.sightings[0].covariance == pytest.approx(tuple(np.diag([0.04, 0.04, 0.01]).ravel()))
    assert counted(b) == {}


def test_rtabmaps_landmarks_have_their_own_frame_and_positive_ids():
    b, message, encoded = foreign(
        "rtabmap_msgs/msg/LandmarkDetections", ("base_link", "eye", (1.0, 0.0, 0.0), quaternion())
    )
    at = with_covariance(pose(2.0, 1.0), [0.01] * 6)
    parts = [
        message(
            "rtabmap_msgs/msg/LandmarkDetection",
            header=header(STAMP_NS, "eye"),
            landmark_frame_id="",
            id=k,
            size=0.1,
            pose=at,
        )
        for k in (6, 0)
    ]
    m = heard(b, "seen", encoded(header=HEAD, landmarks=parts))
    assert [s.id for s in m.sightings] == ["6", ""]
    assert {(s.kind, s.measured) for s in m.sightings} == {("pose", (3.0, 1.0, 0.0))}
    assert counted(b) == {}


def test_cartographers_weights_are_inverse_standard_deviations():
    b, message, encoded = foreign("cartographer_ros_msgs/msg/LandmarkList")

    def entry(name, translation, rotation):
        weights = {"translation_weight": translation, "rotation_weight": rotation}
        at = pose(2.0, 1.0, 0.0, quaternion(yaw=0.3))
        return message(
            "cartographer_ros_msgs/msg/LandmarkEntry", id=name, tracking_from_landmark_transform=at, **weights
        )

    parts = [entry("a", 5.0, 0.0), entry("b", 5.0, 20.0), entry("c", 0.0, 0.0), entry("d", math.nan, 0.0)]
    m = heard(b, "seen", encoded(header=HEAD, landmarks=parts))
    assert [(s.id, s.kind) for s in m.sightings] == [("a", "position"), ("b", "pose"), ("c", "position")]
    assert m.sightings[0].covariance == pytest.approx((0.04, 0, 0, 0.04))
    assert np.diag(np.reshape(m.sightings[1].covariance, (3, 3))) == pytest.approx((0.04, 0.04, 0.0025))
    assert counted(b) == {"seen": {"covariance_unknown": 1, "nonfinite_covariance": 1}}


@pytest.mark.parametrize("dimensions", [2, 3])
def test_mrpts_ranges_and_bearings_pitch_down_and_minus_one_is_no_identity(dimensions):
    b, message, encoded = foreign(
        "mrpt_msgs/msg/ObservationRangeBearing", ("base_link", "mast", (1.0, 0, 0), quaternion()),
        dimensions=dimensions,
    )  # fmt: skip
    parts = [
        message("mrpt_msgs/msg/SingleRangeBearingObservation", range=5.0, yaw=0.4, pitch=-0.3, id=k) for k in (8, -1)
    ]
    sent = encoded(
        header=header(STAMP_NS, "mast"),
        sensor_pose_on_robot=pose(0.0, 0.5, 0.2, quaternion(yaw=0.1)),
        min_sensor_distance=0.0,
        max_sensor_distance=10.0,
        sensor_std_range=0.1,
        sensor_std_yaw=0.02,
        sensor_std_pitch=0.03,
        sensed_data=parts,
    )
    s, unnamed = heard(b, "seen", sent).sightings
    assert (s.id, s.kind) == ("8", "range_bearing")
    assert unnamed == replace(s, id="")
    level = math.cos(0.3)
    if dimensions == 3:
        assert s.measured == (5.0, 0.4, 0.3)
        assert np.diag(np.reshape(s.covariance, (3, 3))) == pytest.approx((0.01, 0.0004, 0.0009))
        assert s.T_base_sensor[:3] == pytest.approx((1.0, 0.5, 0.2))
    else:
        assert s.measured == pytest.approx((5.0 * level, 0.5))
        assert np.diag(np.reshape(s.covariance, (2, 2))) == pytest.approx((0.01, (0.02 / level) ** 2))
        assert s.T_base_sensor == pytest.approx((1.0, 0.5, 0.0))
    assert counted(b) == {}


def test_mrpts_beacons_are_ranges():
    b, message, encoded = foreign("mrpt_msgs/msg/ObservationRangeBeacon")
    parts = [message("mrpt_msgs/msg/SingleRangeBeaconObservation", range=5.0, id=2)]
    sent = encoded(
        header=HEAD,
        sensor_pose_on_robot=pose(0.5, 0.0),
        min_sensor_distance=0.0,
        max_sensor_distance=10.0,
        sensor_std_range=0.1,
        sensed_data=parts,
    )
    s = only(heard(b, "seen", sent))
    assert (s.kind, s.measured, s.covariance) == ("range", (5.0,), pytest.approx((0.01,)))
    assert s.T_base_sensor == pytest.approx((0.5, 0.0, 0.0))


def test_a_recorded_definition_that_lacks_what_is_read_is_refused_by_field():
    tags = "apriltag_msgs/msg/AprilTagDetectionArray"
    for type_name, text in (
        (tags, DEFINITIONS[tags].replace("int32 hamming\n", "")),
        ("sensor_msgs/msg/NavSatFix", "std_msgs/Header header\nfloat64 latitude\n"),
    ):
        with pytest.raises(BagError, match=r"of this recording has no field '(hamming|status)'"):
            recorded_decoder(Topic("/t", type_name, 1, text))


@pytest.mark.parametrize(
    "given, remedy",
    [
        ("fiducial_msgs/FiducialTransformArray", "is it fiducial_msgs/msg/FiducialTransformArray?"),
        ("mrpt_msgs/msg/ObservationRange", "is it mrpt_msgs/msg/ObservationRangeBeacon or "),
        ("my_msgs/msg/Tags", "docs/inputs.md has a row for each, and no plugin reads it"),
    ],
)
def test_a_type_that_no_input_reads_is_refused_with_the_one_that_is_meant(given, remedy):
    with pytest.raises(ConfigError) as refused:
        listening("seen", given)
    said = str(refused.value)
    assert said.startswith(f"seen.type: '{given}' is no type of an input: {remedy}")
    assert len(said) < 180, "a line of the command has 200 characters"


def test_a_package_that_is_not_installed_is_refused_by_name():
    from graph_slam_ros.messages.message_class import message_class

    with pytest.raises(ConfigError, match=r"^nobodys_msgs/msg/Thing: nobodys_msgs is not installed here"):
        message_class("nobodys_msgs/msg/Thing")


# -- anything at all ------------------------------------------------------------------------------------------------

POLAR = [("id", "u4"), ("range", "f8"), ("bearing", "f8"), ("sigma", "f8")]
SEEDS = {
    CLOUD: cloud(POLAR, (1, 2.0, 0.3, 0.1), (2, 3.0, 1.0, 1.0)),
    MARKERS: markers(marker(1), marker(2)),
}
NUMBERS = st.sampled_from([0.0, -1.0, 5e-324, 1e-300, 1.7e308, -1.7e308, math.nan, math.inf, 1e154, 1e9, 0.5])
EDITS = st.lists(
    st.one_of(
        st.tuples(st.just("<d"), st.integers(0, 10_000), NUMBERS),
        st.tuples(st.just("<B"), st.integers(0, 10_000), st.integers(0, 255)),
    ),
    min_size=1,
    max_size=5,
)


@pytest.mark.parametrize("type_name", SEEDS)
@pytest.mark.parametrize("dimensions", [2, 3])
def test_whatever_bytes_come_nothing_nonfinite_leaves_and_nothing_is_raised(type_name, dimensions):
    @settings(max_examples=300, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(EDITS)
    def check(edits):
        cdr = bytearray(SEEDS[type_name])
        for kind, at, value in edits:
            size = struct.calcsize(kind)
            struct.pack_into(kind, cdr, 4 + size * (at % ((len(cdr) - 4) // size)), value)
        b = listening("any", type_name, dimensions=dimensions, settings={"sigma_rad": 0.1})
        for m in b.convert("any", bytes(cdr)):
            for s in m.sightings:
                assert np.isfinite(s.measured).all()
                size = math.isqrt(len(s.covariance))
                assert np.linalg.eigvalsh(np.reshape(s.covariance, (size, size)))[0] > 0.0

    check()
