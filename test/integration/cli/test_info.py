"""What info offers of a recording and what not; the command works as it is pasted; a replay says what came of it."""

import json
import math
import shlex
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from foreign import DEFINITIONS
from messages import cloud, detection, detections, gnss, imu, odometry, pose, posed, quaternion, sent, transforms
from recordings import definition, short_drive, write_mcap
from rows import each

from graph_slam_ros.cli import main
from graph_slam_ros.lie import se2
from graph_slam_ros.messages.to_msg import header
from graph_slam_ros.recordings.bag import BagWriter
from graph_slam_ros.runs.outcome import doubts, shortcomings
from graph_slam_ros.tools.simulation import Drive

NS = 10**9
START_NS = 1_700_000_000 * NS
ODOM, TF, FIX = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/NavSatFix"
IMU = "sensor_msgs/msg/Imu"
DETECTIONS, CLOUD = "vision_msgs/msg/Detection3DArray", "sensor_msgs/msg/PointCloud2"
POSE, WITH_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
PLACES = {"north": (0.0, 5.0), "east": (5.0, 1.0), "south": (1.0, -4.0)}
STEPS, MORE = 55, 120


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


def odom(frame="odom", child="base_link", height=0.0, lag_ns=0):
    return lambda k, ns, _, at: odometry(
        pose(at[0], at[1], height * k, quaternion(yaw=at[2])), frame, child, ns - lag_ns
    )


def from_robot(truth, place):
    return tuple(map(float, se2.act(se2.inverse(truth), place)))


def seen(frame="base_link", lag_ns=0, unnamed=False, class_ids=False, height=0.0):
    def made(k, stamp_ns, truth, drifting):
        found = [
            detection(pose(*from_robot(truth, at), -height * k), np.eye(2) * 0.01, "" if unnamed else name,
                      class_id=name if class_ids else "kind")
            for name, at in PLACES.items()
        ]  # fmt: skip
        return detections(*found, frame=frame, stamp_ns=stamp_ns - lag_ns)

    return made


def satellite(status=0, kind=2):
    def made(k, stamp_ns, truth, drifting):
        north, east = truth[1] / 111_200.0, truth[0] / (111_320.0 * math.cos(math.radians(48.0)))
        fields = {"status": status, "kind": kind, "stamp_ns": stamp_ns, "frame": "gps"}
        return gnss(48.0 + north, 11.0 + east, covariance=np.eye(3) * 0.01, **fields) if k % 5 == 0 else None

    return made


def compass(covariance=0.01, frame="imu_link"):
    return lambda k, stamp_ns, truth, drifting: imu(
        quaternion(yaw=truth[2]), np.eye(3) * covariance, frame=frame, stamp_ns=stamp_ns, rate=(0.0, 0.0, 0.3)
    )


def beacons(*names, frame="uwb"):
    def made(k, stamp_ns, truth, drifting):
        layout, points = [(name, "u4" if name == "id" else "f8") for name in names], []
        for number, at in enumerate(PLACES.values()):
            x, y = from_robot(truth, at)
            told = {"id": number, "range": math.hypot(x, y), "bearing": math.atan2(y, x), "x": x, "y": y}
            points.append(tuple(told[name] for name in names))
        return cloud(layout, *points, frame=frame, stamp_ns=stamp_ns)

    return made


def at(kind="PoseStamped", frame="map", covariance=None):
    return lambda k, stamp_ns, truth, drifting: posed(
        kind, pose(*truth[:2], 0.0, quaternion(yaw=truth[2])), frame, covariance, stamp_ns
    )


ODOMETRY = ("/odom", ODOM, odom())
SEEN, CLIMBING = (("/tags", DETECTIONS, seen(height=height)) for height in (0.0, 0.02))


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
    return (
        "/tf",
        TF,
        lambda k, ns, _, at: transforms((parent, child, (*at[:2], 0.0), quaternion(yaw=at[2])), stamp_ns=ns),
    )


def posed_odometry(name, frame):
    return (
        name,
        POSE,
        lambda k, ns, _, at: posed("PoseStamped", pose(*at[:2], 0.02 * k, quaternion(yaw=at[2])), frame, None, ns),
    )


def tag(number, place):
    return (
        f"/tag_{number}/pose",
        POSE,
        lambda k, ns, truth, _: posed("PoseStamped", pose(*from_robot(truth, place)), "base_link", None, ns),
    )


def static(parent):
    """A camera on a frame."""
    fixed = transforms((parent, "camera", (0.0, 0.0, 0.5), quaternion(yaw=0.0)))
    return "/tf_static", TF, lambda k, *_: None if k else fixed


