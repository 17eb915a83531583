"""Messages out: their bytes are those of rosbags' serialiser, their numbers those of ROS's conventions."""

import itertools
import math

import numpy as np
import pytest
from rows import each

from graph_slam_ros.graph import R2
from graph_slam_ros.lie import so3
from graph_slam_ros.messages import markers, results, to_msg
from graph_slam_ros.messages.from_msg import is_correction, twist_of
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.messages.markers import GraphView, Lines
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings

STAMP_NS = 1_700_000_000_987_654_321
MARKERS = "visualization_msgs/msg/MarkerArray"
FLAT, SPATIAL = (1.0, -2.0, 3.0), (1.0, 2.0, 3.0, 0.5, -0.5, 0.5, 0.5)


def decode(cdr, name):
    return typestore().deserialize_cdr(cdr, name)


def numbers(pose):
    p, q = pose.position, pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def lines(rng, n):
    return Lines(rng.standard_normal((n, 3)), rng.standard_normal((n, 3)), rng.uniform(0.0, 20.0, n))


def spread(rng, size):
    return np.cov(rng.standard_normal((size, 20)))


def graph(frame, rng, n):
    classes = {"": lines(rng, n), "o": lines(rng, n), "odometry": lines(rng, 2)}
    poses = rng.standard_normal((n, 3)), rng.standard_normal((2, 3))
    return markers.graph_markers(STAMP_NS, frame, GraphView(*poses, classes, lines(rng, n)))


def path(frame, rng, n, size):
    return to_msg.path(frame, [STAMP_NS + 1_100_000_000 * k for k in range(n)], rng.uniform(-9.0, 9.0, (n, size)))


def detections(frame, rng, n):
    names = ["", "abc", "tag 17"][:n]
    return to_msg.detections(
        STAMP_NS, frame, names, rng.normal(size=(len(names), 7)), rng.normal(size=(len(names), 6, 6))
    )


def ellipses(frame, rng, n, size):
    names = ["", "a", "tag 17"][:n]
    at, spreads = rng.standard_normal((len(names), size)), [spread(rng, size) for _ in names]
    return markers.landmark_markers(STAMP_NS, frame, names, at, spreads)


def odometry(frame, rng, child, pose):
    dof = 3 if len(pose) == 3 else 6
    return to_msg.odometry(STAMP_NS, frame, child, pose, spread(rng, dof), 1e6, rng.standard_normal(42).tobytes())


WRITTEN = {
    results.PATH: [lambda f, rng, n=n, size=size: path(f, rng, n, size) for n in (0, 1, 2, 5) for size in (3, 7)],
    results.TF: [
        lambda f, _, c=c, p=p: to_msg.transform(STAMP_NS, f, c, p) for c in ("b", "böse") for p in (FLAT, SPATIAL)
    ],
    results.ODOMETRY: [
        lambda f, rng, c=c, p=p: odometry(f, rng, c, p)
        for c in ("b", "ba", "bas", "base", "böse")
        for p in (FLAT, SPATIAL)
    ],
    results.ESTIMATES: [lambda f, rng, n=n: detections(f, rng, n) for n in (0, 1, 3)],
    MARKERS: [
        *(lambda f, rng, n=n: graph(f, rng, n) for n in (0, 1, 3)),
        *(lambda f, rng, n=n, size=size: ellipses(f, rng, n, size) for n in (0, 3) for size in (2, 3)),
    ],
}


@each("name", WRITTEN)
def test_what_is_written_has_the_bytes_of_the_serialiser_for_every_length_of_the_frames_name(name):
    for length in range(1, 17):
        frame = "abcdefghijklmnop"[:length]
        for write in WRITTEN[name]:
            cdr = write(frame, np.random.default_rng(length))
            message = decode(cdr, name)
            assert cdr == to_msg.encode(message)
            (first, *_) = getattr(message, "transforms", getattr(message, "markers", [message]))
            assert first.header.frame_id == frame


