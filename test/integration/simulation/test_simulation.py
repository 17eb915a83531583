import itertools

import numpy as np
import pytest
from reliability import times

from graph_slam_ros.analysis.path_error import path_error
from graph_slam_ros.analysis.trajectories import read_truth
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import RELATIVE_POSE, RELATIVE_POSE_3D
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.messages.from_msg import MessageConverter
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.trajectory import Trajectory
from graph_slam_ros.slam import Config, Control, Counters, GraphSlam, Odometry
from graph_slam_ros.tools.simulation import (
    WORLDS,
    city_graph,
    flight,
    landmark_graph,
    measurements,
    options_of,
    simulate,
    sphere_graph,
    warehouse,
    write_bag,
)
from graph_slam_ros.tools.simulation.motion import VelocityNoise, accumulated, integrate, space_of

SMALL = {
    "pythonrobotics": {},
    "manhattan": {"poses": 60, "blocks": 6},
    "warehouse": {"aisles": 2, "laps": 1},
    "flight": {"laps": 1, "beacons": 4},
}
SENSORS = [
    (world, kind)
    for world in WORLDS
    for option in options_of(WORLDS[world].options)
    if option.name == "sensor"
    for kind in option.choices
]


def true_twists(recording):
    poses = recording.T_world_base
    steps = space_of(poses[0]).group.local(tuple(poses[1:].T), tuple(poses[:-1].T))
    return np.stack(steps, axis=1) / (np.diff(recording.stamps_ns)[:, None] * 1e-9)


@pytest.mark.parametrize("world", WORLDS)
def test_the_same_seed_gives_the_same_recording_and_another_seed_another(world):
    one, same, other = (simulate(world, seed, **SMALL[world]) for seed in (5, 5, 6))
    for name in ("stamps_ns", "T_odom_base", "twist", "odom_covariance", "T_world_base"):
        assert np.array_equal(getattr(one, name), getattr(same, name))
    assert one.seen == same.seen != other.seen
    assert not np.array_equal(one.T_odom_base, other.T_odom_base)


@pytest.mark.parametrize(
    "as_original, speed_m_s, turn_rad_s", [(False, 0.1, np.deg2rad(10.0)), (True, 0.01, np.deg2rad(10.0) ** 2)]
)
def test_velocity_errors_have_the_stated_standard_deviations(as_original, speed_m_s, turn_rad_s):
    errors = []
    for seed in range(40):
        recording = simulate("pythonrobotics", seed, as_original=as_original)
        errors.append(recording.twist[1:] - true_twists(recording))
    errors = np.concatenate(errors)
    # 2000 samples: the standard deviation is known to 1.6 %, a correlation to 0.022
    assert errors.std(axis=0) == pytest.approx([speed_m_s, 1e-3, turn_rad_s], rel=0.06)
    assert np.sqrt(np.diag(recording.twist_covariance)) == pytest.approx([speed_m_s, 1e-3, turn_rad_s])
    assert np.abs(np.corrcoef(errors.T) - np.eye(3)).max() < 0.09


@pytest.mark.parametrize("correlation_time_s", [0.0, 0.5])
def test_velocity_errors_add_up_over_time_as_stated(correlation_time_s):
    noise, dt_s, ticks = VelocityNoise((0.05, 0.01, 0.02), correlation_time_s), 0.02, 1000
    errors = noise.draw(np.random.default_rng(1), 400 * ticks, dt_s)
    assert errors.std(axis=0) == pytest.approx(noise.sigmas, rel=0.05)
    moved = dt_s * errors.reshape(400, ticks, 3).sum(axis=1)
    whitened = moved / np.sqrt(ticks * np.diag(noise.per_tick(dt_s)))
    assert (whitened**2).mean() == pytest.approx(1.0, abs=0.16)  # 1200 samples: 4 sigma


@pytest.mark.parametrize("turn", [0.0, 1e-7, 1e-4, 0.99e-3, 1.01e-3, 0.3, -2.5])
def test_the_right_jacobian_of_a_step_is_its_numeric_derivative(turn):
    step, h = np.array([1.7, -0.4, turn]), 1e-6

    def moved(d):
        return np.array(se2.local(se2.exp(tuple(step + d)), se2.exp(tuple(step))))

    numeric = np.stack([(moved(d) - moved(-d)) / (2 * h) for d in h * np.eye(3)], axis=1)
    assert np.abs(se2.right_jacobian(step) - numeric).max() < 1e-9


