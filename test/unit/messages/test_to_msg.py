"""Messages out: their bytes are those of rosbags' serialiser, their numbers those of ROS's conventions."""

import math

import numpy as np
import pytest

from graph_slam_ros.graph import R2
from graph_slam_ros.messages import results, to_msg
from graph_slam_ros.messages.from_msg import is_correction, twist_of
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings

STAMP_NS = 1_700_000_000_987_654_321


def decode(cdr, name):
    return typestore().deserialize_cdr(cdr, name)


@pytest.mark.parametrize("size", [3, 7])
@pytest.mark.parametrize("n", [0, 1, 2, 5])
@pytest.mark.parametrize("length", range(1, 17))
def test_a_path_has_the_bytes_of_the_serialiser_for_every_length_of_the_frames_name(length, n, size):
    frame = "abcdefghijklmnop"[:length]
    rng = np.random.default_rng(length)
    poses = rng.uniform(-9.0, 9.0, (n, size))
    stamps = [STAMP_NS + 1_100_000_000 * k for k in range(n)]
    stamped = [
        to_msg.make("geometry_msgs/msg/PoseStamped", header=to_msg.header(stamp, frame), pose=to_msg.pose(tuple(p)))
        for stamp, p in zip(stamps, poses, strict=True)
    ]
    head = to_msg.header(stamps[-1] if n else 0, frame)
    assert to_msg.path(frame, stamps, poses) == to_msg.encode(
        to_msg.make("nav_msgs/msg/Path", header=head, poses=stamped)
    )


def test_a_path_keeps_the_stamp_of_each_pose_and_carries_the_newest():
    stamps = [STAMP_NS, STAMP_NS + 1, STAMP_NS + 20_000_000_000]
    path = decode(
        to_msg.path("map", stamps, np.array([[1, 2, 0], [3, 4, math.pi / 2], [5, 6, -1.0]])), "nav_msgs/msg/Path"
    )
    times = [p.header.stamp for p in path.poses]
    assert [t.sec * 10**9 + t.nanosec for t in times] == stamps
    assert (path.header.stamp.sec, path.header.stamp.nanosec) == divmod(stamps[-1], 10**9)
    assert {p.header.frame_id for p in path.poses} | {path.header.frame_id} == {"map"}
    q = path.poses[1].pose.orientation
    assert (q.x, q.y, q.z, q.w) == pytest.approx((0, 0, math.sqrt(0.5), math.sqrt(0.5)))


def test_a_covariance_is_published_in_the_axes_of_the_parent_frame():
    # at 90 degrees the robot's x (variance 1) is the map's y, its y (4) the map's -x
    tangent = np.array([[1.0, 0.5, 0.1], [0.5, 4.0, 0.2], [0.1, 0.2, 9.0]])
    cdr = to_msg.pose_with_covariance_stamped(STAMP_NS, "map", (3.0, -2.0, math.pi / 2), tangent, 1e6)
    message = decode(cdr, "geometry_msgs/msg/PoseWithCovarianceStamped")
    full = message.pose.covariance.reshape(6, 6)
    expected = np.diag([4.0, 1.0, 1e6, 1e6, 1e6, 9.0])
    expected[0, 1] = expected[1, 0] = -0.5
    expected[0, 5] = expected[5, 0] = -0.2
    expected[1, 5] = expected[5, 1] = 0.1
    assert full == pytest.approx(expected, abs=1e-12)
    at = message.pose.pose
    assert (at.position.x, at.position.y, at.position.z) == (3.0, -2.0, 0.0)
    assert at.orientation.z == pytest.approx(math.sqrt(0.5))
    assert message.header.frame_id == "map"


