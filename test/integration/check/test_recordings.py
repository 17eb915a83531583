"""``graph_slam check`` on whole recordings: what a person sees, and the mistakes that people make."""

import json
from collections import Counter

import numpy as np
import pytest
from recordings import TOPICS, read, short_drive, to_ros1, write_mcap
from reliability import times
from rows import each

from graph_slam_ros.cli import main
from graph_slam_ros.messages.from_msg import own_decoder
from graph_slam_ros.messages.to_msg import encode, header, make, transform
from graph_slam_ros.recordings.bag import BagWriter, open_bag
from graph_slam_ros.tools.simulation import Fault, simulate, write_faulty_bag

SOAK = pytest.mark.skipif(not times(0, 1), reason="only in make soak")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return short_drive(tmp_path_factory.mktemp("check") / "drive.mcap")


@pytest.fixture
def check(capsys):
    """(exit code, findings by code, lines on standard error)."""

    def checked(*words):
        code = main(["check", *map(str, words), "--json"])
        out, err = capsys.readouterr()
        findings = json.loads(out)["findings"] if out else []
        return code, {one["code"]: one for one in findings}, err.splitlines()

    return checked


def copy(source, target, odom=None, seen=None):
    """Write a recording again; a function is given each message of odometry or landmarks and its number; False: out."""
    bag, count = open_bag(source), Counter()
    with BagWriter(target) as out:
        for m in bag.messages(set(bag.topics)):
            message = own_decoder(bag.topics[m.topic].type)(m.cdr)
            change = {"/odom": odom, "/landmarks": seen}.get(m.topic)
            if change is None or change(message, count[m.topic]) is not False:
                out.write(m.topic, bag.topics[m.topic].type, m.log_ns, encode(message))
            count[m.topic] += 1
    return target


def turned_in_degrees(m, _):
    q = m.pose.pose.orientation
    half = 0.5 * np.degrees(2.0 * np.arctan2(q.z, q.w))
    q.z, q.w = float(np.sin(half)), float(np.cos(half))


def without_orientation(m, _):
    m.pose.pose.orientation.w = m.pose.pose.orientation.z = 0.0


@pytest.mark.parametrize(
    ("world", "wrong", "right", "within"),
    [
        ("manhattan --poses 150 --set blocks=4 --seed 2", "ranges.range_factor=1.08", 1.0, 0.02),  # three of its sigmas
        ("warehouse --seed 7", "ranges.range_offset_m=0.3", 0.0, 0.1),
    ],
)
@SOAK
def test_ranges_alone_that_are_too_long_are_mended_by_their_own_setting(
    tmp_path, check, capsys, world, wrong, right, within
):
    """The distance of odometry would make the map as much too large."""
    bag = tmp_path / "ranges.mcap"
    assert main(["simulate", *world.split(), "--set", "sensor=range", "--out", str(bag)]) == 0
    capsys.readouterr()
    code, found, _ = check(bag, "--set", wrong)
    assert code == 4
    assert "odometry_scale" not in found
    key, value = found["range_scale"]["settings"][0].split("=")
    assert key == wrong.partition("=")[0]
    assert float(value) == pytest.approx(right, abs=within)


