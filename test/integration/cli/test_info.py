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
from rows import each

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
        (tmp_path / name).unlink(missing_ok=True)
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


def on_tf(parent, child):
    def made(k, stamp_ns, truth, drifting):
        x, y, yaw = drifting
        return transforms((parent, child, (x, y, 0.0), quaternion(yaw=yaw)), stamp_ns=stamp_ns)

    return "/tf", TF, made


def posed_odometry(name, frame):
    def made(k, stamp_ns, truth, drifting):
        x, y, yaw = drifting
        return posed("PoseStamped", pose(x, y, 0.02 * k, quaternion(yaw=yaw)), frame, None, stamp_ns)

    return name, POSE, made


def tag(number, at):
    def made(k, stamp_ns, truth, drifting):
        x, y = map(float, se2.act(se2.inverse(truth), at))
        return posed("PoseStamped", pose(x, y), "base_link", None, stamp_ns)

    return f"/tag_{number}/pose", POSE, made


def static(parent):
    """A camera on a frame."""
    fixed = transforms((parent, "camera", (0.0, 0.0, 0.5), quaternion(yaw=0.0)))
    return "/tf_static", TF, lambda k, *_: None if k else fixed


def millimetres(k, stamp_ns, truth, drifting):
    return odometry(pose(1000 * drifting[0], 1000 * drifting[1]), "odom", "base_link", stamp_ns)


def tags(*names, **how):
    return "/tags", DETECTIONS, seen(*names, **how)