def test_accumulated_covariance_is_that_of_the_dead_reckoned_pose():
    noise, ticks, runs = VelocityNoise((0.02, 0.01, 0.01)), 30, 400
    steps = np.tile([0.5, 0.0, 0.2], (ticks, 1))
    truth, covariance = integrate(se2.IDENTITY, steps)[-1], accumulated(steps, noise.per_tick(1.0))[-1]
    rng = np.random.default_rng(2)
    ends = np.array([integrate(se2.IDENTITY, steps + noise.draw(rng, ticks, 1.0))[-1] for _ in range(runs)])
    errors = np.stack(se2.local(tuple(ends.T), tuple(truth)), axis=1)
    nees = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance), errors).mean()
    assert nees == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / runs))
    assert np.cov(errors.T) == pytest.approx(covariance, abs=0.25 * np.sqrt(np.outer(*2 * [np.diag(covariance)])).max())


def error_of(sighting, T_world_base, landmark):
    """By how much a sighting is off, in the coordinates of its covariance."""
    space = space_of(T_world_base)
    group, n = space.group, space.dimensions
    landmark = (*landmark, *space.identity[len(landmark) :])
    if sighting.kind == "pose":
        return np.array(group.local(sighting.measured, group.between(T_world_base, landmark)))
    if sighting.kind == "position":
        return np.subtract(sighting.measured, group.between(T_world_base, landmark)[:n])
    p = group.between(group.compose(T_world_base, sighting.T_base_sensor or space.identity), landmark)[:n]
    angles = [np.arctan2(p[1], p[0]), *([np.arctan2(p[2], np.hypot(p[0], p[1]))] if n == 3 else [])]
    true = {"range_bearing": [np.linalg.norm(p), *angles], "bearing": angles, "range": [np.linalg.norm(p)]}
    error = np.subtract(sighting.measured, true[sighting.kind])
    turns = error if sighting.kind == "bearing" else error[1:]
    turns[:] = se2.wrap(turns)
    return error


@pytest.mark.parametrize("world, sensor", SENSORS)
def test_sightings_are_off_the_truth_by_what_their_covariance_says(world, sensor):
    whitened = []
    for seed in range(times(3, 5)):
        recording = simulate(world, seed, **SMALL[world], sensor=sensor)
        at = {stamp_ns: tuple(p) for stamp_ns, p in zip(recording.stamps_ns, recording.T_world_base, strict=True)}
        for seen in recording.seen:
            for s in seen.sightings:
                error = error_of(s, at[seen.stamp_ns], recording.landmarks[s.id])
                root = np.linalg.cholesky(np.reshape(s.covariance, (len(error), -1)))
                whitened.append((s.kind, *np.linalg.solve(root, error)))
    assert {kind for kind, *_ in whitened} == {sensor} | ({"position"} if world == "flight" else set())
    ours = np.array([row[1:] for row in whitened if row[0] == sensor])
    assert len(ours) > 150
    # of each component and each two: 5 sigma; a covariance taken at the measured bearing or attitude adds a little
    assert ours.T @ ours / len(ours) == pytest.approx(np.eye(ours.shape[1]), abs=5.0 * np.sqrt(2.0 / len(ours)))


@pytest.mark.parametrize("correlation_time_s", [0.0, 0.5])
def test_dead_reckoning_in_space_is_off_by_what_its_covariance_says(correlation_time_s):
    noise = VelocityNoise((0.05, 0.03, 0.04, 0.01, 0.02, 0.03), correlation_time_s)
    dt_s, ticks, runs = 0.1, 100, 300
    steps = dt_s * np.tile([2.0, 0.1, 0.3, 0.05, -0.1, 0.4], (ticks, 1))
    truth = tuple(integrate(se3.IDENTITY, steps)[-1])
    root = np.linalg.cholesky(accumulated(steps, noise.per_tick(dt_s))[-1])
    rng = np.random.default_rng(3)
    ends = [integrate(se3.IDENTITY, steps + dt_s * noise.draw(rng, ticks, dt_s))[-1] for _ in range(runs)]
    whitened = np.array([np.linalg.solve(root, se3.local(tuple(end), truth)) for end in ends])
    # 1800 numbers: 4 sigma; what lasts half a second of ten adds a little less than in the long run
    assert (whitened**2).mean() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / whitened.size) + 0.1 * correlation_time_s)
    assert np.abs(np.corrcoef(whitened.T) - np.eye(6)).max() < 4.5 / np.sqrt(runs)


