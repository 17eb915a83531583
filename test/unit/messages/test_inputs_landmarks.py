"""Landmarks from every type of message: point clouds, markers, ranges, and packages that need not be installed."""

import itertools
import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from messages import (
    DECODERS,
    STAMP_NS,
    cloud,
    counted,
    heard,
    listening,
    odometry,
    only,
    part,
    pose,
    quaternion,
    scanner,
    sent,
    transforms,
)
from rows import each

from graph_slam_ros.lie import so3
from graph_slam_ros.messages.to_msg import header, make

MARKERS = "visualization_msgs/msg/MarkerArray"
XYZ = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("id", "u4"), ("sigma", "f8")]
TURNED = ("base_link", "eye", (1.0, 2.0, 0.5), quaternion(yaw=0.5))
AHEAD = ("base_link", "eye", (1.0, 0.0, 0.0), quaternion())
HEAD = header(STAMP_NS, "base_link")


def doubles(*names):
    return [(name, "u4" if name == "id" else "f8") for name in names]


@each("big, height", [*itertools.product([False, True], [1, 2])])
def test_a_cloud_is_read_by_name_datatype_offset_step_and_byte_order(big, height):
    points = (1.5, -2.0, 0.25, 7, 0.1), (3.0, 4.0, 0.5, 8, 0.2)
    m = heard(scanner(3), "scan", cloud(XYZ, *points, big=big, height=height, row_padding=5))
    assert [(s.id, s.kind, s.measured) for s in m.sightings] == [
        ("7", "position", (1.5, -2.0, 0.25)),
        ("8", "position", (3.0, 4.0, 0.5)),
    ]
    assert m.sightings[1].covariance == pytest.approx(tuple(0.04 * np.eye(3).ravel()))


def test_points_in_the_plane_need_no_height_nor_sigma_nor_identity():
    m = heard(scanner(sigma_m=0.3), "scan", cloud([("y", "f8"), ("id", "i2"), ("x", "f8")], (2.0, 5, 1.0)))
    assert (only(m).id, only(m).measured, only(m).covariance) == ("5", (1.0, 2.0), pytest.approx((0.09, 0, 0, 0.09)))
    for layout, point in (([], ()), ([("id", "i4")], (-1,))):
        cdr = cloud([("x", "f4"), ("y", "f4"), *layout], (1.0, 2.0, *point))
        assert only(heard(scanner(sigma_m=0.1), "scan", cdr)).id == ""
    for changes in ({}, {"point_step": 2**32 - 1}):
        b = scanner(2)
        assert heard(b, "scan", cloud(XYZ, **changes)) is None, "an empty one is a sign of life"
        assert counted(b) == {}


@each(
    "name, kind, value, told",
    [
        ("size", "f8", 0.3, ("", 0.3)),
        ("diameter", "f8", 0.3, ("", 0.3)),
        ("radius", "f8", 0.3, ("", 0.6)),
        ("class_id", "i2", 4, ("4", 0.0)),
        ("class", "u1", 2, ("2", 0.0)),
        ("class", "i2", -1, ("", 0.0)),
    ],
)
def test_class_and_size_of_a_point_without_identity_are_those_of_its_fields(name, kind, value, told):
    for layout, point in ((doubles("x", "y"), (1.0, 2.0)), (doubles("range", "bearing", "sigma"), (1.0, 0.1, 0.1))):
        b = scanner(sigma_m=0.3, sigma_rad=0.1)
        s = only(heard(b, "scan", cloud([*layout, (name, kind)], (*point, value))))
        assert (s.sort, s.size) == told
    named = cloud([*doubles("x", "y", "id"), (name, kind)], (1.0, 2.0, 7, value))
    assert only(heard(scanner(sigma_m=0.3), "scan", named)).sort == ""


def test_ranges_and_bearings_are_those_of_a_sensor_that_may_be_turned():
    layout = doubles("id", "range", "bearing", "sigma", "sigma_bearing")
    s = only(heard(scanner(2, TURNED), "scan", cloud(layout, (3, 4.0, 0.2, 0.1, 0.02), frame="eye")))
    assert (s.id, s.kind, s.measured) == ("3", "range_bearing", pytest.approx((4.0, 0.7)))
    assert s.covariance == pytest.approx((0.01, 0, 0, 0.0004))
    assert s.T_base_sensor == pytest.approx((1.0, 2.0, 0.0))
    at = cloud(XYZ, (1.5, -2.0, 0.25, 7, 0.1), frame="eye")
    assert only(heard(scanner(2, TURNED), "scan", at)).T_base_sensor == pytest.approx((1.0, 2.0, 0.0))
    s = only(heard(scanner(2), "scan", cloud([("id", "u4"), ("range", "f8"), ("sigma", "f4")], (9, 3.0, 0.5))))
    assert (s.kind, s.measured, s.covariance) == ("range", (3.0,), (0.25,))
    b = scanner(3, TURNED, sigma_rad=0.02)
    s = only(heard(b, "scan", cloud(doubles("bearing", "elevation", "id"), (0.2, 0.1, 3), frame="eye")))
    assert (s.kind, s.measured, s.covariance) == ("bearing", (0.2, 0.1), pytest.approx((0.0004, 0, 0, 0.0004)))
    assert s.T_base_sensor == pytest.approx((1.0, 2.0, 0.5, 0.0, 0.0, math.sin(0.25), math.cos(0.25)))
    assert heard(b, "scan", cloud(doubles("bearing", "id"), (0.2, 3), frame="eye")) is None
    assert counted(b) == {"scan": {"no_elevation": 1}}