EARLY = {"lag_ns": START_NS - 900 * NS}  # a simulator's clock
KNOWN = np.diag([0.01] * 6)
ESTIMATES = [
    ("/amcl_pose", WITH_COVARIANCE, at("PoseWithCovarianceStamped", covariance=KNOWN)),
    ("/ground_truth", POSE, at()),
    ("/reference/pose", WITH_COVARIANCE, at("PoseWithCovarianceStamped", covariance=KNOWN)),
]
SCAN = ("/scan", "sensor_msgs/msg/LaserScan", lambda k, *_: None if k else b"\0\1\0\0")
OFFERED = {
    "several odometries": (
        [
            ("/wheel/odom_raw", ODOM, odom()),
            ("/odometry/filtered", ODOM, odom()),
            ("/odometry/global", ODOM, odom(frame="map")),
            ("/ground_truth/odom", ODOM, odom(frame="world")),
            SEEN,
        ],
        ["/odometry/filtered"],
        [
            "2 odometries: /odometry/filtered is chosen",
            *("not used: /odometry/global: in frame map", "not used: /wheel/odom_raw: another", "ground truth"),
        ],
        {"odom": STEPS},
    ),
    **{
        f"odometry of {frame} and {child}": (
            [("/o", ODOM, odom(frame, child)), tags(frame=child or "base_link")],
            [],
            [],
            3,
        )
        for frame, child in (("robot1/odom", "robot1/base_footprint"), ("world", "imu"), ("", ""))
    },
    "odometry on tf": (
        [on_tf("odom_combined", "base_footprint"), tags(frame="base_footprint")],
        [],
        ["note: odometry is odom_combined -> base_footprint of /tf: there is no topic with it"],
        3,
    ),
    "odometry that leaves the plane": (
        [("/odom", ODOM, odom(height=0.02)), SEEN],
        ["world.dimensions=3"],
        ["these are three dimensions"],
        3,
    ),
    **{
        f"poses that are odometry by name, in {frame}": (
            [posed_odometry(name, frame), SEEN],
            ["odom.use=odometry", f"odom.type={POSE}", "world.dimensions=3"],
            [f"note: odometry is {name}, poses without a child frame"],
            3,
        )
        for frame, name in (("odom", "/camera/pose"), ("start", "/vio/pose"))
    },
    "no ids": ([ODOMETRY, tags(lambda name, k: "")], ["landmarks.association=joint"], [], 3),
    "class ids": ([ODOMETRY, tags(lambda name, k: "", class_ids=True)], ["landmarks.id_from=class_id"], [], 3),
    "another clock": (
        [ODOMETRY, tags(lag_ns=100 * NS)],
        [],
        ["another clock than odometry: 100.000 s are added"],
        {"detections": 3 * STEPS},
    ),
    "received at another time": ([("/odom", ODOM, odom(**EARLY)), tags(**EARLY)], [], [], 3),
    "single tags": ([ODOMETRY, *(tag(n, where) for n, where in enumerate(PLACES.values()))], [], [], 3),
    "odometry of a frame that is not linked": (
        [static("robot1/base_footprint"), ("/odom", ODOM, odom(child="chassis")), tags(frame="camera")],
        ["odom.mount=assumed"],
        ["note: no transform links chassis, which odometry names, to robot1/base_footprint"],
        3,
    ),
    **{
        f"clouds of {' and '.join(fields)}": (
            [ODOMETRY, ("/beacons", CLOUD, beacons(*fields, frame="base_link"))],
            [],
            [],
            3,
        )
        for fields in (("range", "id"), ("range", "bearing", "id"), ("x", "y", "id"), ("bearing", "id"))
    },
    "two robots": (
        [
            (f"/{robot}/{name}", kind, made)
            for robot in ("a", "b")
            for name, kind, made in (("odom", ODOM, odom()), ("tags", DETECTIONS, seen()))
        ],
        ["/a/odom", "/a/tags"],
        ["not used: /b/tags: of the robot of /b/odom: --odom /b/odom --landmarks /b/tags"],
        3,
    ),
    "an IMU that is no compass": (
        [ODOMETRY, SEEN, ("/imu/data", IMU, compass())],
        [],
        ["not used: /imu/data: its heading may drift"],
        3,
    ),
    "an IMU alone": ([ODOMETRY, ("/imu/data", IMU, compass(frame="base_link"))], [], [], {"imu": None}),
    "fixes": (
        [ODOMETRY, ("/gps/fix", FIX, satellite())],
        [],
        ["no transform has the pose of gps", "at the base is assumed"],
        {"gps": None},
    ),
    "fixes of unknown noise": (
        [ODOMETRY, ("/gps/fix", FIX, satellite(kind=0)), ("/gps2/fix", FIX, satellite(status=-1))],
        ["gps.sigma_m=2.0"],
        [],
        {"gps": None},
    ),
    "poses of a station": (
        [
            *(ODOMETRY, *ESTIMATES),
            ("/uwb/position", WITH_COVARIANCE, at("PoseWithCovarianceStamped", "world", KNOWN)),
        ],
        ["pose.topic=/uwb/position"],
        [],
        {"pose": None},
    ),
}
"""Topics, words of the command, what is said, and what a replay has: landmarks, or what is used of inputs."""
ALONE = {
    "nothing that is read": (
        [ODOMETRY, SCAN],
        ["note: no input reads /scan (sensor_msgs/msg/LaserScan)", "publish them as Detection3DArray"],
    ),
    "points of a scan": ([ODOMETRY, ("/scan", CLOUD, beacons("x", "y"))], ["not used: /scan: points without ids"]),
    "a receiver without a fix": (
        [ODOMETRY, ("/gps2/fix", FIX, satellite(status=-1))],
        ["not used: /gps2/fix: no message has a fix"],
    ),
    "estimates and the truth": ([ODOMETRY, *ESTIMATES], []),
    "an IMU without orientation": (
        [ODOMETRY, ("/imu/raw", IMU, compass(-1.0))],
        [
            "not used: /imu/raw: it has no orientation",
            "--set imu.topic=/imu/raw --set 'imu.mount=0 0 0 0 0 0' --set imu.use=gyro",
        ],
    ),
}
NOT_READY = {
    "landmarks alone": ([SEEN], "no odometry"),
    "odometry in the map": ([("/odom", ODOM, odom(frame="map")), SEEN], "no odometry"),
    "somebody's estimate": (
        [("/vio/pose", POSE, at(frame="map")), SEEN],
        "/vio/pose: in frame map: somebody's estimate, not odometry",
    ),
    "a localiser": (
        [("/amcl_pose", POSE, at(frame="odom")), SEEN],
        "/amcl_pose: the output of a localiser, or a goal, not odometry",
    ),
    "poses": (
        [("/camera/pose", POSE, at(frame="start")), SEEN],
        f"if /camera/pose is odometry: --set odom.type={POSE} --set odom.topic=/camera/pose",
    ),
}


