import json
from dataclasses import replace as changed

import numpy as np
import pytest
from rows import each

from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.analysis.path_error import associate, path_error
from graph_slam_ros.analysis.trajectories import read_truth
from graph_slam_ros.cli import main
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.tum import tum_text
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.messages.to_msg import (
    encode,
    header,
    make,
    point,
    pose,
    pose_stamped,
    pose_with_covariance_stamped,
    vector,
)
from graph_slam_ros.recordings.bag import BagWriter
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.restore import map_of, record_run
from graph_slam_ros.runs.trajectory import Trajectory, read_landmarks, read_tum
from graph_slam_ros.slam import Config, Control
from graph_slam_ros.tools.simulation import measurements, simulate, write_bag
from graph_slam_ros.tools.simulation.instruments import geodetic

START_S = 1_700_000_000


def write_tum(path, stamps_s, poses):
    path.write_text(tum_text([round(s * 1e9) for s in stamps_s], poses))


def write_truth(path, stamps_s, poses, topic="/ground_truth"):
    with BagWriter(path) as bag:
        for stamp, p in zip(stamps_s, poses, strict=True):
            stamp_ns = round(stamp * 1e9)
            bag.write(topic, "geometry_msgs/msg/PoseStamped", stamp_ns, pose_stamped(stamp_ns, "world", tuple(p)))


def eight(count=200, dt_s=0.1):
    """A figure of eight, which has no symmetry that an alignment could confuse after its first half."""
    t = np.linspace(0.0, 5.0, count)
    poses = np.column_stack([4.0 * np.sin(t), 3.0 * np.sin(2.0 * t) + 0.2 * t, se2.wrap(t)])
    return planar(START_S + dt_s * np.arange(count), poses)


def planar(stamps_s, poses):
    return Trajectory(np.asarray(stamps_s), se3.in_space(poses))


def motion(x, y, theta):
    return tuple(se3.in_space((x, y, theta)))


def test_paths_without_common_stamps_are_refused_with_both_spans():
    truth = eight()
    with pytest.raises(GraphSlamError, match=r"0 of 200 stamps .* 1700000100\.000 .* 1700000000\.000"):
        associate(Trajectory(truth.stamps_s + 100.0, truth.poses), truth)


@pytest.fixture
def run(tmp_path):
    """A run with a perfect estimate, a dead reckoning of wrong scale, and a map that is 0.1 m wrong."""
    folder = tmp_path / "run"
    folder.mkdir()
    truth = eight()
    write_tum(folder / "sightings.tum", truth.stamps_s, truth.moved(motion(1.0, 2.0, 0.5)).poses)
    write_tum(folder / "odometry.tum", truth.stamps_s, truth.poses * (1.1, 1.1, *[1.0] * 5))
    write_tum(folder / "path.tum", truth.stamps_s[::2], truth.moved(motion(1.0, 2.0, 0.5)).poses[::2])
    rows = ["id,kind,x,y,theta,sightings,cov_xx,cov_xy,cov_yy"]
    rows += [f"{name},point,{x},{y},,3,1,0,1" for name, x, y in (("a", 7, 0), ("b", 0, 7), ("c", -7, 0), ("d", 0, -7))]
    (folder / "landmarks.csv").write_text("\n".join([*rows, "never surveyed,point,50,50,,1,1,0,1"]) + "\n")
    write_truth(tmp_path / "truth.mcap", truth.stamps_s, truth.poses)
    return folder


def add_true_landmarks(path, landmarks):
    """A bag with the true path of ``eight`` and the landmarks."""
    truth = eight()

    def detection(name, x, y):
        at = pose((x, y, 0.0))
        box = make("vision_msgs/msg/BoundingBox3D", center=at, size=vector(0, 0))
        return make("vision_msgs/msg/Detection3D", header=header(1, "world"), results=[], bbox=box, id=name)

    found = [detection(name, x, y) for name, (x, y) in landmarks.items()]
    message = make("vision_msgs/msg/Detection3DArray", header=header(1, "world"), detections=found)
    with BagWriter(path) as bag:
        bag.write("/landmarks_ground_truth", "vision_msgs/msg/Detection3DArray", 1, encode(message))
        for stamp, p in zip(truth.stamps_s, truth.poses, strict=True):
            cdr = pose_stamped(round(stamp * 1e9), "world", tuple(p))
            bag.write("/ground_truth", "geometry_msgs/msg/PoseStamped", round(stamp * 1e9), cdr)


