"""What info offers of a recording and what not; the command works as it is pasted; a replay says what came of it."""

import json
import math
import shlex
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from foreign import DEFINITIONS
from messages import cloud, detection, detections, gnss, imu, odometry, pose, posed, quaternion, recorded, transforms
from recordings import definition, write_mcap

from graph_slam_ros.cli import main
from graph_slam_ros.lie import se2
from graph_slam_ros.messages.to_msg import header, make, vector
from graph_slam_ros.recordings.bag import BagWriter
from graph_slam_ros.runs.outcome import doubts, shortcomings

NS = 10**9
START_NS = 1_700_000_000 * NS
ODOM, TF, FIX, IMU = (
    "nav_msgs/msg/Odometry",
    "tf2_msgs/msg/TFMessage",
    "sensor_msgs/msg/NavSatFix",
    "sensor_msgs/msg/Imu",
)
DETECTIONS, CLOUD = "vision_msgs/msg/Detection3DArray", "sensor_msgs/msg/PointCloud2"
POSE, WITH_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
PLACES = {"north": (0.0, 5.0), "east": (5.0, 1.0), "south": (1.0, -4.0)}
STEPS = 120


def write(file, *topics, steps=STEPS):
    """A robot on a circle, 10 Hz; each topic is (name, type, message of step, stamp, true pose and drifting pose)."""
    truth = drifting = se2.IDENTITY
    with BagWriter(file) as bag:
        for k in range(steps):
            stamp_ns = START_NS + k * NS // 10
            for name, kind, made in topics:
                if (cdr := made(k, stamp_ns, truth, drifting)) is not None:
                    bag.write(name, kind, stamp_ns + 1000, cdr)
            truth = se2.compose(truth, (0.2, 0.0, 0.05))
            drifting = se2.compose(drifting, (0.2, 0.0, 0.052))
    return file


def odom(frame="odom", child="base_link", every=1, height=0.0, lag_ns=0):
    def made(k, stamp_ns, truth, drifting):
        x, y, yaw = drifting
        at = pose(x, y, height * k, quaternion(yaw=yaw))
        return odometry(at, frame, child, stamp_ns - lag_ns) if k % every == 0 else None

    return made


def seen(names=None, frame="base_link", lag_ns=0, class_ids=False, upside=False):
    def made(k, stamp_ns, truth, drifting):
        found = []
        for name, at in PLACES.items():
            x, y = map(float, se2.act(se2.inverse(truth), at))
            told = name if names is None else names(name, k)
            found.append(detection(pose(x, y), np.eye(2) * 0.01, told, class_id=name if class_ids else "kind"))
        return detections(*found, frame=frame, stamp_ns=stamp_ns - lag_ns)

    return made


def satellite(frame="gps", status=0, kind=2):
    def made(k, stamp_ns, truth, drifting):
        north, east = truth[1] / 111_200.0, truth[0] / (111_320.0 * math.cos(math.radians(48.0)))
        fields = {"status": status, "kind": kind, "stamp_ns": stamp_ns, "frame": frame}
        return gnss(48.0 + north, 11.0 + east, covariance=np.eye(3) * 0.01, **fields) if k % 5 == 0 else None

    return made


def compass(covariance=0.01, frame="imu_link"):
    return lambda k, stamp_ns, truth, drifting: imu(
        quaternion(yaw=truth[2]), np.eye(3) * covariance, frame=frame, stamp_ns=stamp_ns, rate=(0.0, 0.0, 0.3)
    )


def beacons(*names, frame="uwb"):
    def made(k, stamp_ns, truth, drifting):
        layout = [(name, "u4" if name == "id" else "f8") for name in names]
        points = []
        for number, at in enumerate(PLACES.values()):
            x, y = se2.act(se2.inverse(truth), at)
            told = {"id": number, "range": math.hypot(x, y), "bearing": math.atan2(y, x), "x": x, "y": y}
            points.append(tuple(told[name] for name in names))
        return cloud(layout, *points, frame=frame, stamp_ns=stamp_ns)

    return made


def at(kind="PoseStamped", frame="map", covariance=None):
    return lambda k, stamp_ns, truth, drifting: posed(
        kind, pose(*truth[:2], 0.0, quaternion(yaw=truth[2])), frame, covariance, stamp_ns
    )