def test_in_space_all_of_a_covariance_is_published_in_the_axes_of_the_parent_frame():
    # half a turn about the diagonal of x and y: the robot's x is the map's y, its y the map's x, its z the map's -z
    half = math.sqrt(0.5)
    root = np.random.default_rng(1).standard_normal((6, 6))
    tangent = root @ root.T
    pose = (3.0, -2.0, 1.0, half, half, 0.0, 0.0)
    message = decode(to_msg.pose_with_covariance_stamped(STAMP_NS, "map", pose, tangent, 1e6), results.POSE)
    at, signs = [1, 0, 2, 4, 3, 5], np.array([1, 1, -1, 1, 1, -1])
    expected = signs[:, None] * tangent[np.ix_(at, at)] * signs
    assert message.pose.covariance.reshape(6, 6) == pytest.approx(expected)
    p, q = message.pose.pose.position, message.pose.pose.orientation
    assert (p.x, p.y, p.z, q.x, q.y, q.z, q.w) == pose
    assert np.diag(expected)[3] == pytest.approx(tangent[4, 4]), "rotations come after translations"


def test_a_transform_in_space_has_all_seven_numbers():
    motion = (1.0, 2.0, 3.0, 0.5, -0.5, 0.5, 0.5)
    (t,) = decode(to_msg.transform(STAMP_NS, "map", "odom", motion), "tf2_msgs/msg/TFMessage").transforms
    p, q = t.transform.translation, t.transform.rotation
    assert (p.x, p.y, p.z, q.x, q.y, q.z, q.w) == motion


def test_a_transform_names_its_frames_and_its_stamp():
    (t,) = decode(to_msg.transform(STAMP_NS, "map", "odom", (1.0, 2.0, math.pi)), "tf2_msgs/msg/TFMessage").transforms
    assert (t.header.frame_id, t.child_frame_id) == ("map", "odom")
    assert (t.header.stamp.sec, t.header.stamp.nanosec) == (1_700_000_000, 987_654_321)
    assert (t.transform.translation.x, t.transform.translation.y) == (1.0, 2.0)
    assert (t.transform.rotation.z, t.transform.rotation.w) == pytest.approx((1.0, 0.0))


@pytest.mark.parametrize("pose", [(1.0, -2.0, 3.0), (1.0, 2.0, 3.0, 0.5, -0.5, 0.5, 0.5)])
@pytest.mark.parametrize("child", ["b", "base_link", "böse"])
@pytest.mark.parametrize("length", range(1, 9))
def test_a_transform_has_the_bytes_of_the_serialiser_for_every_length_of_the_frames_names(length, child, pose):
    parent = "abcdefghijklmnop"[:length]
    at = to_msg.pose(pose)
    moved = to_msg.make(
        "geometry_msgs/msg/Transform",
        translation=to_msg.vector(at.position.x, at.position.y, at.position.z),
        rotation=at.orientation,
    )
    stamped = to_msg.make(
        "geometry_msgs/msg/TransformStamped",
        header=to_msg.header(STAMP_NS, parent),
        child_frame_id=child,
        transform=moved,
    )
    expected = to_msg.encode(to_msg.make("tf2_msgs/msg/TFMessage", transforms=[stamped]))
    assert to_msg.transform(STAMP_NS, parent, child, pose) == expected


def odometry_message(frame, child, pose, covariance, twist):
    vector = to_msg.vector
    inner = to_msg.make("geometry_msgs/msg/Twist", linear=vector(*twist[:3]), angular=vector(*twist[3:6]))
    return to_msg.make(
        results.ODOMETRY,
        header=to_msg.header(STAMP_NS, frame),
        child_frame_id=child,
        pose=to_msg.pose_with_covariance(pose, covariance, 1e6),
        twist=to_msg.make("geometry_msgs/msg/TwistWithCovariance", twist=inner, covariance=twist[6:]),
    )


@pytest.mark.parametrize("pose", [(1.0, -2.0, 3.0), (1.0, 2.0, 3.0, 0.5, -0.5, 0.5, 0.5)])
@pytest.mark.parametrize("child", ["b", "ba", "bas", "base", "base_link", "böse"])
@pytest.mark.parametrize("length", range(1, 9))
def test_odometry_has_the_bytes_of_the_serialiser_for_every_length_of_the_frames_names(length, child, pose):
    frame = "abcdefghijklmnop"[:length]
    rng = np.random.default_rng(length)
    dof, twist = 3 if len(pose) == 3 else 6, rng.standard_normal(42)
    covariance = np.cov(rng.standard_normal((dof, 20)))
    expected = to_msg.encode(odometry_message(frame, child, pose, covariance, twist))
    assert to_msg.odometry(STAMP_NS, frame, child, pose, covariance, 1e6, twist.tobytes()) == expected
    unknown = to_msg.odometry(STAMP_NS, frame, child, pose, covariance, 1e6)
    still = np.concatenate((np.zeros(6), 1e6 * np.eye(6).ravel()))
    assert unknown == to_msg.encode(odometry_message(frame, child, pose, covariance, still))