def test_the_map_is_aligned_by_itself_and_only_what_both_know_counts(run, tmp_path):
    # the run's square of 7 m, a quarter turn and 100 m away, and 0.1 m smaller
    turned = {"a": (100.0, 6.9), "b": (93.1, 0.0), "c": (100.0, -6.9), "d": (106.9, 0.0)}
    add_true_landmarks(tmp_path / "map.mcap", turned | {"never seen": (0.0, 0.0)})
    assert evaluate(run, tmp_path / "map.mcap").map_rmse_m == pytest.approx(0.1)


def test_the_truth_of_another_drive_is_suspected(run, tmp_path):
    truth = eight()
    other = simulate("pythonrobotics", 1, poses=len(truth.stamps_s) - 1).T_world_base
    write_truth(tmp_path / "other.mcap", truth.stamps_s, se3.in_space(other))
    assert evaluate(run, tmp_path / "truth.mcap").warnings == ()
    assert evaluate(run, tmp_path / "truth.mcap").estimate.position_m["max"] < 1e-6
    assert evaluate(run, tmp_path / "truth.mcap", align=False).estimate.position_m["rmse"] > 1.0, "a shift is an error"
    (warning,) = evaluate(run, tmp_path / "other.mcap").warnings
    assert "check that the truth is of this robot and this drive" in warning


@each(
    "scale, late_s, said",
    [
        ((10.2, 10.2), 0.0, ""),
        ((1e4, 1e4), 0.0, "scaled by 0.001: is it in millimetres?"),
        ((10, -10), 0.0, "mirrored: does its y axis point to the left?"),
        ((10, 10), 2.0, "stamped 2.0 s earlier: is it of another clock?"),
    ],
)
def test_what_would_make_the_truth_fit_far_better_is_said_and_no_error_of_scale(run, tmp_path, scale, late_s, said):
    truth = eight()
    write_tum(run / "sightings.tum", truth.stamps_s, truth.poses * (10, 10, *[1.0] * 5))
    write_truth(tmp_path / "truth.mcap", truth.stamps_s + late_s, truth.poses * (*scale, *[1.0] * 5))
    assert evaluate(run, tmp_path / "truth.mcap").warnings == (f"the truth fits far better if {said}",) * bool(said)
    assert "if" not in "".join(evaluate(run, tmp_path / "truth.mcap", align=False).warnings)


def write_topics(path, topics):
    """A bag with one message, at x = 1, 2, ..., on each of the topics."""
    kinds = {"PoseStamped": "geometry_msgs/msg/PoseStamped", "Odometry": "nav_msgs/msg/Odometry"}
    with BagWriter(path) as bag:
        for x, (name, kind) in enumerate(topics.items(), start=1):
            bag.write(f"/{name}", kinds[kind], 1, message(kinds[kind], 1, pose((x, 0, 0))))
    return path


@each(
    "topics, chosen",
    [
        ({"a": "PoseStamped", "odom": "Odometry", "ground_truth": "PoseStamped"}, 3),
        ({"odom": "Odometry", "vicon": "PoseStamped"}, 2),
        ({"wheels": "Odometry", "vicon": "PoseStamped"}, 2),
        ({"odom": "Odometry", "vicon": "Odometry"}, 2),
        ({"odom": "Odometry"}, None),
        ({"wheels": "Odometry", "vicon": "Odometry"}, None),
    ],
)
def test_the_truth_is_its_usual_topic_or_the_only_one_of_poses_besides_the_odometry_else_it_must_be_named(
    tmp_path, topics, chosen
):
    bag = write_topics(tmp_path / "bag.mcap", topics)
    if chosen is None:
        with pytest.raises(GraphSlamError, match="with --topic") as refused:
            read_truth(bag)
        assert all(f"/{name}" in str(refused.value) for name in topics)
    one = read_truth(bag if chosen else f"{bag}:/{next(iter(topics))}")
    assert one.trajectory.poses[:, 0].tolist() == [chosen or 1]