def test_in_the_plane_a_tilted_sensors_direction_is_levelled():
    """A landmark at a known place: what a tilted sensor tells of it is what a level one there would."""
    q, at, there = quaternion(0.3, -0.4, 0.9), np.array([0.5, 0.2, 1.0]), np.array([4.0, -3.0, 2.5])
    local = so3.act(so3.inverse((q.x, q.y, q.z, q.w)), tuple(there - at))
    reach = float(np.linalg.norm(local))
    azimuth, elevation = math.atan2(local[1], local[0]), math.asin(local[2] / reach)
    b = scanner(2, ("base_link", "eye", tuple(at), q), sigma_m=0.1, sigma_rad=0.01)
    layout = doubles("id", "range", "bearing")
    s = only(heard(b, "scan", cloud([*layout, *doubles("elevation")], (1, reach, azimuth, elevation), frame="eye")))
    level = there - at
    assert s.measured == pytest.approx((math.hypot(level[0], level[1]), math.atan2(level[1], level[0])))
    assert heard(b, "scan", cloud(layout, (1, reach, azimuth), frame="eye")) is None
    assert counted(b) == {"scan": {"sensor_tilted": 1}}


POINT = (1.0, 2.0, 3.0, 4, 0.1)


@each(
    "cdr, reason",
    [
        (cloud([("intensity", "f4")], (1.0,)), "fields_unknown"),
        (cloud(XYZ, POINT, point_step=10), "fields_beyond_point"),
        (cloud(XYZ, POINT, width=2), "cut_off"),
        (cloud(XYZ, POINT, width=2**31), "too_many_points"),
        (cloud(XYZ, (*POINT[:4], math.nan)), "nonfinite_covariance"),
        (cloud(doubles("id", "bearing"), (1, 0.2)), "noise_unknown"),
    ],
)
def test_A29_a_cloud_that_cannot_be_used_is_counted_under_its_reason(cdr, reason):
    b = scanner(2)
    assert heard(b, "scan", cdr) is None
    assert counted(b) == {"scan": {reason: 1}}


def marker(number, action=0, ns="cones", stamp_ns=STAMP_NS):
    head = header(stamp_ns, "base_link")
    return part("visualization_msgs/msg/Marker", header=head, ns=ns, id=number, action=action, pose=pose(2.0, 1.0))


def test_A21_markers_that_are_added_are_landmarks_by_namespace_and_number_at_their_stamps():
    b = listening("cones", MARKERS)
    told = [marker(0, 3), marker(1), marker(2, 2), marker(3, ns=""), marker(4, 7), marker(5, stamp_ns=STAMP_NS + 5)]
    out = b.convert("cones", sent(MARKERS, markers=[*told, marker(6, stamp_ns=0)]))
    assert [(m.stamp_ns, [(s.id, s.kind, s.measured) for s in m.sightings]) for m in out] == [
        (STAMP_NS, [("cones/1", "position", (2.0, 1.0)), ("3", "position", (2.0, 1.0))]),
        (STAMP_NS + 5, [("cones/5", "position", (2.0, 1.0))]),
    ]
    assert counted(b) == {"cones": {"unknown_action": 1, "zero_stamp": 1}}


def of(type_name, *links, dimensions=2, inputs=None, **settings):
    """A border of a type that only a recording defines."""
    return listening(
        "seen", type_name, *links, dimensions=dimensions, decoders=DECODERS, inputs=inputs, settings=settings
    )


def told(m):
    """Of each landmark of a message: identity, kind, what is measured, and the variances of that."""
    found = [(s, np.diag(np.reshape(s.covariance, (len(s.measured), -1)))) for s in m.sightings]
    return [(s.id, s.kind, pytest.approx(s.measured), pytest.approx(variances)) for s, variances in found]