ODOMETRY = ("/odom", ODOM, odom())
SEEN = ("/tags", DETECTIONS, seen())


@pytest.fixture
def info(tmp_path, monkeypatch, capsys):
    """Of a recording of these topics: (exit code, lines, words of the command)."""
    monkeypatch.chdir(tmp_path)

    def said(*topics, name="drive.mcap", **options):
        file = write(tmp_path / name, *topics, **options)
        capsys.readouterr()
        code = main(["info", str(file.relative_to(tmp_path))])
        lines = capsys.readouterr().out.splitlines()
        return code, lines, shlex.split(lines[-1]) if code == 0 else []

    return said


def run(words, capsys, code=0):
    """Paste the command; returns what run.json says, and standard output and error."""
    assert words[:2] == ["graph_slam", "replay"]
    got = main(words[1:])
    out, err = capsys.readouterr()
    assert got == code, err
    return json.loads((Path(words[-1]) / "run.json").read_text()), out, err


# -- odometry ----------------------------------------------------------------------------------------------------------


def test_of_several_odometries_the_best_is_chosen_and_it_is_said(info, capsys):
    code, lines, words = info(
        ("/wheel/odom_raw", ODOM, odom()),
        ("/odometry/filtered", ODOM, odom()),
        ("/odometry/global", ODOM, odom(frame="map")),
        ("/ground_truth/odom", ODOM, odom(frame="world")),
        SEEN,
    )
    assert code == 0
    assert words[words.index("--odom") + 1] == "/odometry/filtered"
    assert any("2 odometries: /odometry/filtered is chosen" in line for line in lines)
    said = "\n".join(lines)
    for topic, why in (
        ("/odometry/global", "in frame map"),
        ("/ground_truth/odom", "ground truth"),
        ("raw", "another"),
    ):
        assert any(line.startswith("not used: ") and topic in line and why in line for line in lines), said
    assert run(words, capsys)[0]["inputs"]["odom"]["used"] == STEPS


@pytest.mark.parametrize("frame, child", [("robot1/odom", "robot1/base_footprint"), ("world", "imu"), ("", "")])
def test_odometry_in_unusual_frames_is_used_as_it_is(info, capsys, frame, child):
    code, _, words = info(("/o", ODOM, odom(frame, child)), ("/tags", DETECTIONS, seen(frame=child or "base_link")))
    assert code == 0
    told, _, _ = run(words, capsys)
    assert told["inputs"]["odom"]["used"] == STEPS
    assert told["landmarks"] == 3


def test_odometry_may_be_on_tf_alone_in_any_frames(info, capsys):
    def moving(k, stamp_ns, truth, drifting):
        x, y, yaw = drifting
        return transforms(("odom_combined", "base_footprint", (x, y, 0.0), quaternion(yaw=yaw)), stamp_ns=stamp_ns)

    code, lines, words = info(("/tf", TF, moving), ("/tags", DETECTIONS, seen(frame="base_footprint")))
    assert code == 0
    assert "note: odometry is odom_combined -> base_footprint of /tf: there is no topic with it" in lines
    assert run(words, capsys)[0]["landmarks"] == 3


def test_a_replay_without_options_takes_odometry_of_other_types_and_says_so(info, capsys):
    def moving(k, stamp_ns, truth, drifting):
        x, y, yaw = drifting
        return transforms(("odom", "base_link", (x, y, 0.0), quaternion(yaw=yaw)), stamp_ns=stamp_ns)

    info(("/tf", TF, moving), SEEN)
    summary, _, err = run(["graph_slam", "replay", "drive.mcap", "--out", "out"], capsys)
    assert "there is no odometry of the usual type, so this is: graph_slam replay drive.mcap --landmarks /tags" in err
    assert summary["landmarks"] == 3


def test_odometry_that_leaves_the_plane_is_offered_in_three_dimensions_and_a_replay_in_two_says_so(info, capsys):
    code, lines, words = info(("/odom", ODOM, odom(height=0.02)), SEEN)
    assert code == 0
    assert "world.dimensions=3" in words
    assert any("these are three dimensions" in line for line in lines)
    run(words, capsys)
    _, _, err = run(["graph_slam", "replay", words[2], "--landmarks", "/tags", "--out", "flat"], capsys, code=3)
    assert "odom leaves the plane: these are three dimensions: --set world.dimensions=3" in err