def test_a_drone_hovers_level_at_both_ends_and_banks_into_its_turns_at_changing_heights():
    recording = simulate("flight", 0)
    poses, twists = recording.T_world_base, true_twists(recording)
    assert np.abs(twists[[0, -1], :3]).max() < 1e-3
    up = np.stack(so3.act(tuple(poses[:, 3:].T), (0.0, 0.0, 1.0)), axis=1)
    assert up[[0, -1], 2] == pytest.approx([1.0, 1.0], abs=1e-5)
    # it flies to the left around the middle: seen from above, its up axis leans there
    assert (up[200:-200, :2] * poses[200:-200, :2]).sum(axis=1).max() < 0.0
    assert np.rad2deg(np.arccos(up[:, 2].min())) > 8.0
    assert [poses[:, 2].min(), poses[:, 2].max()] == pytest.approx([1.3, 3.7], abs=0.01)
    forward, sideways = twists[:, 0], twists[:, 1]
    assert (np.abs(sideways) <= 0.1 * np.maximum(forward, 0.1)).all(), "it looks where it flies"
    ahead = np.arctan2(poses[:, 1], poses[:, 0])
    assert np.unwrap(ahead)[-1] == pytest.approx(2.0 * np.pi * 3.1, abs=0.3)


@pytest.mark.parametrize("sensor", ["pose", "range"])
def test_a_camera_in_space_reads_tags_only_in_range_in_view_and_from_their_front(sensor):
    recording = simulate("flight", 0, sensor=sensor)
    camera = flight.CAMERA
    at = {stamp_ns: tuple(p) for stamp_ns, p in zip(recording.stamps_ns, recording.T_world_base, strict=True)}
    read = {(seen.stamp_ns, s.id) for seen in recording.seen for s in seen.sightings}
    T_world_camera = {
        stamp_ns: np.array(se3.compose(at[stamp_ns], camera.T_base_sensor)) for stamp_ns in recording.stamps_ns[10::10]
    }
    for stamp_ns, eye in T_world_camera.items():
        for name, tag in recording.landmarks.items():
            ray = np.subtract(tag[:3], eye[:3])
            distance = np.linalg.norm(ray)
            ahead = np.dot(ray, so3.matrix(tuple(eye[3:]))[:, 0]) / distance
            slant = np.dot(-ray, so3.matrix(tag[3:])[:, 0]) / distance
            seen = distance <= 8.0 and ahead >= np.cos(np.deg2rad(50.0)) and slant >= np.cos(np.deg2rad(65.0))
            assert ((stamp_ns, name) in read) == seen
    assert {name.split("/")[0] for _, name in read} == {"wall0", "wall1", "wall2", "wall3", "pillar0", "pillar1"}


def test_the_noise_of_a_tags_pose_is_along_and_about_the_axes_of_the_camera():
    recording = simulate("flight", 0)
    camera = flight.CAMERA
    turn = so3.matrix(camera.T_base_sensor[3:])
    in_camera = np.kron(np.eye(2), turn.T)
    for s in recording.seen[5].sightings:
        in_base = np.kron(np.eye(2), so3.matrix(s.measured[3:]))
        covariance = in_camera @ in_base @ np.reshape(s.covariance, (6, 6)) @ in_base.T @ in_camera.T
        assert covariance == pytest.approx(np.diag(np.square(camera.sigmas)), abs=1e-12)


def test_all_five_radio_tags_are_seen_at_every_tick_of_the_pythonrobotics_world():
    recording = simulate("pythonrobotics", 0)
    assert list(recording.landmarks.values()) == [(10, -2), (15, 10), (3, 15), (-5, 20), (-5, 5)]
    assert np.diff(recording.stamps_ns).tolist() == [2_000_000_000] * 50
    assert [[s.id for s in seen.sightings] for seen in recording.seen] == [["0", "1", "2", "3", "4"]] * 50
    assert true_twists(recording) == pytest.approx(np.tile([1.0, 0.0, 0.1], (50, 1)))