def test_an_unknown_topic_is_refused_with_those_that_exist(run, tmp_path):
    write_bag(simulate("pythonrobotics", 0, poses=3), tmp_path / "bag.mcap")
    with pytest.raises(GraphSlamError, match=r"no topic /mocap of poses; with poses there are /ground_truth, /odom$"):
        evaluate(run, f"{tmp_path / 'bag.mcap'}:/mocap")
    with pytest.raises(GraphSlamError, match=r"no topic /landmarks of poses"):
        evaluate(run, f"{tmp_path / 'bag.mcap'}:/landmarks")


@each(
    "text, reason",
    [
        ("", "no pose in it"),
        ("1 2 3\n", "eight finite numbers"),
        ("1 2 3 0 0 0 nan 1\n", "eight finite numbers"),
        ("1 1e155 3 0 0 0 0 1\n", "eight finite numbers below 1e.20"),
        ("1 two 3 0 0 0 0 1\n", "two"),
        ("1 2 3 0 0 0 0 0\n", "a quaternion of zeros"),
        ("id,x,y,cov_xx,cov_xy,cov_yy\na,1,2,1,0,1e155\n", r"variance 1e\+155"),
    ],
)
def test_a_file_that_is_no_path_or_map_is_refused_by_name_in_one_line(tmp_path, text, reason):
    (tmp_path / "bad.tum").write_text(text)
    read = read_landmarks if text.startswith("id") else read_tum
    with pytest.raises(GraphSlamError, match=reason) as refused:
        read(tmp_path / "bad.tum")
    assert "bad.tum" in str(refused.value) and "\n" not in str(refused.value)


def test_absolute_and_relative_errors_are_those_of_evo():
    metrics, trajectory = (pytest.importorskip(f"evo.core.{name}") for name in ("metrics", "trajectory"))
    rng = np.random.default_rng(4)
    noise = [se3.exp(tuple(d)) for d in rng.normal(scale=0.05, size=(300, 6))]
    for dimensions in (2, 3):
        steps = [se3.exp(tuple(d)) for d in np.add(rng.normal(scale=0.3, size=(300, 6)), (0.5, 0, 0, 0, 0, 0.1))]
        poses = [se3.IDENTITY]
        for step in steps[1:]:
            poses.append(se3.compose(poses[-1], step))
        truth = Trajectory(START_S + np.arange(300.0), np.array(poses))
        truth = truth.in_plane() if dimensions == 2 else truth
        moved = np.stack(se3.compose(tuple(truth.poses.T), tuple(np.array(noise).T)), axis=1)
        estimate = Trajectory(truth.stamps_s, moved).moved(motion(4.0, 2.0, 1.0))
        ours = path_error(estimate, truth, dimensions)
        estimate = estimate.in_plane() if dimensions == 2 else estimate
        theirs = [
            trajectory.PoseTrajectory3D(t.poses[:, :3], np.roll(t.poses[:, 3:], 1, axis=1), t.stamps_s)
            for t in (truth, estimate)
        ]
        theirs[1].align(theirs[0])
        parts = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad
        absolute = zip(parts, (ours.position_m, ours.angle_rad), strict=True)
        relative = zip(parts, (ours.per_s.position, ours.per_s.angle), strict=True)
        pairs = [(metrics.APE(part), found) for part, found in absolute]
        pairs += [(metrics.RPE(part, 1.0, metrics.Unit.frames), found) for part, found in relative]  # at 1 Hz
        for metric, found in pairs:
            metric.process_data(tuple(theirs))
            for name, value in found.items():
                assert metric.get_statistic(metrics.StatisticsType[name]) == pytest.approx(value, rel=1e-6)