def millimetres(k, stamp_ns, truth, drifting):
    return odometry(pose(1000 * drifting[0], 1000 * drifting[1]), "odom", "base_link", stamp_ns)


def tags(**how):
    return "/tags", DETECTIONS, seen(**how)


EARLY = {"lag_ns": START_NS - 900 * NS}  # a simulator's clock
KNOWN = np.diag([0.01] * 6)
ESTIMATES = [
    ("/amcl_pose", WITH_COVARIANCE, at("PoseWithCovarianceStamped", covariance=KNOWN)),
    ("/ground_truth", POSE, at()),
    ("/reference/pose", WITH_COVARIANCE, at("PoseWithCovarianceStamped", covariance=KNOWN)),
]
SCAN = ("/scan", "sensor_msgs/msg/LaserScan", lambda k, *_: None if k else b"\0\1\0\0")


def row(*topics, has=(), says=(), of=3):
    """Topics, words of the command, what is said, and what a replay has: landmarks, or what is used of inputs."""
    return topics, has, says, of


OFFERED = {
    "several odometries": row(
        *(("/wheel/odom_raw", ODOM, odom()), ("/odometry/filtered", ODOM, odom()), SEEN),
        *(("/odometry/global", ODOM, odom(frame="map")), ("/ground_truth/odom", ODOM, odom(frame="world"))),
        has=["/odometry/filtered"],
        says=[
            *("2 odometries: /odometry/filtered is chosen", "not used: /odometry/global: in frame map"),
            *("not used: /wheel/odom_raw: another", "ground truth"),
        ],
        of={"odom": MORE},
    ),
    **{
        f"odometry of {frame} and {child}": row(("/o", ODOM, odom(frame, child)), tags(frame=child or "base_link"))
        for frame, child in (("robot1/odom", "robot1/base_footprint"), ("world", "imu"), ("", ""))
    },
    "odometry on tf": row(
        *(on_tf("odom_combined", "base_footprint"), tags(frame="base_footprint")),
        says=["note: odometry is odom_combined -> base_footprint of /tf: there is no topic with it"],
    ),
    "odometry that leaves the plane": row(
        ("/odom", ODOM, odom(height=0.02)), CLIMBING, has=["world.dimensions=3"], says=["these are three dimensions"]
    ),
    **{
        f"poses that are odometry by name, in {frame}": row(
            *(posed_odometry(name, frame), CLIMBING),
            has=["odom.use=odometry", f"odom.type={POSE}", "world.dimensions=3"],
            says=[f"note: odometry is {name}, poses without a child frame"],
        )
        for frame, name in (("odom", "/camera/pose"), ("start", "/vio/pose"))
    },
    "no ids": row(ODOMETRY, tags(unnamed=True), has=["landmarks.association=joint"]),
    "class ids": row(ODOMETRY, tags(unnamed=True, class_ids=True), has=["landmarks.id_from=class_id"]),
    "another clock": row(
        *(ODOMETRY, tags(lag_ns=100 * NS)),
        says=["another clock than odometry: 100.000 s are added"],
        of={"detections": 3 * MORE},
    ),
    "received at another time": row(("/odom", ODOM, odom(**EARLY)), tags(**EARLY)),
    "single tags": row(ODOMETRY, *(tag(n, where) for n, where in enumerate(PLACES.values()))),
    "odometry of a frame that is not linked": row(
        *(static("robot1/base_footprint"), ("/odom", ODOM, odom(child="chassis")), tags(frame="camera")),
        has=["odom.mount=assumed"],
        says=["note: no transform links chassis, which odometry names, to robot1/base_footprint"],
    ),
    **{
        f"clouds of {fields}": row(ODOMETRY, ("/beacons", CLOUD, beacons(*fields.split(), frame="base_link")))
        for fields in ("range id", "range bearing id", "x y id", "bearing id")
    },
    "two robots": row(
        *((f"/{robot}/{name}", *made) for robot in "ab" for name, made in (("odom", ODOMETRY[1:]), ("tags", SEEN[1:]))),
        has=["/a/odom", "/a/tags"],
        says=["not used: /b/tags: of the robot of /b/odom: --odom /b/odom --landmarks /b/tags"],
    ),
    "an IMU that is no compass": row(
        ODOMETRY, SEEN, ("/imu/data", IMU, compass()), says=["not used: /imu/data: its heading may drift"]
    ),
    "an IMU alone": row(ODOMETRY, ("/imu/data", IMU, compass(frame="base_link")), of={"imu": None}),
    "fixes": row(
        *(ODOMETRY, ("/gps/fix", FIX, satellite())),
        says=["no transform has the pose of gps", "at the base is assumed"],
        of={"gps": None},
    ),
    "fixes of unknown noise": row(
        *(ODOMETRY, ("/gps/fix", FIX, satellite(kind=0)), ("/gps2/fix", FIX, satellite(status=-1))),
        has=["gps.sigma_m=2.0"],
        of={"gps": None},
    ),
    "poses of a station": row(
        *(ODOMETRY, *ESTIMATES),
        ("/uwb/position", WITH_COVARIANCE, at("PoseWithCovarianceStamped", "world", KNOWN)),
        has=["pose.topic=/uwb/position"],
        of={"pose": None},
    ),
}
UNFIXED = ("/gps2/fix", FIX, satellite(status=-1))
ALONE = {
    "nothing that is read": row(
        *(ODOMETRY, SCAN),
        says=["note: no input reads /scan (sensor_msgs/msg/LaserScan)", "publish them as Detection3DArray"],
    ),
    "points of a scan": row(
        ODOMETRY, ("/scan", CLOUD, beacons("x", "y")), says=["not used: /scan: points without ids"]
    ),
    "a receiver without a fix": row(ODOMETRY, UNFIXED, says=["not used: /gps2/fix: no message has a fix"]),
    "estimates and the truth": row(ODOMETRY, *ESTIMATES),
    "an IMU without orientation": row(
        *(ODOMETRY, ("/imu/raw", IMU, compass(-1.0))),
        says=[
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
    code, lines, words = info(*topics, steps=STEPS if isinstance(expected, int) else MORE)
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
    topics, _, says, _ = ALONE[case]
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


def test_corners_without_poses_are_named_with_what_makes_poses_of_them_and_a_map_of_tags_is_not(tmp_path, capsys):
    name, map_name = "apriltag_msgs/msg/AprilTagDetectionArray", "fiducial_msgs/msg/FiducialMapEntryArray"
    corners = sent(name, header=header(START_NS, "camera"))
    file = write_mcap(
        tmp_path / "a.mcap",
        [
            SimpleNamespace(topic=topic, log_ns=START_NS, cdr=cdr)
            for topic, cdr in (
                ("/odom", odometry(stamp_ns=START_NS)),
                ("/tags", corners),
                ("/fiducial_map", b"\0\1\0\0\0\0\0\0"),
            )
        ],
        types={"/odom": ODOM, "/tags": name, "/fiducial_map": map_name},
        text=lambda one: "int32[] fiducials\n" if one == map_name else DEFINITIONS.get(one) or definition(one),
    )
    assert main(["info", str(file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "not used: /tags: these are corners without poses: run a pose estimator first" in " ".join(lines)
    assert f"no input reads /fiducial_map ({map_name})" in " ".join(lines)
    assert "inputs.names=odom" in lines[-1]


@pytest.mark.parametrize("name", ["a b's $drive.mcap", "-x.mcap", "drive.mcap"])
def test_the_command_can_be_pasted_whatever_the_recording_is_called_and_names_a_folder_after_it(info, name, capsys):
    Path("drive_run").mkdir()
    file = write(Path(name), ODOMETRY, SEEN, steps=30)
    assert main(["info", "--", str(file)]) == 0
    words = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert words[-1] == {"drive.mcap": "drive_run_2", "-x.mcap": "x_run"}.get(name, "a_b_s_drive_run")
    run(words, capsys)


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


def test_odometry_in_millimetres_is_named_and_not_its_jumps(info, capsys):
    _, _, words = info(("/odom", ODOM, millimetres), SEEN, steps=MORE)
    told, _, err = run(words, capsys, code=3)
    assert told["counters"]["odom"]["jump"] > MORE // 2 and "jumps, each begins a segment" not in err
    assert "units: /odom: the robot drives at 2000 m/s: is its position in metres?" in err


def test_poses_are_fixes_with_the_settings_that_info_prints(tmp_path, capsys):
    drive, file = Drive(short_drive(tmp_path / "drive.mcap")), tmp_path / "poses.mcap"
    for m in drive.messages:
        m.topic = "/total_station" if m.topic == "/ground_truth" else m.topic
    drive.write(file)
    assert main(["info", str(file)]) == 0
    out = capsys.readouterr().out
    told = " ".join(out.split()).partition("a pose may be an estimate or the truth; as a fix: ")[2]
    words = shlex.split(told)
    settings = [word for word, before in zip(words[1:], words[:-1], strict=True) if before == "--set"][:5]
    assert settings[0] == "inputs.names=odom detections pose"
    command = shlex.split(next(line for line in out.splitlines() if line.startswith("graph_slam replay")))[1:]
    chosen = [word for setting in settings for word in ("--set", setting)]
    assert main([*command[:-1], str(tmp_path / "run"), *chosen]) == 0
    (used,) = (line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("pose "))
    assert int(used[2]) > 50 and used[-1] == "0"