def test_a_tag_is_read_only_in_range_in_view_and_from_its_front():
    recording = simulate("warehouse", 0)
    at = {stamp_ns: tuple(p) for stamp_ns, p in zip(recording.stamps_ns, recording.T_world_base, strict=True)}
    pairs = [(at[seen.stamp_ns], recording.landmarks[s.id]) for seen in recording.seen for s in seen.sightings]
    robots, tags = (tuple(np.array(side).T) for side in zip(*pairs, strict=True))
    x, y, _ = se2.between(robots, tags)
    assert np.hypot(x, y).max() <= 5.0
    assert np.abs(np.arctan2(y, x)).max() <= np.deg2rad(50.0)
    x, y, _ = se2.between(tags, robots)
    assert np.abs(np.arctan2(y, x)).max() <= np.deg2rad(65.0)
    assert {s.id[:4] for seen in recording.seen for s in seen.sightings} == {"rack", "wall"}


def test_the_robot_drives_through_the_aisles_and_not_through_racks():
    recording = simulate("warehouse", 0)
    x, y, _ = recording.T_world_base.T
    beside_racks = (y > 0.0) & (y < 12.0)
    from_aisle = np.abs(x - 4.0 * np.round(x / 4.0))
    assert from_aisle[beside_racks].max() < 4.0 / 2 - 1.6 / 2
    assert sorted(set(np.round(x[beside_racks] / 4.0))) == [0.0, 1.0, 2.0]
    assert 120.0 < (recording.stamps_ns[-1] - recording.stamps_ns[0]) * 1e-9 < 180.0


def test_following_waypoints_ends_at_the_last_one():
    waypoints = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 7.0], [3.0, 7.0], [3.0, 20.0]])
    poses = integrate((0.0, 0.0, 0.0), 0.02 * warehouse.follow(waypoints, 1.2, 1.0, 0.02))
    assert poses[-1] == pytest.approx([3.0, 20.0, np.pi / 2], abs=0.05)  # a tick is 0.02 m


def test_the_manhattan_robot_stays_on_the_streets():
    recording = simulate("manhattan", 3, poses=200, blocks=3)
    x, y, _ = recording.T_world_base.T
    assert min(x.min(), y.min()) > -1e-6
    assert max(x.max(), y.max()) < 12.0 + 1e-6
    off_street = np.minimum(np.abs(x - 4.0 * np.round(x / 4.0)), np.abs(y - 4.0 * np.round(y / 4.0)))
    assert off_street.max() < 1e-6


@pytest.mark.parametrize("world", WORLDS)
def test_a_bag_decodes_to_the_measurements_it_was_made_of(world, tmp_path):
    recording = simulate(world, 1, **SMALL[world])
    write_bag(recording, tmp_path / "bag.mcap")
    counters = Counters()
    border = MessageConverter(Config.from_mapping({"world.dimensions": 3 if world == "flight" else 2}), counters)
    decoded = []
    for record in open_bag(tmp_path / "bag.mcap").messages(["/odom", "/landmarks"]):
        decoded += border.convert("odom" if record.topic == "/odom" else "detections", record.cdr)
    for a, b in itertools.zip_longest(decoded, measurements(recording)):
        assert (type(a), a.stamp_ns) == (type(b), b.stamp_ns)
        if isinstance(a, Odometry):
            assert a.T_odom_base == pytest.approx(b.T_odom_base, abs=1e-12)
            assert a.twist_covariance == pytest.approx(b.twist_covariance)
            continue
        for one, other in zip(a.sightings, b.sightings, strict=True):
            assert one.id == other.id
            assert one.measured == pytest.approx(other.measured, abs=1e-12)
            assert one.covariance == pytest.approx(other.covariance, abs=1e-12)
    assert counters.as_dict() == {}