@pytest.mark.parametrize("topics", [[SEEN], [("/odom", ODOM, odom(frame="map")), SEEN]])
def test_without_odometry_there_is_no_command_and_the_code_is_3(info, topics):
    code, lines, _ = info(*topics)
    assert code == 3
    assert lines[-1].startswith("not ready for replay: no odometry")


@pytest.mark.parametrize("frame, name", [("odom", "/camera/pose"), ("start", "/vio/pose")])
def test_poses_that_are_odometry_by_a_name_are_offered_where_there_is_no_other(info, capsys, frame, name):
    def posed_at(k, stamp_ns, truth, drifting):
        x, y, yaw = drifting
        return posed("PoseStamped", pose(x, y, 0.02 * k, quaternion(yaw=yaw)), frame, None, stamp_ns)

    code, lines, words = info((name, POSE, posed_at), SEEN)
    assert code == 0
    assert {"odom.use=odometry", f"odom.type={POSE}", "world.dimensions=3"} <= set(words)
    assert any(line.startswith(f"note: odometry is {name}, poses without a child frame") for line in lines)
    summary, _, _ = run(words, capsys)
    assert summary["landmarks"] == 3
    main(["check", words[2], "--quick"])
    assert f"--odom {name}" in capsys.readouterr().out


@pytest.mark.parametrize(
    "frame, name, says",
    [
        ("map", "/vio/pose", "/vio/pose: in frame map: somebody's estimate, not odometry"),
        ("odom", "/amcl_pose", "/amcl_pose: the output of a localiser, or a goal, not odometry"),
        ("start", "/camera/pose", f"if /camera/pose is odometry: --set odom.type={POSE} --set odom.topic=/camera/pose"),
    ],
)
def test_poses_that_may_be_anything_are_not_offered_and_it_is_said_how_to_use_them(info, frame, name, says):
    code, lines, _ = info((name, POSE, at(frame=frame)), SEEN)
    assert code == 3
    assert says in lines[-1]


# -- landmarks ---------------------------------------------------------------------------------------------------------


def test_detections_without_ids_are_told_apart_by_place_and_those_with_class_ids_by_these(info, capsys):
    code, _, words = info(ODOMETRY, ("/trees", DETECTIONS, seen(lambda name, k: "")))
    assert code == 0
    assert "landmarks.association=joint" in words
    assert run(words, capsys)[0]["landmarks"] == 3
    _, _, words = info(ODOMETRY, ("/trees", DETECTIONS, seen(lambda name, k: "", class_ids=True)), name="b.mcap")
    assert "landmarks.id_from=class_id" in words
    assert run(words, capsys)[0]["landmarks"] == 3


def test_detections_by_another_clock_are_brought_to_that_of_odometry(info, capsys):
    code, lines, words = info(ODOMETRY, ("/tags", DETECTIONS, seen(lag_ns=100 * NS)))
    assert code == 0
    assert any("another clock than odometry: 100.000 s are added" in line for line in lines)
    assert run(words, capsys)[0]["inputs"]["detections"]["used"] > 300


def test_a_recording_whose_stamps_are_of_another_time_than_it_was_received_is_used_as_it_is(info, capsys):
    early = {"lag_ns": START_NS - 900 * NS}  # a simulator's clock
    _, _, words = info(("/odom", ODOM, odom(**early)), ("/tags", DETECTIONS, seen(**early)))
    assert run(words, capsys)[0]["landmarks"] == 3


def test_stamps_that_are_zero_are_said(info):
    _code, lines, _ = info(ODOMETRY, ("/tags", DETECTIONS, lambda k, s, t, d: seen()(k, 0, t, d)))
    assert "not used: /tags: its stamps are zero: have the driver fill in header.stamp" in lines


def test_a_frame_that_tf_does_not_tell_of_is_assumed_at_the_base_and_it_is_said(info, capsys):
    _code, lines, words = info(ODOMETRY, ("/tags", DETECTIONS, seen(frame="camera")))
    assert "detections.mount=0 0 0 0 0 0" in words
    assert any("no transform has the pose of camera" in line for line in lines)
    assert run(words, capsys)[0]["landmarks"] == 3


