"""Worlds: what is measured is off the truth by its noise, and a bag has what was measured."""

import itertools

import numpy as np
import pytest
from reliability import times

from graph_slam_ros.analysis.trajectories import read_truth
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import RELATIVE_POSE, RELATIVE_POSE_3D
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.messages.from_msg import MessageConverter
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.slam import Config, Counters, Odometry
from graph_slam_ros.tools.simulation import (
    WORLDS,
    city_graph,
    flight,
    measurements,
    options_of,
    simulate,
    sphere_graph,
    warehouse,
    with_closures,
    write_bag,
)
from graph_slam_ros.tools.simulation.motion import VelocityNoise, accumulated, integrate, space_of
from graph_slam_ros.tools.simulation.recording import places

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


def test_the_same_seed_gives_the_same_recording_and_another_seed_another():
    for world in WORLDS:
        one, same, other = (simulate(world, seed, **SMALL[world]) for seed in (5, 5, 6))
        for name in ("stamps_ns", "T_odom_base", "twist", "odom_covariance", "T_world_base"):
            assert np.array_equal(getattr(one, name), getattr(same, name)), world
        assert one.seen == same.seen != other.seen, world
        assert not np.array_equal(one.T_odom_base, other.T_odom_base), world


def test_dead_reckoning_is_off_by_what_its_covariance_says():
    plane = VelocityNoise((0.05, 0.03, 0.02)), [2.0, 0.1, 0.4]
    space = VelocityNoise((0.05, 0.03, 0.04, 0.01, 0.02, 0.03), 0.5), [2.0, 0.1, 0.3, 0.05, -0.1, 0.4]
    for (noise, twist), group in ((plane, se2), (space, se3)):
        dt_s, ticks, runs = 0.1, 100, 150
        steps = dt_s * np.tile(twist, (ticks, 1))
        truth = tuple(integrate(group.IDENTITY, steps)[-1])
        root = np.linalg.cholesky(accumulated(steps, noise.per_tick(dt_s))[-1])
        rng = np.random.default_rng(3)
        ends = [integrate(group.IDENTITY, steps + dt_s * noise.draw(rng, ticks, dt_s))[-1] for _ in range(runs)]
        whitened = np.array([np.linalg.solve(root, group.local(tuple(end), truth)) for end in ends])
        # 4 sigma; what lasts half a second of ten adds a little less than in the long run
        most = 4.0 * np.sqrt(2.0 / whitened.size) + 0.1 * noise.correlation_time_s
        assert (whitened**2).mean() == pytest.approx(1.0, abs=most)
        assert np.abs(np.corrcoef(whitened.T) - np.eye(len(twist))).max() < 4.5 / np.sqrt(runs)


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


def test_sightings_are_off_the_truth_by_what_their_covariance_says():
    for world, sensor in SENSORS:
        whitened = []
        for seed in range(times(1, 5)):
            recording = simulate(world, seed, **SMALL[world], sensor=sensor)
            at = {stamp_ns: tuple(p) for stamp_ns, p in zip(recording.stamps_ns, recording.T_world_base, strict=True)}
            for seen in recording.seen:
                for s in seen.sightings:
                    error = error_of(s, at[seen.stamp_ns], recording.landmarks[s.id])
                    root = np.linalg.cholesky(np.reshape(s.covariance, (len(error), -1)))
                    whitened.append((s.kind, *np.linalg.solve(root, error)))
        assert {kind for kind, *_ in whitened} == {sensor} | ({"position"} if world == "flight" else set())
        ours = np.array([row[1:] for row in whitened if row[0] == sensor])
        assert len(ours) > 50, (world, sensor)
        # of each component and each two: 5 sigma; a covariance taken at the measured bearing or attitude adds a little
        off = np.abs(ours.T @ ours / len(ours) - np.eye(ours.shape[1])).max()
        assert off < 5.0 * np.sqrt(2.0 / len(ours)), (world, sensor)


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
    assert (np.abs(twists[:, 1]) <= 0.1 * np.maximum(twists[:, 0], 0.1)).all(), "it looks where it flies"


def test_a_camera_in_space_reads_tags_only_in_range_in_view_and_from_their_front():
    recording, camera = simulate("flight", 0, laps=1), flight.CAMERA
    read = {(seen.stamp_ns, s.id) for seen in recording.seen for s in seen.sightings}
    for stamp_ns, pose in zip(recording.stamps_ns[10::10], recording.T_world_base[10::10].tolist(), strict=True):
        eye = se3.compose(tuple(pose), camera.T_base_sensor)
        for name, tag in recording.landmarks.items():
            ray = np.subtract(tag[:3], eye[:3])
            distance = np.linalg.norm(ray)
            ahead = np.dot(ray, so3.matrix(eye[3:])[:, 0]) / distance
            slant = np.dot(-ray, so3.matrix(tag[3:])[:, 0]) / distance
            seen = distance <= 8.0 and ahead >= np.cos(np.deg2rad(50.0)) and slant >= np.cos(np.deg2rad(65.0))
            assert ((stamp_ns, name) in read) == seen
    assert {name.split("/")[0] for _, name in read} == {"wall0", "wall1", "wall2", "wall3", "pillar0", "pillar1"}