def test_a_bag_holds_the_truth_in_world_and_everything_in_order_of_stamp(tmp_path):
    recording = simulate("warehouse", 1, **SMALL["warehouse"])
    write_bag(recording, tmp_path / "bag.mcap")
    bag = open_bag(tmp_path / "bag.mcap")
    assert {t.name: t.type for t in bag.topics.values()} == {
        "/odom": "nav_msgs/msg/Odometry",
        "/landmarks": "vision_msgs/msg/Detection3DArray",
        "/ground_truth": "geometry_msgs/msg/PoseStamped",
        "/landmarks_ground_truth": "vision_msgs/msg/Detection3DArray",
    }
    order = [(r.log_ns, list(bag.topics).index(r.topic)) for r in bag.messages(list(bag.topics))]
    assert [stamp_ns for stamp_ns, _ in order] == sorted(stamp_ns for stamp_ns, _ in order)
    messages = {
        topic: [typestore().deserialize_cdr(r.cdr, bag.topics[topic].type) for r in bag.messages([topic])]
        for topic in bag.topics
    }
    assert {m.header.frame_id for m in messages["/ground_truth"]} == {"world"}
    (landmarks,) = messages["/landmarks_ground_truth"]
    assert landmarks.header.frame_id == "world"
    assert {d.id: (d.bbox.center.position.x, d.bbox.center.position.y) for d in landmarks.detections} == {
        name: pose[:2] for name, pose in recording.landmarks.items()
    }
    odometry = messages["/odom"][-1]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    assert np.diag(odometry.pose.covariance.reshape(6, 6))[2:5].tolist() == [1e6] * 3
    assert np.diag(odometry.twist.covariance.reshape(6, 6)) == pytest.approx([0.05**2, 1e-4, 1e6, 1e6, 1e6, 0.05**2])
    known = read_truth(tmp_path / "bag.mcap")
    assert known.trajectory.poses == pytest.approx(se3.in_space(recording.T_world_base))


def test_a_bag_from_space_has_all_six_degrees_of_freedom_in_ros_order_and_axes(tmp_path):
    recording = simulate("flight", 1, **SMALL["flight"])
    write_bag(recording, tmp_path / "bag.mcap")
    bag = open_bag(tmp_path / "bag.mcap")
    last = {}
    for record in bag.messages(list(bag.topics)):
        last[record.topic] = typestore().deserialize_cdr(record.cdr, bag.topics[record.topic].type)
    odometry = last["/odom"]
    assert seven(odometry.pose.pose) == pytest.approx(recording.T_odom_base[-1])
    twist = odometry.twist.twist
    assert [twist.linear.x, twist.linear.y, twist.linear.z] == pytest.approx(recording.twist[-1, :3])
    assert [twist.angular.x, twist.angular.y, twist.angular.z] == pytest.approx(recording.twist[-1, 3:])
    sigmas = [0.05, 0.03, 0.04, 0.004, 0.004, 0.02]
    assert odometry.twist.covariance.reshape(6, 6) == pytest.approx(np.diag(np.square(sigmas)))
    both = np.kron(np.eye(2), so3.matrix(tuple(recording.T_odom_base[-1, 3:])))
    assert odometry.pose.covariance.reshape(6, 6) == pytest.approx(both @ recording.odom_covariance[-1] @ both.T)
    assert seven(last["/ground_truth"].pose) == pytest.approx(recording.T_world_base[-1])
    seen = {s.id: s for s in recording.seen[-1].sightings}
    assert {s.kind for s in seen.values()} == {"pose", "position"}
    for detection in last["/landmarks"].detections:
        posed, s = detection.results[0].pose, seen[detection.id]
        assert seven(posed.pose)[: len(s.measured)] == pytest.approx(s.measured)
        covariance = posed.covariance.reshape(6, 6)
        if s.kind == "pose":
            both = np.kron(np.eye(2), so3.matrix(s.measured[3:]))
            assert covariance == pytest.approx(both @ np.reshape(s.covariance, (6, 6)) @ both.T)
        else:
            assert covariance[:3, :3] == pytest.approx(np.reshape(s.covariance, (3, 3)))
            assert covariance[3:, 3:].tolist() == (1e6 * np.eye(3)).tolist(), "a point has no rotation"
    true = {d.id: d for d in last["/landmarks_ground_truth"].detections}
    assert set(true) == set(recording.landmarks)
    for name, at in recording.landmarks.items():
        assert seven(true[name].bbox.center)[: len(at)] == pytest.approx(at)
        known = true[name].results[0].pose.covariance.reshape(6, 6).diagonal()
        assert known.tolist() == [1e-6] * (6 if len(at) == 7 else 3) + [1e6] * (0 if len(at) == 7 else 3)


def seven(pose):
    """x, y, z, qx, qy, qz, qw of a message."""
    p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