def test_poses_of_single_tags_by_the_camera_are_landmarks(info, capsys):
    def tag(at):
        def made(k, stamp_ns, truth, drifting):
            x, y = map(float, se2.act(se2.inverse(truth), at))
            return posed("PoseStamped", pose(x, y), "base_link", None, stamp_ns)

        return made

    topics = [(f"/tag_{n}/pose", POSE, tag(at)) for n, at in enumerate(PLACES.values())]
    code, _, words = info(ODOMETRY, *topics)
    assert code == 0
    told, _, _ = run(words, capsys)
    assert told["landmarks"] == 3
    assert told["inputs"]["tag"]["use"] == "landmarks"


@pytest.mark.parametrize("base", ["base_link", "robot1/base_footprint"])
def test_odometry_of_a_frame_that_tf_does_not_link_to_the_base_of_the_sensors_is_taken_for_it(info, capsys, base):
    fixed = transforms((base, "camera", (0.0, 0.0, 0.5), quaternion(yaw=0.0)))
    static = ("/tf_static", TF, lambda k, *_: None if k else fixed)
    code, lines, words = info(
        static, ("/odom", ODOM, odom(child="chassis")), ("/tags", DETECTIONS, seen(frame="camera"))
    )
    assert code == 0
    assert "odom.mount=0 0 0 0 0 0" in words
    assert f"note: no transform links chassis, which odometry names, to {base}" in " ".join(lines)
    assert run(words, capsys)[0]["landmarks"] == 3


def test_transforms_of_a_robot_that_are_not_read_are_named(info):
    def standing(k, stamp_ns, truth, drifting):
        return transforms(("base_link", "camera", (0.1, 0.0, 0.0), quaternion(yaw=0.0)), stamp_ns=stamp_ns)

    _, lines, _ = info(ODOMETRY, SEEN, ("/tf_static", TF, standing), ("/robot1/tf_static", TF, standing))
    assert "not used: /robot1/tf_static: /tf_static is there, and it alone is read" in lines


def test_topics_of_types_that_no_input_reads_are_named(info, capsys):
    scan = ("/scan", "sensor_msgs/msg/LaserScan", lambda k, stamp_ns, *_: None if k else b"\0\1\0\0")
    code, lines, _words = info(ODOMETRY, scan)
    assert code == 0
    assert "note: no input reads /scan (sensor_msgs/msg/LaserScan)" in " ".join(lines)
    assert "publish them as Detection3DArray" in " ".join(lines)
    _, lines, _ = info(ODOMETRY, SEEN, name="b.mcap")
    assert not any("no input reads" in line for line in lines)


@pytest.mark.parametrize("fields", [("range", "id"), ("range", "bearing", "id"), ("x", "y", "id"), ("bearing", "id")])
def test_clouds_of_landmarks_are_offered_by_their_fields(info, capsys, fields):
    code, _, words = info(ODOMETRY, ("/beacons", CLOUD, beacons(*fields)))
    assert code == 0
    told, _, _ = run(words, capsys)
    assert told["landmarks"] == 3
    assert told["inputs"][words[words.index("--set") + 1].split()[-1]]["used"] > 300


def test_of_two_robots_the_landmarks_of_one_are_taken(info, capsys):
    topics = [(f"/{robot}/{name}", kind, made) for robot in ("a", "b") for name, kind, made in
              (("odom", ODOM, odom()), ("tags", DETECTIONS, seen()))]  # fmt: skip
    code, lines, words = info(*topics)
    assert code == 0
    assert "not used: /b/tags: of the robot of /b/odom: --odom /b/odom --landmarks /b/tags" in " ".join(lines)
    told, _, _ = run(words, capsys)
    assert told["inputs"].keys() == {"odom", "detections"}


def test_landmarks_beside_another_odometry_are_taken_where_the_chosen_one_has_none(info):
    _, _, words = info(
        ("/wheel/odom", ODOM, odom()), ("/zed/odom", ODOM, odom(every=2)), ("/zed/tags", DETECTIONS, seen())
    )
    assert (words[words.index("--odom") + 1], words[words.index("--landmarks") + 1]) == ("/wheel/odom", "/zed/tags")