def test_robots_drive_where_there_is_room_and_read_tags_from_their_front():
    hall = simulate("warehouse", 0)
    at = {stamp_ns: tuple(p) for stamp_ns, p in zip(hall.stamps_ns, hall.T_world_base, strict=True)}
    pairs = [(at[seen.stamp_ns], hall.landmarks[s.id]) for seen in hall.seen for s in seen.sightings]
    robots, tags = (tuple(np.array(side).T) for side in zip(*pairs, strict=True))
    x, y, _ = se2.between(robots, tags)
    assert np.hypot(x, y).max() <= 5.0 and np.abs(np.arctan2(y, x)).max() <= np.deg2rad(50.0)
    x, y, _ = se2.between(tags, robots)
    assert np.abs(np.arctan2(y, x)).max() <= np.deg2rad(65.0)
    x, y, _ = hall.T_world_base.T
    beside_racks = (y > 0.0) & (y < 12.0)
    assert np.abs(x - 4.0 * np.round(x / 4.0))[beside_racks].max() < 4.0 / 2 - 1.6 / 2
    assert sorted(set(np.round(x[beside_racks] / 4.0))) == [0.0, 1.0, 2.0]
    waypoints = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 7.0], [3.0, 7.0], [3.0, 20.0]])
    poses = integrate((0.0, 0.0, 0.0), 0.02 * warehouse.follow(waypoints, 1.2, 1.0, 0.02))
    assert poses[-1] == pytest.approx([3.0, 20.0, np.pi / 2], abs=0.05)  # a tick is 0.02 m
    x, y, _ = simulate("manhattan", 3, poses=200, blocks=3).T_world_base.T
    assert min(x.min(), y.min()) > -1e-6 and max(x.max(), y.max()) < 12.0 + 1e-6
    assert np.minimum(np.abs(x - 4.0 * np.round(x / 4.0)), np.abs(y - 4.0 * np.round(y / 4.0))).max() < 1e-6
    circle = simulate("pythonrobotics", 0)
    assert [[s.id for s in seen.sightings] for seen in circle.seen] == [["0", "1", "2", "3", "4"]] * 50


def test_true_closures_are_off_by_their_noise_and_lead_back_to_an_old_place():
    for world in ("warehouse", "flight"):
        recording = simulate(world, 7, **SMALL[world] | {"laps": 2})
        many = with_closures(recording, 60, seed=3).closures
        assert len(many) == 60 and many != with_closures(recording, 60, seed=4).closures
        at = dict(zip(recording.stamps_ns.tolist(), recording.T_world_base, strict=True))
        space, whitened = space_of(recording.T_world_base[0]), []
        for c in many:
            assert c.stamp_ns - c.from_stamp_ns >= 10 * 10**9
            a, b = tuple(at[c.from_stamp_ns]), tuple(at[c.stamp_ns])
            assert np.linalg.norm(np.subtract(a, b)[: space.dimensions]) <= 2.0
            error = np.array(space.group.local(c.T_from_base, space.group.between(a, b)))
            whitened.append(np.linalg.solve(np.linalg.cholesky(np.reshape(c.covariance, (space.dof, -1))), error))
        assert np.square(whitened).mean() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / np.size(whitened)))
    driven = np.column_stack([np.linspace(0.0, 10.0, 1001), np.zeros((1001, 2))])
    assert driven[places(driven), 0] == pytest.approx(np.arange(0.0, 10.1, 0.5), abs=0.011)
    with pytest.raises(GraphSlamError, match=r"500 closures: the robot came back to \d+ places only"):
        with_closures(simulate("manhattan", 1, poses=60), 500, seed=1)


# -- bags --------------------------------------------------------------------------------------------------------------


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
    stamps_ns = [r.log_ns for r in bag.messages(list(bag.topics))]
    assert stamps_ns == sorted(stamps_ns)
    (raw,) = bag.messages(["/landmarks_ground_truth"])
    landmarks = typestore().deserialize_cdr(raw.cdr, bag.topics[raw.topic].type)
    assert landmarks.header.frame_id == "world"
    assert {d.id: (d.bbox.center.position.x, d.bbox.center.position.y) for d in landmarks.detections} == {
        name: pose[:2] for name, pose in recording.landmarks.items()
    }
    known = read_truth(tmp_path / "bag.mcap")
    assert known.trajectory.poses == pytest.approx(se3.in_space(recording.T_world_base))