@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize("child", ["b", "ba", "bas", "base", "base_link"])
@pytest.mark.parametrize("length", range(1, 9))
def test_the_twist_of_an_odometry_message_is_passed_on_as_it_was_received(length, child, little_endian):
    twist = np.random.default_rng(length).standard_normal(42)
    message = odometry_message("abcdefgh"[:length], child, (1.0, 2.0, 3.0), np.eye(3), twist)
    cdr = bytes(typestore().serialize_cdr(message, results.ODOMETRY, little_endian=little_endian))
    assert twist_of(cdr, child) == twist.tobytes()
    assert twist_of(cdr, "wheel") is None, "what a wheel does is not what the robot does"


def test_of_a_message_that_is_cut_off_there_is_no_twist():
    cdr = to_msg.odometry(STAMP_NS, "odom", "base_link", (1.0, 2.0, 3.0), np.eye(3), 1e6)
    assert all(twist_of(cdr[:length], "base_link") is None for length in range(len(cdr)))
    slashed = to_msg.odometry(STAMP_NS, "odom", "/base_link", (1.0, 2.0, 3.0), np.eye(3), 1e6)
    assert twist_of(slashed, "base_link") == cdr[-336:]


@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize("frame, expected", [("map", True), ("/map", True), ("mapp", False), ("", False)])
def test_a_transform_of_the_map_frame_is_known_without_being_decoded(frame, expected, little_endian):
    store = typestore()
    message = store.deserialize_cdr(to_msg.transform(STAMP_NS, frame, "odom", (1.0, 2.0, 3.0)), results.TF)
    cdr = bytes(store.serialize_cdr(message, results.TF, little_endian=little_endian))
    assert is_correction(cdr, "map") is expected
    assert not any(is_correction(cdr[:length], "map") for length in range(23)), "cut off: nothing is known"


@pytest.mark.parametrize("names", [[], ["a"], ["", "abc", "tag 17"]])
@pytest.mark.parametrize("length", range(1, 9))
def test_detections_have_the_bytes_of_the_serialiser_for_every_length_of_the_frames_name(length, names):
    rng, frame = np.random.default_rng(length), "abcdefgh"[:length]
    poses, covariances = rng.standard_normal((len(names), 7)), rng.standard_normal((len(names), 6, 6))
    cdr = to_msg.detections(STAMP_NS, frame, names, poses, covariances)
    message = decode(cdr, results.ESTIMATES)
    assert cdr == to_msg.encode(message)
    assert [d.id for d in message.detections] == names
    assert [d.results[0].pose.covariance.tolist() for d in message.detections] == covariances.reshape(-1, 36).tolist()


def test_diagnostics_tell_of_each_status_its_level_its_words_and_its_values():
    statuses = [
        to_msg.Status(to_msg.WARN, "graph_slam: odometry", "silent for 2 s", "robot 1", {"rate_hz": "0", "lost": "3"}),
        to_msg.Status(to_msg.OK, "graph_slam: graph"),
    ]
    message = decode(to_msg.diagnostics(STAMP_NS, iter(statuses)), "diagnostic_msgs/msg/DiagnosticArray")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(STAMP_NS, 10**9)
    assert message.header.frame_id == ""
    odometry, graph = message.status
    assert (odometry.level, odometry.name, odometry.message) == (1, "graph_slam: odometry", "silent for 2 s")
    assert odometry.hardware_id == "robot 1"
    assert [(v.key, v.value) for v in odometry.values] == [("rate_hz", "0"), ("lost", "3")]
    assert (graph.level, graph.name, graph.message, graph.hardware_id, graph.values) == (
        0,
        "graph_slam: graph",
        "",
        "",
        [],
    )
    kind = message.status[0]
    assert (kind.OK, kind.WARN, kind.ERROR, kind.STALE) == (to_msg.OK, to_msg.WARN, to_msg.ERROR, to_msg.STALE)