def write_fixes(path, stamps_s, poses, topic="/fix", datum=(48.0, 11.0, 500.0)):
    """NavSatFix at poses that lie east and north of the datum; the first message has no fix."""
    kind = "sensor_msgs/msg/NavSatFix"
    with BagWriter(path) as bag:
        places = geodetic(np.column_stack([poses[:, :2], 0.0 * poses[:, 0]]), datum).tolist()
        for k, (stamp, at) in enumerate(zip(stamps_s, places, strict=True)):
            status = make("sensor_msgs/msg/NavSatStatus", status=0 if k else -1, service=1)
            fields = dict(zip(("latitude", "longitude", "altitude"), at if k else [0.0] * 3, strict=True))
            fields |= {"position_covariance": np.zeros(9), "position_covariance_type": 0, "status": status}
            stamp_ns = round(stamp * 1e9)
            bag.write(topic, kind, stamp_ns, encode(make(kind, header=header(stamp_ns, "world"), **fields)))


def test_fixes_are_a_truth_without_orientation_east_and_north_of_the_first(run, tmp_path):
    truth = eight()
    write_fixes(tmp_path / "fixes.mcap", truth.stamps_s, truth.poses)
    scores = evaluate(run, tmp_path / "fixes.mcap")
    assert scores.estimate.position_m["max"] < 0.005
    assert scores.odometry.position_m["rmse"] > 0.1
    assert (scores.estimate.angle_rad, scores.estimate.per_s.angle) == (None, None)
    assert scores.estimate.per_m.position["max"] < 0.005
    assert scores.estimate.n == 199, "the first is no fix"
    assert "heading" not in str(scores)
    assert "deg" not in str(scores)
    assert json.loads(json.dumps(scores.as_dict()))["heading_rad"] is None
    assert scores.scored["truth"] == "/fix (sensor_msgs/msg/NavSatFix)"
    first = read_truth(tmp_path / "fixes.mcap").trajectory.poses[0, :3]
    assert first == pytest.approx(np.zeros(3), abs=1e-9)


def write_transforms(path, *pairs):
    """On /tf at each stamp the poses of ``eight`` between the first two frames, and standing still between others."""
    with BagWriter(path) as bag:
        for stamp, p in zip(eight().stamps_s, eight().poses, strict=True):
            stamp_ns, transforms = round(stamp * 1e9), []
            for k, (parent, child) in enumerate(pairs):
                at = pose((1.0, 2.0, 0.0)) if k else pose(tuple(p))
                place = vector(at.position.x, at.position.y)
                moved = make("geometry_msgs/msg/Transform", translation=place, rotation=at.orientation)
                kind = "geometry_msgs/msg/TransformStamped"
                transforms.append(make(kind, header=header(stamp_ns, parent), child_frame_id=child, transform=moved))
            cdr = encode(make("tf2_msgs/msg/TFMessage", transforms=transforms))
            bag.write("/tf", "tf2_msgs/msg/TFMessage", stamp_ns, cdr)


def test_a_transform_is_a_truth_by_the_names_of_its_frames(run, tmp_path):
    write_transforms(tmp_path / "tf.mcap", ("vicon", "robot"), ("base_link", "wheel"))
    bag = tmp_path / "tf.mcap"
    for scores in (evaluate(run, bag, topic="/tf:vicon:robot"), evaluate(run, f"{bag}:/tf:vicon:robot")):
        assert scores.estimate.position_m["max"] < 1e-6
        assert scores.estimate.angle_rad["max"] < 1e-6
    with pytest.raises(GraphSlamError, match=r"--topic one of /tf:base_link:wheel, /tf:vicon:robot$"):
        evaluate(run, bag, topic="/tf")
    with pytest.raises(GraphSlamError, match=r"no transform /tf:vicon:base; there are /tf:base_link:wheel"):
        evaluate(run, bag, topic="/tf:vicon:base")
    with pytest.raises(GraphSlamError, match="/tf:PARENT:CHILD"):
        evaluate(run, bag)
    write_transforms(tmp_path / "of map.mcap", ("vicon", "robot"), ("map", "base_link"))
    assert read_truth(tmp_path / "of map.mcap", "/tf:vicon:robot").doubt == ""
    assert "map and odom" in read_truth(tmp_path / "of map.mcap", "/tf:map:base_link").doubt, "a localiser's"
    write_transforms(tmp_path / "one.mcap", ("vicon", "robot"))
    assert evaluate(run, tmp_path / "one.mcap", topic="/tf").estimate.position_m["max"] < 1e-6