@pytest.mark.parametrize("world", ["warehouse", "flight"])
@pytest.mark.parametrize("sensor", ["range_bearing", "bearing", "range"])
def test_ranges_and_bearings_are_points_with_named_fields_in_the_frame_of_the_sensor(tmp_path, world, sensor):
    recording = simulate(world, 1, laps=1, sensor=sensor)
    write_bag(recording, tmp_path / "bag.mcap")
    bag = open_bag(tmp_path / "bag.mcap")
    first = {}
    for record in bag.messages(list(bag.topics)):
        if record.topic not in first:
            first[record.topic] = typestore().deserialize_cdr(record.cdr, bag.topics[record.topic].type)
    (mounted,) = first["/tf_static"].transforms
    seen, names = recording.seen[0], list(recording.landmarks)
    T_base_sensor = seen.sightings[0].T_base_sensor or (0.0, 0.0, 0.0)
    assert (mounted.header.frame_id, mounted.child_frame_id) == ("base_link", "sensor")
    p, q = mounted.transform.translation, mounted.transform.rotation
    assert [p.x, p.y, p.z, q.x, q.y, q.z, q.w] == pytest.approx(se3.in_space(T_base_sensor))
    cloud = first["/landmarks"]
    assert cloud.header.frame_id == "sensor"
    points = np.frombuffer(bytes(cloud.data), np.dtype([(f.name, "<f8") for f in cloud.fields]))
    angles = ["bearing", "elevation"][: 1 if world == "warehouse" else 2] if "bearing" in sensor else []
    measured = ["range"] * ("range" in sensor) + angles
    assert len(points) == cloud.width == len(seen.sightings)
    for point, s in zip(points, seen.sightings, strict=True):
        assert names[int(point["id"])] == s.id
        assert tuple(point[name] for name in measured) == s.measured
        sigmas = np.sqrt(np.reshape(s.covariance, (len(measured), -1)).diagonal())
        assert point["sigma"] == pytest.approx(sigmas[0])
        if sensor == "range_bearing":
            assert sigmas[1:] == pytest.approx(point["sigma_bearing"])
    assert [d.id for d in first["/landmarks_ground_truth"].detections] == [str(k) for k in range(len(names))]


def test_kinds_that_no_one_message_holds_are_not_recorded(tmp_path):
    with pytest.raises(GraphSlamError, match="no message holds bearing and position together"):
        write_bag(simulate("flight", 1, laps=1, sensor="bearing", beacons=3), tmp_path / "bag.mcap")
    assert not (tmp_path / "bag.mcap").exists()


@pytest.mark.parametrize(
    "world, options, named",
    [
        ("mars", {}, "pythonrobotics, manhattan, warehouse, flight"),
        ("flight", {"sensor": "radar"}, "sensor: 'radar' is not one of pose, position"),
        ("flight", {"sensor": 3}, "3 is not a text"),
        ("warehouse", {"isles": 3}, "aisles"),
        ("warehouse", {"aisles": 2.5}, "2.5 is not an integer"),
        ("warehouse", {"aisles": 1}, "aisles: 1 is not in [2, 100]"),
        ("manhattan", {"sigma_turn_rad_s": float("nan")}, "sigma_turn_rad_s: nan"),
        ("pythonrobotics", {"as_original": 1}, "1 is not true or false"),
    ],
)
def test_a_wrong_world_or_option_is_refused_by_name(world, options, named):
    with pytest.raises(GraphSlamError) as refused:
        simulate(world, 0, **options)
    assert named in str(refused.value)
    assert "\n" not in str(refused.value)


def chi2_at(graph, values, label, edge_type=RELATIVE_POSE, size=3):
    table = graph.tables[edge_type]
    residual, _ = edge_type.linearize(values.ravel(), size * table.vertices.values, table.measured.values)
    mine = table.label.values == graph.labels.index(label)
    whitened = np.einsum("nij,nj->ni", table.sqrt_information.values[mine], residual[mine])
    return float((whitened**2).sum()), int(mine.sum())


@pytest.mark.parametrize("factor", [1.0, 5.0])
def test_the_truth_explains_a_city_graph_within_its_noise(factor):
    graph, truth = city_graph(4, poses=3000, blocks=10, odometry_noise_factor=factor)
    for label in ("odometry", "closures"):
        chi2, edges = chi2_at(graph, truth, label)
        assert chi2 / (3 * edges) == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / (3 * edges)))
    chi2, _ = chi2_at(graph, graph.initial.values.reshape(-1, 3), "odometry")
    assert chi2 < 1e-12  # it starts at the odometry
    information = graph.tables[RELATIVE_POSE].sqrt_information.values
    assert information[0, 0, 0] == pytest.approx(1.0 / (0.05 * factor))
    assert information[-1, 0, 0] == pytest.approx(1.0 / 0.05)