def test_the_clock_is_the_stamp():
    clock = decode(to_msg.clock(STAMP_NS), "rosgraph_msgs/msg/Clock").clock
    assert (clock.sec, clock.nanosec) == (1_700_000_000, 987_654_321)


def driven():
    slam = GraphSlam(Config.from_mapping({"frames": {"map": "world", "odom": "start", "base": "body"}}))
    for k in range(8):
        stamp = STAMP_NS + k * 10**9
        slam.process(Odometry(stamp, (0.5 * k, 0.0, 0.1 * k)))
        tag = Sighting("tag", "pose", (1.0, 0.2, 0.3), tuple(0.01 * np.eye(3).ravel()))
        point = Sighting("point", "position", (2.0, -0.1 * k), (0.01, 0.0, 0.0, 0.01))
        slam.process(Sightings(stamp, "/landmarks", (tag, point)))
    for event in ("flush", "optimize"):
        slam.process(Control(event))
    return slam


@pytest.fixture(scope="module")
def solved():
    return driven()


def test_the_published_pose_is_the_paths_last_and_the_correction_leads_there(solved):
    path = decode(results.path(solved), results.PATH)
    pose = decode(results.pose(solved), results.POSE)
    last = path.poses[-1]
    assert path.header.frame_id == pose.header.frame_id == "world"
    assert pose.header.stamp == last.header.stamp
    assert pose.pose.pose.position.x == pytest.approx(last.pose.position.x, abs=1e-9)
    assert pose.pose.pose.position.y == pytest.approx(last.pose.position.y, abs=1e-9)
    (correction,) = decode(results.map_to_odom(solved, STAMP_NS), results.TF).transforms
    assert (correction.header.frame_id, correction.child_frame_id) == ("world", "start")
    (odometry,) = decode(results.odom_to_base(solved), results.TF).transforms
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("start", "body")
    assert odometry.transform.translation.x == 3.5


def test_a_thinned_path_has_the_poses_of_the_whole_one_at_their_own_stamps(solved):
    whole, thin = decode(results.path(solved), results.PATH), decode(results.path(solved, 4), results.PATH)
    assert len(whole.poses) == 8
    assert thin.poses == [whole.poses[k] for k in (0, 4, 7)]
    assert thin.header == whole.header


def test_a_landmarks_covariance_is_in_the_axes_of_the_map(solved):
    by_name = {name: (value, covariance) for name, value, covariance in results.landmark_estimates(solved)}
    value, covariance = by_name["tag"]
    (marginal,) = solved.solver.marginal([solved.landmarks["tag"].vertex])
    c, s = math.cos(value[2]), math.sin(value[2])
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    assert covariance == pytest.approx(turn @ marginal @ turn.T)
    assert len(by_name["point"][0]) == 2
    assert by_name["point"][1] == pytest.approx(solved.solver.marginal([solved.landmarks["point"].vertex])[0])


def test_every_keyframe_has_its_covariance_or_nothing_that_could_be_mistaken_for_one():
    slam = driven()
    covariances = slam.keyframe_covariances()
    assert covariances.shape == (len(slam.keyframes), 3, 3)
    assert covariances[-1] == pytest.approx(slam.pose_covariance)
    slam.graph.add_vertex(R2, [0.0, 0.0])  # nothing determines it: the next solve fails
    slam.process(Control("optimize"))
    assert slam.counters.as_dict() == {"solver": {"GaugeError": 1}}
    assert np.isnan(slam.keyframe_covariances()).all()
    assert all(np.isnan(covariance).all() for _, _, covariance in results.landmark_estimates(slam))
    assert GraphSlam().keyframe_covariances().shape == (0, 3, 3)