def test_a_covariance_is_published_in_the_axes_of_the_parent_frame():
    # at 90 degrees the robot's x (variance 1) is the map's y, its y (4) the map's -x
    tangent = np.array([[1.0, 0.5, 0.1], [0.5, 4.0, 0.2], [0.1, 0.2, 9.0]])
    cdr = to_msg.pose_with_covariance_stamped(STAMP_NS, "map", (3.0, -2.0, math.pi / 2), tangent, 1e6)
    message = decode(cdr, results.POSE)
    expected = np.diag([4.0, 1.0, 1e6, 1e6, 1e6, 9.0])
    for row, column, value in ((0, 1, -0.5), (0, 5, -0.2), (1, 5, 0.1)):
        expected[row, column] = expected[column, row] = value
    assert message.pose.covariance.reshape(6, 6) == pytest.approx(expected, abs=1e-12)
    assert numbers(message.pose.pose)[:3] == (3.0, -2.0, 0.0)
    assert message.header.frame_id == "map"
    # half a turn about the diagonal of x and y: the robot's x is the map's y, its y the map's x, its z the map's -z
    half, root = math.sqrt(0.5), np.random.default_rng(1).standard_normal((6, 6))
    pose, tangent = (3.0, -2.0, 1.0, half, half, 0.0, 0.0), root @ root.T
    message = decode(to_msg.pose_with_covariance_stamped(STAMP_NS, "map", pose, tangent, 1e6), results.POSE)
    at, signs = [1, 0, 2, 4, 3, 5], np.array([1, 1, -1, 1, 1, -1])
    expected = signs[:, None] * tangent[np.ix_(at, at)] * signs
    assert message.pose.covariance.reshape(6, 6) == pytest.approx(expected), "rotations come after translations"
    assert numbers(message.pose.pose) == pose


@each("child", ["b", "ba", "bas", "base", "base_link"])
def test_the_twist_of_an_odometry_message_is_passed_on_as_it_was_received(child):
    for length in range(1, 9):
        twist = np.random.default_rng(length).standard_normal(42)
        covariance = np.diag([1.0, 2.0, 3.0])
        written = to_msg.odometry(STAMP_NS, "abcdefgh"[:length], child, FLAT, covariance, 1e6, twist.tobytes())
        message = decode(written, results.ODOMETRY)
        assert (message.child_frame_id, numbers(message.pose.pose)[:2]) == (child, FLAT[:2])
        assert np.diag(message.pose.covariance.reshape(6, 6))[2:] == pytest.approx([1e6, 1e6, 1e6, 3.0])
        assert twist_of(message, child) == twist.tobytes()
        assert twist_of(message, "wheel") is None, "what a wheel does is not what the robot does"
    slashed = to_msg.odometry(STAMP_NS, "odom", f"/{child}", FLAT, covariance, 1e6)
    message = decode(slashed, results.ODOMETRY)
    assert message.twist.covariance.tolist() == (1e6 * np.eye(6)).ravel().tolist(), "unknown"
    assert twist_of(message, child) == slashed[-336:]


@each("little_endian, frame", [*itertools.product([True, False], ["map", "/map", "mapp", ""])])
def test_a_transform_of_the_map_frame_is_known_without_being_decoded(frame, little_endian):
    message = decode(to_msg.transform(STAMP_NS, frame, "odom", (1.0, 2.0, 3.0)), results.TF)
    cdr = bytes(typestore().serialize_cdr(message, results.TF, little_endian=little_endian))
    assert is_correction(cdr, "map") is (frame.strip("/") == "map")
    assert not any(is_correction(cdr[:length], "map") for length in range(23)), "cut off: nothing is known"


def test_what_is_published_of_a_drive_fits_together_and_covariances_are_in_the_axes_of_the_map():
    slam = GraphSlam(Config.from_mapping({"frames": {"map": "world", "odom": "start", "base": "body"}}))
    for k in range(8):
        slam.process(Odometry(STAMP_NS + k * 10**9, (0.5 * k, 0.0, 0.1 * k)))
        tag = Sighting("tag", "pose", (1.0, 0.2, 0.3), tuple(0.01 * np.eye(3).ravel()))
        slam.process(Sightings(STAMP_NS + k * 10**9, "/landmarks", (tag,)))
    for event in ("flush", "optimize"):
        slam.process(Control(event))
    whole, pose = decode(results.path(slam.view), results.PATH), decode(results.pose(slam.view), results.POSE)
    last = whole.poses[-1]
    assert whole.header.frame_id == pose.header.frame_id == "world"
    assert pose.header.stamp == last.header.stamp
    assert numbers(pose.pose.pose)[:2] == pytest.approx(numbers(last.pose)[:2], abs=1e-9)
    thin = decode(results.path(slam.view, 4), results.PATH)
    assert (len(whole.poses), thin.poses, thin.header) == (8, [whole.poses[k] for k in (0, 4, 7)], whole.header)
    ((_, (*_, yaw), covariance),) = results.landmark_estimates(slam.view)
    (marginal,) = slam.view.solver.marginal([slam.view.landmarks["tag"].vertex])
    turn = so3.matrix(so3.exp((0.0, 0.0, yaw)))
    assert covariance == pytest.approx(turn @ marginal @ turn.T)
    slam.view.graph.add_vertex(R2, [0.0, 0.0])  # nothing determines it: the next solve fails
    slam.process(Control("optimize"))
    assert slam.counters.as_dict() == {"solver": {"unsolved": 1}}
    assert all(np.isnan(one).all() for _, _, one in results.landmark_estimates(slam.view)), "none is mistaken for one"