def test_a_city_graph_has_one_closure_per_three_poses_and_each_leads_to_an_old_place_nearby():
    graph, truth = city_graph(5, poses=6000, blocks=10)
    table = graph.tables[RELATIVE_POSE]
    closures = table.vertices.values[table.label.values == graph.labels.index("closures")]
    assert len(closures) == pytest.approx(6000 / 3, rel=0.02)
    earlier, later = closures.T
    assert (later - earlier).min() >= 20
    assert np.abs(truth[earlier, :2] - truth[later, :2]).max() <= 2.0
    assert len(np.unique(later)) == len(later)
    assert [truth[:, :2].min(), truth[:, :2].max()] == [0.0, 40.0]


@pytest.mark.parametrize("sigma_rad, closures", [(0.01, 1), (0.1, 1), (0.1, 4)])
def test_the_truth_explains_a_sphere_within_its_noise_and_closures_lead_to_the_lap_before(sigma_rad, closures):
    graph, truth = sphere_graph(2, poses=1000, sigma_rad=sigma_rad, closures=closures, odometry_noise_factor=2.0)
    for label in ("odometry", "closures"):
        chi2, edges = chi2_at(graph, truth, label, RELATIVE_POSE_3D, 7)
        assert chi2 / (6 * edges) == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / (6 * edges)))
    chi2, _ = chi2_at(graph, graph.initial.values.reshape(-1, 7), "odometry", RELATIVE_POSE_3D, 7)
    assert chi2 < 1e-12  # it starts at the odometry
    table = graph.tables[RELATIVE_POSE_3D]
    earlier, later = table.vertices.values[table.label.values == graph.labels.index("closures")].T
    assert set((later - earlier).tolist()) == {1: {50}, 4: {49, 50, 51, 52}}[closures]
    assert len(later) == pytest.approx(closures * 950, abs=3 * closures)
    radius = np.linalg.norm(truth[:, :3], axis=1)
    assert np.ptp(radius) < 1e-9 and radius[0] == pytest.approx(100.0)
    lap_m = np.linalg.norm(truth[50:, :3] - truth[:-50, :3], axis=1)
    assert lap_m == pytest.approx(2.0 * 100.0 * np.sin(np.pi / 40.0)), "a lap is a twentieth of the way up"


def test_the_noise_of_a_landmark_graphs_odometry_explains_the_true_motion():
    chi2, size = 0.0, 0
    for seed in range(20):
        recording = simulate("pythonrobotics", seed, as_original=True)
        graph = landmark_graph(recording)
        table = graph.tables[RELATIVE_POSE]
        residual, _ = RELATIVE_POSE.linearize(
            recording.T_world_base.ravel(), 3 * table.vertices.values, table.measured.values
        )
        chi2 += float((np.einsum("nij,nj->ni", table.sqrt_information.values, residual) ** 2).sum())
        size += residual.size
    assert chi2 / size == pytest.approx(1.0, abs=0.1)  # 3000 residuals: 4 sigma


def test_slam_halves_the_position_error_of_dead_reckoning_on_every_seed():
    ratios = []
    for seed in range(times(3, 20)):
        recording = simulate("pythonrobotics", seed)
        slam = GraphSlam()
        for measurement in [*measurements(recording), Control("end"), Control("optimize")]:
            slam.process(measurement)
        stamps_s = np.array([s.stamp_ns for s in slam.sighting_poses]) / 1e9
        at = np.searchsorted(recording.stamps_ns, [s.stamp_ns for s in slam.sighting_poses])
        truth = Trajectory(recording.stamps_ns / 1e9, se3.in_space(recording.T_world_base))
        estimate = path_error(Trajectory(stamps_s, se3.in_space(slam.sighting_trajectory())), truth)
        odometry = path_error(Trajectory(stamps_s, se3.in_space(recording.T_odom_base[at])), truth)
        assert estimate.n == odometry.n == 50
        ratios.append(estimate.position_m["rmse"] / odometry.position_m["rmse"])
    assert max(ratios) <= 0.5
