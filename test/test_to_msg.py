"""Messages out: their bytes are those of rosbags' serialiser, their numbers those of ROS's conventions."""

import math

import numpy as np
import pytest

from graph_slam_ros.graph import R2
from graph_slam_ros.lie import so3
from graph_slam_ros.ros import results, to_msg
from graph_slam_ros.ros.interfaces import typestore
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


def test_the_clock_is_the_stamp():
    clock = decode(to_msg.clock(STAMP_NS), "rosgraph_msgs/msg/Clock").clock
    assert (clock.sec, clock.nanosec) == (1_700_000_000, 987_654_321)


def test_markers_replace_the_former_ones_and_draw_each_landmark_as_its_two_sigma_ellipse():
    c, s = math.cos(0.3), math.sin(0.3)
    turn = np.array([[c, -s], [s, c]])
    covariances = [turn @ np.diag([0.01, 0.09]) @ turn.T, np.zeros((2, 2))]
    cdr = to_msg.landmark_markers(STAMP_NS, "map", ["a", "b"], np.array([[1.0, 2.0], [3.0, 4.0]]), covariances)
    clear, *drawn = decode(cdr, "visualization_msgs/msg/MarkerArray").markers
    assert clear.action == 3
    assert [(m.ns, m.id, m.action) for m in drawn] == [(ns, k, 0) for k in (0, 1) for ns in ("landmarks", "names")]
    ellipse, name, exact, _ = drawn
    assert (ellipse.type, name.type) == (3, 9)
    assert sorted((ellipse.scale.x, ellipse.scale.y)) == pytest.approx([0.4, 1.2])
    tilt = 2 * math.atan2(ellipse.pose.orientation.z, ellipse.pose.orientation.w)
    long_axis = tilt if ellipse.scale.x > ellipse.scale.y else tilt + math.pi / 2
    assert math.sin(long_axis - (0.3 + math.pi / 2)) == pytest.approx(0.0, abs=1e-9)
    assert name.text == "a"
    assert (exact.scale.x, exact.scale.y) == (0.05, 0.05), "never too small to see"
    assert {m.header.frame_id for m in drawn} == {"map"}


def test_in_space_a_landmark_is_drawn_as_its_two_sigma_ellipsoid_or_small_where_that_is_unknown():
    turn = so3.matrix(so3.exp((0.4, -1.1, 0.7)))
    covariances = [turn @ np.diag([0.01, 0.09, 0.25]) @ turn.T, np.full((3, 3), np.nan)]
    positions = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    cdr = to_msg.landmark_markers(STAMP_NS, "map", ["a", "b"], positions, covariances)
    _, ellipsoid, _, unknown, _ = decode(cdr, results.LANDMARKS).markers
    p, q, size = ellipsoid.pose.position, ellipsoid.pose.orientation, ellipsoid.scale
    assert (ellipsoid.type, p.x, p.y, p.z) == (2, 1.0, 2.0, 3.0)
    axes = so3.matrix((q.x, q.y, q.z, q.w))
    assert axes @ np.diag(np.square([size.x, size.y, size.z]) / 16) @ axes.T == pytest.approx(covariances[0])
    assert (unknown.scale.x, unknown.scale.y, unknown.scale.z) == (0.05, 0.05, 0.05)


def test_no_landmarks_are_drawn_as_none():
    cdr = to_msg.landmark_markers(STAMP_NS, "map", [], np.zeros((0, 2)), [])
    assert [m.action for m in decode(cdr, "visualization_msgs/msg/MarkerArray").markers] == [3]


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