def test_ranges_and_bearings_are_points_with_named_fields_in_the_frame_of_the_sensor(tmp_path):
    for world, sensor in itertools.product(("warehouse", "flight"), ("range_bearing", "bearing", "range")):
        recording = simulate(world, 1, **{"warehouse": {"aisles": 2}, "flight": {}}[world], laps=1, sensor=sensor)
        write_bag(recording, tmp_path / "bag.mcap")
        bag, first = open_bag(tmp_path / "bag.mcap"), {}
        for record in bag.messages(["/tf_static", "/landmarks", "/landmarks_ground_truth"]):
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
            assert sensor != "range_bearing" or sigmas[1:] == pytest.approx(point["sigma_bearing"])
        assert [d.id for d in first["/landmarks_ground_truth"].detections] == [str(k) for k in range(len(names))]
    (tmp_path / "bag.mcap").unlink()
    with pytest.raises(GraphSlamError, match="no message holds bearing and position together"):
        write_bag(simulate("flight", 1, laps=1, sensor="bearing", beacons=3), tmp_path / "bag.mcap")
    assert not (tmp_path / "bag.mcap").exists()


def test_a_wrong_world_or_option_is_refused_by_name():
    for world, options, named in (
        ("mars", {}, "pythonrobotics, manhattan, warehouse, flight"),
        ("flight", {"sensor": "radar"}, "sensor: 'radar' is not one of pose, position"),
        ("flight", {"sensor": 3}, "3 is not a text"),
        ("warehouse", {"isles": 3}, "aisles"),
        ("warehouse", {"gps": 1}, "no option 'gps'; it has aisles"),
        ("warehouse", {"aisles": 2.5}, "2.5 is not an integer"),
        ("warehouse", {"aisles": 1}, "aisles: 1 is not in [2, 100]"),
        ("warehouse", {"gnss": 1000}, "warehouse: gnss: 1000.0 is not in [0, 100]"),
        ("warehouse", {"landmarks": 1}, "1 is not true or false"),
        ("manhattan", {"sigma_turn_rad_s": float("nan")}, "sigma_turn_rad_s: nan"),
    ):
        with pytest.raises(GraphSlamError) as refused:
            simulate(world, 0, **options)
        assert named in str(refused.value)
        assert "\n" not in str(refused.value)


# -- graphs ------------------------------------------------------------------------------------------------------------


def chi2_at(graph, values, label, edge_type):
    """The mean square of whitened residuals, by how much it may be off one, and the ends of the edges of a class."""
    table, size = graph.tables[edge_type], values.shape[1]
    residual, _ = edge_type.linearize(values.ravel(), size * table.vertices.values, table.measured.values)
    mine = table.label.values == graph.labels.index(label)
    whitened = np.einsum("nij,nj->ni", table.sqrt_information.values[mine], residual[mine])
    return (whitened**2).mean(), 5.0 * np.sqrt(2.0 / whitened.size), table.vertices.values[mine]


def test_the_truth_explains_the_graph_of_a_city_or_sphere_within_its_noise():
    for factor in (1.0, 5.0):
        city, truth = city_graph(4, poses=3000, blocks=10, odometry_noise_factor=factor)
        for label in ("odometry", "closures"):
            mean, most, ends = chi2_at(city, truth, label, RELATIVE_POSE)
            assert mean == pytest.approx(1.0, abs=most)
        assert chi2_at(city, city.initial.values.reshape(-1, 3), "odometry", RELATIVE_POSE)[0] < 1e-12, (
            "it starts there"
        )
    earlier, later = ends.T
    assert len(ends) == pytest.approx(3000 / 3, rel=0.05)
    assert (later - earlier).min() >= 20 and len(np.unique(later)) == len(later)
    assert np.abs(truth[earlier, :2] - truth[later, :2]).max() <= 2.0
    for sigma_rad in (0.01, 0.1):
        sphere, truth = sphere_graph(2, poses=1000, sigma_rad=sigma_rad, odometry_noise_factor=2.0)
        for label in ("odometry", "closures"):
            mean, most, ends = chi2_at(sphere, truth, label, RELATIVE_POSE_3D)
            assert mean == pytest.approx(1.0, abs=most)
        earlier, later = ends.T
        assert set((later - earlier).tolist()) == {50}
        radius = np.linalg.norm(truth[:, :3], axis=1)
        assert np.ptp(radius) < 1e-9 and radius[0] == pytest.approx(100.0)
        lap_m = np.linalg.norm(truth[50:, :3] - truth[:-50, :3], axis=1)
        assert lap_m == pytest.approx(2.0 * 100.0 * np.sin(np.pi / 40.0)), "a lap is a twentieth of the way up"