def with_covariance(at, *diagonal):
    return make("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=np.diag(np.array(diagonal, float)).ravel())


TAGS, AT, SIGMAS = (
    "apriltag_msgs/msg/AprilTagDetectionArray",
    pose(2.0, 1.0, 0.0, quaternion(yaw=0.3)),
    (0.04, 0.04, 0.01),
)


def tags_seen(*tags, stamp_ns=STAMP_NS):
    """Of tags (number, hamming, margin)."""
    name, words = "apriltag_msgs/msg/AprilTagDetection", ("id", "hamming", "decision_margin")
    found = [part(name, family="tag36h11", **dict(zip(words, tag, strict=True))) for tag in tags]
    return sent(TAGS, header=header(stamp_ns, "eye"), detections=found)


def tag_on_tf(x=2.0, y=1.0, z=0.0, **options):
    return transforms(("eye", "tag36h11:3", (x, y, z), quaternion()), **options)


def test_apriltags_are_where_tf_says_at_their_stamp_and_poor_ones_are_left_out():
    b = of(TAGS, AHEAD, hamming_max=1, decision_margin_min=30.0, sigma_m=0.2, inputs={"tf": True})
    cdr = tags_seen((3, 0, 60.0), (4, 2, 60.0), (5, 0, 29.0))
    assert heard(b, "seen", cdr) is None, "the detector publishes the transforms after the detections"
    assert told(heard(b, "tf", tag_on_tf())) == [("tag36h11:3", "position", (3.0, 1.0), [0.04, 0.04])]
    assert counted(b) == {"seen": {"poor_tag": 2}}
    b = of(TAGS, inputs={"tf": True}, mount="0.2 0 0 -1.5707963 0 -1.5707963")
    heard(b, "tf", tag_on_tf(-1.0, 0.3, 2.0))
    at = only(heard(b, "seen", tags_seen((3, 0, 60.0)))).measured
    assert at == pytest.approx((2.2, 1.0)), "the mount is the camera's: z ahead, x to the right"
    b = of(TAGS, AHEAD, inputs={"tf": True})
    for elapsed_s in range(12):
        stamp_ns = STAMP_NS + elapsed_s * 10**9
        b.convert("odom", odometry(stamp_ns=stamp_ns))
        if elapsed_s in (0, 11):
            assert heard(b, "tf", tag_on_tf(stamp_ns=stamp_ns)) is None
            m = heard(b, "seen", tags_seen((3, 0, 60.0), stamp_ns=stamp_ns))
            assert (m.stamp_ns, only(m).measured) == (stamp_ns, pytest.approx((3.0, 1.0))), "again, after a while"


def test_arrays_of_other_packages_are_landmarks_with_their_own_frames_stamps_and_identities():
    kind, own = "aruco_msgs/msg/MarkerArray", header(STAMP_NS + 7, "base_link")
    at, b = with_covariance(pose(2.0, 1.0), 0.01, 0.04, 1, 1, 1, 1), of(kind)
    parts = [part("aruco_msgs/msg/Marker", header=h, id=k, pose=at) for k, h in ((12, header(0, "")), (13, own))]
    assert [(m.stamp_ns, *told(m)) for m in b.convert("seen", sent(kind, header=HEAD, markers=parts))] == [
        (STAMP_NS, ("12", "position", (2.0, 1.0), [0.01, 0.04])),
        (STAMP_NS + 7, ("13", "position", (2.0, 1.0), [0.01, 0.04])),
    ]
    kind = "ros2_aruco_interfaces/msg/ArucoMarkers"
    b = of(kind, sigma_m=0.2, sigma_rad=0.1)
    m = heard(b, "seen", sent(kind, header=HEAD, marker_ids=np.array([5], np.int64), poses=[AT]))
    assert told(m) == [("5", "pose", (2.0, 1.0, 0.3), SIGMAS)]
    assert heard(b, "seen", sent(kind, header=HEAD, marker_ids=np.array([5, 6], np.int64), poses=[AT])) is None
    assert counted(b) == {"seen": {"lengths_differ": 1}}, "A29"
    kind, at = "rtabmap_msgs/msg/LandmarkDetections", with_covariance(pose(2.0, 1.0), *[0.01] * 6)
    ahead = {"header": header(STAMP_NS, "eye"), "size": 0.1, "pose": at}
    parts = [part("rtabmap_msgs/msg/LandmarkDetection", id=k, **ahead) for k in (6, 0)]
    assert told(heard(of(kind, AHEAD), "seen", sent(kind, header=HEAD, landmarks=parts))) == [
        (name, "pose", (3.0, 1.0, 0.0), [0.01] * 3) for name in ("6", "")
    ]


def test_poses_of_aruco_markers_have_a_header_each_that_goes_before_that_of_the_marker_and_of_the_array():
    """The detector fills the array's stamp with the time of sending, and the others with that of the image."""
    kind, own, none = "aruco_markers_msgs/msg/MarkerArray", header(STAMP_NS + 7, "eye"), header(0, "")
    b = of(kind, AHEAD, sigma_m=0.2, sigma_rad=0.1)

    def marker_of(number, of_pose, of_marker):
        at = make("geometry_msgs/msg/PoseStamped", header=of_pose, pose=AT)
        return part("aruco_markers_msgs/msg/Marker", header=of_marker, id=number, pose=at)

    parts = [marker_of(1, own, HEAD), marker_of(2, none, own), marker_of(2**32 - 1, none, none)]
    found = sorted(
        (one, m.stamp_ns) for m in b.convert("seen", sent(kind, header=HEAD, markers=parts)) for one in told(m)
    )
    assert found == [
        (("1", "pose", (3.0, 1.0, 0.3), SIGMAS), STAMP_NS + 7),
        (("2", "pose", (3.0, 1.0, 0.3), SIGMAS), STAMP_NS + 7),
        (("4294967295", "pose", (2.0, 1.0, 0.3), SIGMAS), STAMP_NS),
    ]
    assert counted(b) == {}


def test_fiducial_transforms_are_landmarks_in_the_frame_of_the_camera_as_the_bytes_say():
    """The bytes are written out by the rules of CDR here, not by the encoder that the decoder belongs to."""
    eye, q = ("base_link", "eye", (1.0, 0.0, 0.5), quaternion()), quaternion(yaw=0.3)
    b = of("fiducial_msgs/msg/FiducialTransformArray", eye, sigma_m=0.2, sigma_rad=0.1)
    cdr = struct.pack("<4sIII4sii", b"\0\1\0\0", STAMP_NS // 10**9, STAMP_NS % 10**9, 4, b"eye\0", 41, 2)
    for number, x in ((7, 2.0), (107, 3.0)):
        cdr += struct.pack("<i", number) + b"\0" * (-(len(cdr) - 4 + 4) % 8)
        cdr += struct.pack("<10d", x, 1.0, 0.0, q.x, q.y, q.z, q.w, 0.5, 0.01, 900.0)
    m = heard(b, "seen", cdr)
    assert told(m) == [("7", "pose", (3.0, 1.0, 0.3), SIGMAS), ("107", "pose", (4.0, 1.0, 0.3), SIGMAS)]
    assert (m.stamp_ns, counted(b)) == (STAMP_NS, {})


def test_cartographers_weights_are_inverse_standard_deviations():
    kind, weights = "cartographer_ros_msgs/msg/LandmarkList", {"a": (5.0, 0.0), "b": (5.0, 20.0), "c": (0.0, 0.0)}
    parts = [
        part(
            "cartographer_ros_msgs/msg/LandmarkEntry",
            id=name,
            tracking_from_landmark_transform=AT,
            translation_weight=translation,
            rotation_weight=rotation,
        )
        for name, (translation, rotation) in {**weights, "d": (math.nan, 0.0)}.items()
    ]
    b = of(kind)
    assert told(heard(b, "seen", sent(kind, header=HEAD, landmarks=parts))) == [
        ("a", "position", (2.0, 1.0), [0.04, 0.04]),
        ("b", "pose", (2.0, 1.0, 0.3), [0.04, 0.04, 0.0025]),
        ("c", "position", (2.0, 1.0), [0.01, 0.01]),
    ]
    assert counted(b) == {"seen": {"covariance_unknown": 1, "nonfinite_covariance": 1}}


@each("dimensions", [2, 3])
def test_mrpts_ranges_and_bearings_pitch_down_and_minus_one_is_no_identity(dimensions):
    kind, single = "mrpt_msgs/msg/ObservationRangeBearing", "mrpt_msgs/msg/SingleRangeBearingObservation"
    b = of(kind, ("base_link", "mast", (1.0, 0, 0), quaternion()), dimensions=dimensions)
    cdr = sent(
        kind,
        header=header(STAMP_NS, "mast"),
        sensor_pose_on_robot=pose(0.0, 0.5, 0.2, quaternion(yaw=0.1)),
        **{"sensor_std_range": 0.1, "sensor_std_yaw": 0.02, "sensor_std_pitch": 0.03},
        sensed_data=[part(single, range=5.0, yaw=0.4, pitch=-0.3, id=k) for k in (8, -1)],
    )
    m, level = heard(b, "seen", cdr), math.cos(0.3)
    in_plane = ("8", "range_bearing", (5.0 * level, 0.5), [0.01, (0.02 / level) ** 2])
    assert told(m)[0] == (("8", "range_bearing", (5.0, 0.4, 0.3), [0.01, 0.0004, 0.0009]), in_plane)[dimensions == 2]
    assert m.sightings[0].T_base_sensor[:3] == pytest.approx((1.0, 0.5, 0.2 if dimensions == 3 else 0.0))
    assert m.sightings[1] == replace(m.sightings[0], id="")
    assert counted(b) == {}