def test_a_pose_that_is_not_finite_is_left_out_and_told(tmp_path):
    truth = eight()
    poses = truth.poses.copy()
    poses[5] = np.nan
    write_truth(tmp_path / "truth.mcap", truth.stamps_s, poses)
    known = read_truth(tmp_path / "truth.mcap")
    assert len(known.trajectory.stamps_s) == 199
    assert known.losses == ("1 of 200 poses on /ground_truth are not finite",)


def test_drift_is_the_error_of_a_second_and_of_a_metre_whatever_their_steps():
    seconds = np.arange(0.0, 60.0, 0.25)
    truth = planar(START_S + seconds, np.column_stack([2.0 * seconds, 0.0 * seconds, 0.0 * seconds]))
    too_far = planar(truth.stamps_s, np.column_stack([2.2 * seconds, 0.0 * seconds, 0.03 * seconds]))
    error = path_error(too_far, truth)
    assert error.per_s.angle["max"] == pytest.approx(0.03)
    assert error.per_m.angle["max"] == pytest.approx(0.015)
    straight = planar(truth.stamps_s, np.column_stack([2.2 * seconds, 0.0 * seconds, 0.0 * seconds]))
    assert path_error(straight, truth).per_s.position["rmse"] == pytest.approx(0.2)
    assert path_error(straight, truth).per_m.position["rmse"] == pytest.approx(0.1)


def test_a_run_that_saw_nothing_is_scored_at_its_keyframes(run, tmp_path):
    truth = eight()
    (run / "sightings.tum").write_text("")
    (run / "odometry.tum").write_text("")
    write_tum(run / "path_odometry.tum", truth.stamps_s[::2], truth.poses[::2] * (1.1, 1.1, *[1.0] * 5))
    scores = evaluate(run, tmp_path / "truth.mcap")
    assert scores.estimate.n == scores.odometry.n == 100
    assert scores.estimate.position_m["max"] < 1e-6 < 0.1 < scores.odometry.position_m["rmse"]
    assert scores.scored["estimate"] == "path.tum"


def test_of_a_run_in_a_loaded_map_the_drive_of_the_truth_alone_is_scored_also_where_it_is_older_than_the_map(tmp_path):
    world = simulate("pythonrobotics", 0, poses=30)
    write_bag(world, tmp_path / "bag.mcap")
    replay(tmp_path / "bag.mcap", tmp_path / "before")
    before = map_of(tmp_path / "before", [])
    hour_ns = -3_600_000_000_000
    record_run(tmp_path / "after", Config(), [*later(measurements(world), hour_ns), Control("end")], [], before)
    truth = Trajectory((world.stamps_ns + hour_ns) / 1e9, se3.in_space(world.T_world_base))
    write_tum(tmp_path / "truth.tum", truth.stamps_s, truth.poses)
    new = evaluate(tmp_path / "after", tmp_path / "truth.tum")
    assert new.scored["estimate"].startswith("sightings.tum, drive 2 of 2 alone")
    assert new.estimate.n == new.estimate.of == new.odometry.of
    assert "left out: the map was there before the drive" in str(new)
    old = evaluate(tmp_path / "after", tmp_path / "bag.mcap")
    assert old.scored["estimate"].startswith("sightings.tum, drive 1 of 2 alone")
    assert old.consistency.poses.n > 0
    whole = read_tum(tmp_path / "after" / "sightings.tum")
    assert new.estimate.of + old.estimate.of == len(whole.stamps_s)
    assert new.estimate.position_m["rmse"] < 0.5 * new.odometry.position_m["rmse"]