def one_line(lines):
    return " ".join(" ".join(lines).split())


@each("case", OFFERED)
def test_what_is_offered_works_as_it_is_pasted(info, capsys, case):
    topics, has, says, expected = OFFERED[case]
    code, lines, words = info(*topics)
    assert code == 0
    assert set(has) <= set(words)
    assert all(text in one_line(lines) for text in says), lines
    is_assumed = case.startswith("fixes") or any("assumed" in word for word in words)
    told, _, _ = run(words, capsys, code=3 * is_assumed)
    if isinstance(expected, int):
        assert told["landmarks"] == expected
    for name, used in (expected if isinstance(expected, dict) else {}).items():
        counts = told["inputs"][name]
        assert counts["used"] == used if used else counts["believed"] > 10 or (name == "imu" and counts["believed"])


@each("case", ALONE)
def test_what_is_not_offered_is_named_and_odometry_alone_is_no_result(info, capsys, case):
    topics, says = ALONE[case]
    code, lines, words = info(*topics)
    assert code == 0
    assert not any(word.startswith(("pose.", "imu.", "gps.")) for word in words)
    assert all(text in one_line(lines) for text in says), lines
    run(words, capsys, code=3)


@each("case", NOT_READY)
def test_without_odometry_there_is_no_command_and_the_code_is_3(info, case):
    topics, says = NOT_READY[case]
    code, lines, _ = info(*topics)
    assert code == 3
    assert lines[-1].startswith("not ready for replay: no odometry")
    assert says in lines[-1]


def test_a_replay_without_options_takes_odometry_of_other_types_and_says_so(info, capsys):
    info(on_tf("odom", "base_link"), SEEN)
    summary, _, err = run(["graph_slam", "replay", "drive.mcap", "--out", "out"], capsys)
    assert "there is no odometry of the usual type, so this is: graph_slam replay drive.mcap --landmarks /tags" in err
    assert summary["landmarks"] == 3


def test_a_replay_in_the_plane_of_odometry_that_leaves_it_says_so(info, capsys):
    info(("/odom", ODOM, odom(height=0.02)), SEEN)
    words = ["graph_slam", "replay", "drive.mcap", "--landmarks", "/tags", "--out", "flat"]
    assert (
        "odom leaves the plane: these are three dimensions: --set world.dimensions=3" in run(words, capsys, code=3)[2]
    )


def test_the_gyro_of_an_imu_is_offered_as_a_part_of_odometry(info, capsys):
    _, lines, words = info(ODOMETRY, SEEN, ("/imu/data", IMU, compass()))
    assert not any("imu" in word for word in words)
    offered = shlex.split(" ".join(lines).split("part of odometry: ")[1].split(" what is wrong")[0])
    told, _, err = run([*words[:-2], *offered, "--out", "b_imu"], capsys, code=3)
    assert told["inputs"]["imu"]["used"] > 0
    assert "stand for a second" in err  # the bias of the gyro is learnt at rest


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


# -- the command -------------------------------------------------------------------------------------------------------


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
    _, _, words = info(("/odom", ODOM, millimetres), SEEN)
    told, _, err = run(words, capsys, code=3)
    assert f"odom: {told['counters']['odom']['jump']} jumps, each begins a segment" in err
    assert "metres and radians?" in err