def test_a_clean_recording_has_no_finding_and_the_command_is_that_of_info(drive, capsys):
    assert main(["check", str(drive)]) == 0
    out = capsys.readouterr().out.splitlines()
    assert main(["info", str(drive)]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[-2].endswith(f"graph_slam check {drive}")
    assert out[-1] == f"next: {shown[-1]}"
    assert not [line for line in out if line.startswith(("[error]", "[warning]"))]


def in_frame(m, frame):
    """Give landmarks this frame."""
    for one in (m, *m.detections):
        one.header.frame_id = frame


def on_a_joint(source, target, every_s):
    """Write a drive again, whose sensor is on a joint that /tf has once in that time."""
    bag, due_ns = open_bag(source), 0
    with BagWriter(target) as out:
        for m in bag.messages(set(bag.topics)):
            message = own_decoder(bag.topics[m.topic].type)(m.cdr)
            if m.topic == "/odom" and m.log_ns >= due_ns:
                due_ns = m.log_ns + round(every_s * 1e9)
                joint = transform(m.log_ns, "base_link", "joint", (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
                out.write("/tf", "tf2_msgs/msg/TFMessage", m.log_ns, joint)
            if m.topic == "/landmarks":
                in_frame(message, "joint")
            out.write(m.topic, bag.topics[m.topic].type, m.log_ns, encode(message))
    return target


def test_a_transform_that_comes_too_rarely_is_not_called_missing(drive, check, tmp_path):
    assert check(on_a_joint(drive, tmp_path / "often.mcap", 0.1))[:2] == (0, {})
    rarely = on_a_joint(drive, tmp_path / "rarely.mcap", 1.5)
    code, found, _ = check(rarely)
    assert (code, found.keys()) == (4, {"transform_gaps"})
    assert (found["transform_gaps"]["severity"], found["transform_gaps"]["settings"]) == ("error", [])
    assert "/tf links the message's frame to the robot, but not at its stamp" in found["transform_gaps"]["text"]
    _, waited, _ = check(rarely, "--set", "inputs.tf_wait_s=2")
    assert waited.get("transform_gaps", {"value": 0})["value"] < 0.1 * found["transform_gaps"]["value"]


@pytest.mark.parametrize(
    "fault, code",
    [(Fault.named("slow_odometry", hz=1.0), "slow_odometry"), (Fault.named("restarted"), "odometry_reset")],
)
@pytest.mark.parametrize("seed", [7, 8, 9])
@SOAK
def test_what_comes_of_slow_or_restarted_odometry_is_no_finding_of_its_own(check, tmp_path, seed, fault, code):
    write_faulty_bag(simulate("warehouse", seed), tmp_path / "a.mcap", [fault], seed=seed)
    _, found, _ = check(tmp_path / "a.mcap")
    assert [name for name, one in found.items() if one["severity"] != "note"] == [code]


def test_a_twist_is_compared_where_the_robot_moves_though_it_stands_most_of_the_time(drive, check, tmp_path):
    bag, last = open_bag(drive), None
    standing = tmp_path / "standing.mcap"
    with BagWriter(standing) as out:
        for m in bag.messages(set(bag.topics)):
            out.write(m.topic, bag.topics[m.topic].type, m.log_ns, m.cdr)
            last = m if m.topic == "/odom" else last
        message = own_decoder(bag.topics["/odom"].type)(last.cdr)
        message.twist.twist.linear.x = message.twist.twist.linear.y = 0.005
        for k in range(1, 1500):
            stamp_ns = last.log_ns + k * 100_000_000
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
            out.write("/odom", bag.topics["/odom"].type, stamp_ns, encode(message))
    assert "twist_unrelated" not in check(standing)[1]


@each("change, said", [(turned_in_degrees, "are its angles in radians?"), (without_orientation, "671 are refused")])
def test_what_no_setting_mends_names_no_replay(drive, tmp_path, capsys, change, said):
    bag = copy(drive, tmp_path / "a.mcap", change)
    assert main(["check", str(bag), "--quick"]) == 4
    out = capsys.readouterr().out
    assert said in " ".join(out.split())
    assert out.splitlines()[-1] == f"next: correct what is an error, then check again: graph_slam check {bag}"


def test_a_restart_that_is_slower_than_any_jump_has_a_setting_that_makes_it_one(drive, check, tmp_path):
    stamps = sorted({m.log_ns for m in open_bag(drive).messages({"/odom"})})
    away_ns, back_ns = stamps[len(stamps) // 2], stamps[len(stamps) // 2] + 2 * 10**9

    def change(m, _):
        stamp_ns = m.header.stamp.sec * 10**9 + m.header.stamp.nanosec
        m.pose.pose.position.x -= 12.0 if stamp_ns >= back_ns else 0.0
        return not away_ns < stamp_ns < back_ns

    bag = copy(drive, tmp_path / "a.mcap", change)
    _, found, _ = check(bag, "--quick")
    (setting,) = found["odometry_jumps"]["settings"]
    _, found, _ = check(bag, "--quick", "--set", setting)
    assert "odometry_jumps" not in found
    main(["replay", str(bag), "--out", str(tmp_path / "run"), "--set", setting])
    assert json.loads((tmp_path / "run/run.json").read_text())["counters"]["odom"]["jump"] == 1


def test_covariances_of_minus_one_have_settings_that_replay_all(drive, check, tmp_path):
    unknown = np.full(36, -1.0)

    def twist(m, _):
        m.twist.covariance = unknown

    def poses(m, _):
        for one in m.detections:
            one.results[0].pose.covariance = unknown

    bag = copy(drive, tmp_path / "a.mcap", twist, poses)
    code, found, _ = check(bag, "--quick", "--set", "odometry.noise=density")  # as of a negative variance
    settings = ["odometry.noise=density", *(text for one in found.values() for text in one["settings"])]
    assert (code, settings[1:]) == (4, ["detections.noise=sigmas"])
    assert main(["replay", str(bag), "--out", str(tmp_path / "run"), *(w for s in settings for w in ("--set", s))]) == 0


def test_the_mistakes_of_a_user_are_one_line_or_a_finding(drive, check, tmp_path, capsys):
    messages, _ = read(drive)
    code, _, err = check(drive, "--odom", "/wheel")
    assert code == 2
    assert "no topic /wheel" in err[0]
    assert "of nav_msgs/msg/Odometry there is /odom" in err[0]
    alone = write_mcap(tmp_path / "alone.mcap", [m for m in messages if m.topic == "/odom"])
    code, found, _ = check(alone)
    assert (code, found["no_landmarks"]["severity"]) == (4, "warning")
    folder = tmp_path / "folder"
    folder.mkdir()
    to_ros1(folder / "drive.bag", messages)
    assert check(folder) == (0, {}, [])
    empty = write_mcap(tmp_path / "empty.mcap", [], types=TOPICS)
    code, found, _ = check(empty)
    assert (code, found["no_odometry"]["severity"]) == (4, "error")


def rounded(to_ns):
    """Stamps rounded down."""

    def change(m, _):
        stamp_ns = (m.header.stamp.sec * 10**9 + m.header.stamp.nanosec) // to_ns * to_ns
        m.header.stamp.sec, m.header.stamp.nanosec = divmod(stamp_ns, 10**9)

    return change


def first_at_zero(m, k):
    m.header.stamp.sec *= k > 0
    m.header.stamp.nanosec *= k > 0


def of_frame(frame):
    return lambda m, _: setattr(m.header, "frame_id", frame)


def sideways(is_holonomic):
    def change(m, _):
        q, velocity = m.pose.pose.orientation, m.twist.twist.linear
        heading = 2.0 * np.arctan2(q.z, q.w)
        q.z, q.w = 0.0, 1.0
        if is_holonomic:
            velocity.x, velocity.y = float(velocity.x * np.cos(heading)), float(velocity.x * np.sin(heading))

    return change


def half_of_another_robot(m, k):
    if k % 2:
        in_frame(m, "robot2/base_link")


OTHER = "links frame robot2/base_link to base_link; the others are of base_link"
NOT_TWO = ("two_publishers", "duplicates", "other_publisher", "duplicate_stamp")


@each(
    "odom, seen, exit_code, code, expected, others",
    [
        (first_at_zero, None, 0, "zero_stamp", {"severity": "note"}, ()),
        (of_frame("world"), None, 0, "odometry_in_map", {"severity": "note"}, ()),  # as cameras call theirs
        (of_frame("map"), None, 4, "odometry_in_map", {"severity": "error"}, ()),
        (sideways(False), None, 4, "no_orientation_of_odometry", {"text": ""}, ()),
        (sideways(True), None, None, None, {}, ("no_orientation_of_odometry",)),  # it needs no turn
        (rounded(120_000_000), None, 0, "rounded_stamps", {"value": 0.12}, NOT_TWO),
        (rounded(10**9), None, 4, "coarse_stamps", {"value": 1.0}, NOT_TWO),
        (None, half_of_another_robot, 4, "frame_unlinked", {"settings": [], "text": OTHER}, ()),  # it gets no place
        (None, rounded(10**18), 4, "constant_stamps", {"text": "/landmarks: all of its"}, ("clock_domains",)),
    ],
)
def test_mistakes_in_messages_are_told_from_what_is_none(
    drive, check, tmp_path, odom, seen, exit_code, code, expected, others
):
    answered, found, _ = check(copy(drive, tmp_path / "a.mcap", odom, seen), "--quick")
    assert exit_code in (None, answered)
    assert not set(others) & found.keys()
    for key, value in expected.items():
        said = found[code][key]
        assert value in said if key == "text" else said == (pytest.approx(value) if key == "value" else value)


def test_without_landmarks_topics_are_named_that_may_have_them(drive, check, tmp_path):
    things, poses = "visualization_msgs/msg/MarkerArray", "geometry_msgs/msg/PoseArray"
    messages = [m for m in read(drive)[0] if m.topic == "/odom"]
    end_ns = messages[-1].log_ns
    with BagWriter(tmp_path / "a.mcap") as out:
        for m in messages:
            out.write(m.topic, "nav_msgs/msg/Odometry", m.log_ns, m.cdr)
        out.write("/things", things, end_ns, encode(make(things, markers=[])))
        out.write("/places", poses, end_ns, encode(make(poses, header=header(end_ns, "base_link"), poses=[])))
    _, found, _ = check(tmp_path / "a.mcap", "--quick")
    text = found["no_landmarks"]["text"]
    settings = f"--set 'inputs.names=odom markers' --set markers.type={things} --set markers.topic=/things"
    assert f"/things: markers are mostly pictures; where they are landmarks: {settings}" in text
    assert f"/places: no input reads {poses}, which has no ids" in text