def later(items, by_ns):
    for one in items:
        yield changed(one, stamp_ns=one.stamp_ns + by_ns)


def write_estimate(file, name, sigma_m):
    """Poses of ``eight`` as a localiser publishes them."""
    truth = eight()
    with BagWriter(file) as bag:
        for stamp_s, pose in zip(truth.stamps_s, truth.poses, strict=True):
            stamp_ns = round(stamp_s * 1e9)
            at = (*pose[:2].tolist(), 0.0)
            message = pose_with_covariance_stamped(stamp_ns, "map", at, sigma_m**2 * np.eye(3), 0.0)
            bag.write(name, "geometry_msgs/msg/PoseWithCovarianceStamped", stamp_ns, message)
    return file


@each(
    "name, sigma_m, why",
    [
        ("/pose", 0.2, "its poses have a covariance (a standard deviation of 0.2 m)"),
        ("/robot/amcl_pose", 0.0, "by its name it is the output of a localiser"),
        ("/vicon", 0.001, ""),
        ("/vicon", 0.0, ""),
    ],
)
def test_a_truth_that_is_an_estimate_is_doubted(tmp_path, capsys, monkeypatch, run, name, sigma_m, why):
    monkeypatch.setattr("graph_slam_ros.cli.evaluate.draw", lambda *_, **__: None)
    truth = f"{write_estimate(tmp_path / 'e.mcap', name, sigma_m)}:{name}"
    assert main(["evaluate", str(run), "--truth", truth]) == 3 * bool(why)
    out, err = capsys.readouterr()
    assert f"{name} (geometry_msgs/msg/PoseWithCovarianceStamped)" in out
    assert ("differences between two estimates" in err) == bool(why) and why in " ".join(err.split())


def message(kind, stamp_ns, at):
    """A pose as a message of any of the types that have one."""
    still = make("geometry_msgs/msg/Twist", linear=vector(0, 0), angular=vector(0, 0))
    spread = make("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=np.zeros(36))
    p, child = at.position, {"child_frame_id": "base_link"}
    moved = make("geometry_msgs/msg/Transform", translation=vector(p.x, p.y, p.z), rotation=at.orientation)
    twist = make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.zeros(36))
    fields = {
        "geometry_msgs/msg/PoseStamped": {"pose": at},
        "geometry_msgs/msg/PoseWithCovarianceStamped": {"pose": spread},
        "nav_msgs/msg/Odometry": {"pose": spread, "twist": twist, **child},
        "geometry_msgs/msg/TransformStamped": {"transform": moved, **child},
        "geometry_msgs/msg/PointStamped": {"point": p},
    }[kind]
    return encode(make(kind, header=header(stamp_ns, "world"), **fields))


STAMPED = [f"geometry_msgs/msg/{name}Stamped" for name in ("Pose", "PoseWithCovariance", "Transform", "Point")]


@each("kind", [*STAMPED, "nav_msgs/msg/Odometry"])
def test_truth_is_read_from_every_type_of_pose_or_point(tmp_path, kind):
    stamp_ns = START_S * 10**9 + 123_456_789
    at = make("geometry_msgs/msg/Pose", position=point(1.0, 2.0, 9.0), orientation=pose((1.0, 2.0, 2.5)).orientation)
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.write("/here", kind, 1, message(kind, stamp_ns, at))
    trajectory = read_truth(f"{tmp_path / 'a.mcap'}:/here").trajectory
    assert trajectory.stamps_s.tolist() == [float("1700000000.123456789")]
    assert trajectory.has_orientation is (kind != STAMPED[-1])
    expected = [1.0, 2.0, 9.0, *motion(0.0, 0.0, 2.5 * trajectory.has_orientation)[3:]]
    assert trajectory.poses == pytest.approx(np.array([expected]))