def test_a_scan_and_a_picture_are_no_landmarks(info, capsys):
    _code, lines, words = info(ODOMETRY, ("/scan", CLOUD, beacons("x", "y")))
    assert any(line.startswith("not used: /scan: points without ids") for line in lines)
    run(words, capsys, code=3)


def test_corners_without_poses_are_named_with_what_makes_poses_of_them(tmp_path, capsys):
    name = "apriltag_msgs/msg/AprilTagDetectionArray"
    _, _, encoded = recorded(name, DEFINITIONS[name])
    corners = encoded(header=header(START_NS, "camera"), detections=[])
    sent = [("/odom", START_NS, odometry(stamp_ns=START_NS)), ("/tags", START_NS, corners)]
    file = write_mcap(
        tmp_path / "a.mcap",
        [SimpleNamespace(topic=topic, log_ns=stamp_ns, cdr=cdr) for topic, stamp_ns, cdr in sent],
        types={"/odom": ODOM, "/tags": name},
        text=lambda type_name: DEFINITIONS.get(type_name) or definition(type_name),
    )
    assert main(["info", str(file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "not used: /tags: these are corners without poses: run a pose estimator first" in " ".join(lines)
    assert "inputs.names=odom" in lines[-1]


def test_tags_of_packages_that_need_not_be_there_are_offered_and_a_map_of_them_is_not(tmp_path, monkeypatch, capsys):
    markers, fiducials = "aruco_markers_msgs/msg/MarkerArray", "fiducial_msgs/msg/FiducialTransformArray"
    fiducial_map = "fiducial_msgs/msg/FiducialMapEntryArray"
    (_, marker, markers_cdr), (_, fiducial, fiducials_cdr) = (recorded(t, DEFINITIONS[t]) for t in (markers, fiducials))
    sent, truth = [], se2.IDENTITY
    for k in range(STEPS):
        stamp_ns = START_NS + k * NS // 10
        head, late = header(stamp_ns, "base_link"), header(stamp_ns + NS // 20, "base_link")
        seen = [pose(*se2.act(se2.inverse(truth), at)) for at in PLACES.values()]
        poses = [make("geometry_msgs/msg/PoseStamped", header=head, pose=at) for at in seen]
        moves = [
            make("geometry_msgs/msg/Transform", translation=vector(at.position.x, at.position.y, 0.0),
                 rotation=at.orientation)
            for at in seen
        ]  # fmt: skip
        unused = {"image_error": 0.5, "object_error": 0.01, "fiducial_area": 900.0}
        of_markers = [
            marker("aruco_markers_msgs/msg/Marker", header=head, id=number, pose=at, pixel_x=0.0, pixel_y=0.0)
            for number, at in enumerate(poses)
        ]
        of_fiducials = [
            fiducial("fiducial_msgs/msg/FiducialTransform", fiducial_id=100 + number, transform=at, **unused)
            for number, at in enumerate(moves)
        ]
        sent += [
            ("/odom", stamp_ns, odom()(k, stamp_ns, truth, truth)),
            ("/aruco/markers", stamp_ns, markers_cdr(header=late, markers=of_markers)),
            ("/fiducial_transforms", stamp_ns, fiducials_cdr(header=head, image_seq=k, transforms=of_fiducials)),
            ("/fiducial_map", stamp_ns, b"\0\1\0\0\0\0\0\0"),
        ]
        truth = se2.compose(truth, (0.2, 0.0, 0.05))
    write_mcap(
        tmp_path / "a.mcap",
        [SimpleNamespace(topic=topic, log_ns=stamp_ns, cdr=cdr) for topic, stamp_ns, cdr in sent],
        types={
            "/odom": ODOM,
            "/aruco/markers": markers,
            "/fiducial_transforms": fiducials,
            "/fiducial_map": fiducial_map,
        },
        text=lambda name: "int32[] fiducials\n" if name == fiducial_map else DEFINITIONS.get(name) or definition(name),
    )
    monkeypatch.chdir(tmp_path)
    assert main(["info", "a.mcap"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"no input reads /fiducial_map ({fiducial_map})" in " ".join(lines)
    told, _, _ = run(shlex.split(lines[-1]), capsys)
    assert told["landmarks"] == 6
    assert [told["inputs"][name]["believed"] for name in ("tags", "tags_2")] == [3 * STEPS, 3 * STEPS]


# -- fixes -------------------------------------------------------------------------------------------------------------


def test_fixes_are_offered_with_an_antenna_at_the_base(info, capsys):
    code, lines, words = info(ODOMETRY, ("/gps/fix", FIX, satellite()))
    assert code == 0
    assert any("no transform has the pose of" in line and "at the base is assumed" in line for line in lines)
    assert not any(word.startswith("gps.mount") for word in words)  # else the run would no more warn of it
    assert not any(word.startswith("anchor.") for word in words)  # it loosens by itself
    told, _, _ = run(words, capsys)
    counted = told["counters"]["gps"]
    assert told["inputs"]["gps"]["believed"] + counted["thinned"] == counted["mount_unknown"] == STEPS // 5


def test_fixes_of_unknown_noise_get_one_and_a_receiver_without_fix_is_not_offered(info, capsys):
    _, lines, words = info(ODOMETRY, ("/gps/fix", FIX, satellite(kind=0)), ("/gps2/fix", FIX, satellite(status=-1)))
    assert "gps.sigma_m=2.0" in words
    told, _, _ = run(words, capsys)
    assert told["inputs"]["gps"]["believed"] + told["counters"]["gps"]["thinned"] == STEPS // 5
    _, lines, _ = info(ODOMETRY, ("/gps2/fix", FIX, satellite(status=-1)), name="b.mcap")
    assert "not used: /gps2/fix: no message has a fix" in lines


@pytest.mark.parametrize("covariance", [0.01, 0.0])
def test_an_imu_is_offered_where_nothing_else_is(info, capsys, covariance):
    code, _, words = info(ODOMETRY, ("/imu/data", IMU, compass(covariance)))
    assert code == 0
    assert run(words, capsys)[0]["inputs"]["imu"]["believed"] > 0
    _, lines, words = info(ODOMETRY, SEEN, ("/imu/data", IMU, compass()), name="b.mcap")
    assert not any("imu" in word for word in words)
    assert any(line.startswith("not used: /imu/data: its heading may drift") for line in lines)
    offered = shlex.split(" ".join(lines).split("part of odometry: ")[1].split(" what is wrong")[0])
    told, _, err = run([*words[:-2], *offered, "--out", "b_imu"], capsys, code=3)
    assert told["inputs"]["imu"]["used"] > 0
    assert "stand for a second before the drive" in err  # the bias of the gyro is learnt at rest
    _, lines, _ = info(ODOMETRY, ("/imu/raw", IMU, compass(-1.0)), name="c.mcap")
    assert any(line.startswith("not used: /imu/raw: it has no orientation") for line in lines)
    assert "--set imu.topic=/imu/raw --set 'imu.mount=0 0 0 0 0 0' --set imu.use=gyro" in " ".join(
        " ".join(lines).split()
    )


def test_poses_are_offered_where_nothing_else_is_but_no_estimates_and_no_truth(info, capsys):
    known = np.diag([0.01, 0.01, 0.01, 0.01, 0.01, 0.01])
    topics = [
        ("/amcl_pose", WITH_COVARIANCE, at("PoseWithCovarianceStamped", covariance=known)),
        ("/ground_truth", POSE, at()),
        ("/reference/pose", WITH_COVARIANCE, at("PoseWithCovarianceStamped", covariance=known)),
    ]
    _, _, words = info(ODOMETRY, *topics)
    assert not any("pose" in word for word in words)
    run(words, capsys, code=3)
    uwb = "/uwb/position", WITH_COVARIANCE, at("PoseWithCovarianceStamped", "world", known)
    _code, _lines, words = info(ODOMETRY, *topics, uwb, name="b.mcap")
    assert "pose.topic=/uwb/position" in words
    told, _, _ = run(words, capsys)
    assert told["inputs"]["pose"]["believed"] > 10
    assert told["inputs"]["pose"]["believed"] + told["counters"]["pose"]["thinned"] > 100


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_result_of_a_run_is_not_offered(info, capsys):
    _, _, words = info(ODOMETRY, SEEN)
    run(words, capsys)
    assert main(["info", f"{words[-1]}/run.mcap"]) == 3
    assert "this is the result of a run" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["a b's $drive.mcap", "-x.mcap", "drive.mcap"])
def test_the_command_can_be_pasted_whatever_the_recording_is_called_and_names_a_folder_after_it(info, name, capsys):
    Path("drive_run").mkdir()
    file = write(Path(name), ODOMETRY, SEEN, steps=30)
    assert main(["info", "--", str(file)]) == 0
    words = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert words[-1] == {"drive.mcap": "drive_run_2", "-x.mcap": "x_run"}.get(name, "a_b_s_drive_run")
    run(words, capsys)


# -- loud results ------------------------------------------------------------------------------------------------------


def test_a_replay_ends_with_a_table_of_its_inputs_and_the_lines_that_mend_them(info, capsys):
    _, _, words = info(ODOMETRY, ("/tags", DETECTIONS, seen(frame="camera")))
    plain = [word for word in words if "mount" not in word]
    plain = [
        w for k, w in enumerate(plain) if not (w == "--set" and plain[k + 1 : k + 2] in ([], ["--out"], ["--set"]))
    ]
    told, out, err = run(plain, capsys, code=3)
    assert told["inputs"]["detections"] == {"use": "landmarks", "received": STEPS, "used": 0, "believed": None}
    lines = out.splitlines()
    (head,) = [
        k for k, line in enumerate(lines) if line.split() == ["input", "received", "used", "believed", "refused"]
    ]
    assert lines[head - 1].split() == ["messages", "measurements", "measurements"], "the unit of each column"
    assert lines[head + 1].split() == ["odom", str(STEPS), str(STEPS), "-", "0"]
    assert lines[head + 2].split() == ["detections", str(STEPS), "0", "-", str(3 * STEPS)]
    assert len({len(line) for line in lines[head : head + 3]}) == 1, "aligned"
    assert f"frame_unknown {3 * STEPS}" in lines[head + 3]
    assert "detections.mount" in out
    assert max(len(line) for line in lines if not line.startswith(("results in", "picture in", "next:"))) <= 100
    assert f"detections: nothing of {STEPS} messages was used: frame_unknown {3 * STEPS}" in err
    assert "this is odometry alone" in err


def test_ids_that_never_come_back_are_said(info, capsys):
    _, _, words = info(ODOMETRY, ("/tags", DETECTIONS, seen(lambda name, k: f"{name}{k}")))
    _, _, err = run(words, capsys, code=3)
    assert "no landmark was seen twice" in err


def test_a_recovered_run_tells_what_is_in_it_by_input(info, capsys):
    _, _, words = info(ODOMETRY, SEEN)
    told, _, _ = run(words, capsys)
    assert main(["recover", words[-1], "--out", "again"]) == 0
    again = json.loads(Path("again/run.json").read_text())
    assert again["inputs"]["detections"]["used"] == told["inputs"]["detections"]["believed"] > 300


def test_an_input_that_is_mostly_not_believed_is_said():
    counts = {"use": "landmarks", "received": 9, "used": 90, "believed": 30}
    summary = {"inputs": {"uwb": counts}, "counters": {}, "waiting": {}, "landmarks": 4, "sightings": 90}
    (sentence,) = shortcomings(summary)
    assert sentence.startswith("uwb: only 30 of 90 are believed: ")
    for hint in ("metres and radians", "uwb.mount", "uwb.offset_s", "--set uwb.noise=sigmas --set uwb.sigma_m"):
        assert hint in sentence
    assert not [*doubts(summary)], "said already"
    doubted = summary | {"inputs": {"uwb": counts | {"believed": 80}}}
    assert not [*shortcomings(doubted)]
    (sentence,) = doubts(doubted)
    assert sentence.startswith("uwb: 11 % of 90 are not believed: ") and "uwb.mount" in sentence
    assert not [*doubts(summary | {"inputs": {"uwb": counts | {"believed": 87}}})]


def test_odometry_that_keeps_jumping_is_said(info, capsys):
    def millimetres(k, stamp_ns, truth, drifting):
        return odometry(pose(1000 * drifting[0], 1000 * drifting[1]), "odom", "base_link", stamp_ns)

    _, _, words = info(("/odom", ODOM, millimetres), SEEN)
    told, _, err = run(words, capsys, code=3)
    assert f"odom: {told['counters']['odom']['jump']} jumps, each begins a segment" in err
    assert "metres and radians?" in err
