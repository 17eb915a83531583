"""Recordings as other people's tools and robots make them, through the commands, as a user types them."""

import itertools
import json
import math
import shlex
import shutil
import sqlite3

import numpy as np
from mcap.writer import Writer as McapWriter
from recordings import Ros1Writer, Ros2Writer, StoragePlugin
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from graph_slam_ros.cli import main
from graph_slam_ros.lie import se3
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.runs.trajectory import read_tum

BEGINS_S = 1_764_000_000
ODOMETRY, DETECTIONS, TF = "nav_msgs/msg/Odometry", "vision_msgs/msg/Detection3DArray", "tf2_msgs/msg/TFMessage"
HYPOTHESIS = "vision_msgs/msg/ObjectHypothesisWithPose"
CAMERA = (0.2, 0.0, 0.4, -0.5, 0.5, -0.5, 0.5)
FRAME = "camera_optical_frame"


class Robot:
    """Messages of a robot that drives eights past tags, of one type store; a case changes what a report changed."""

    def __init__(self, store=None, seconds=15.0):
        self.store = store or typestore()
        rng = np.random.default_rng(1)
        self.t = np.arange(0.0, seconds, 0.05)
        self.v = np.where(self.t < 1.0, 0.0, 0.8)
        self.w = np.where(self.t < 1.0, 0.0, 0.8 * np.cos(2.0 * np.pi * (self.t - 1.0) / 14.0) + 0.06)
        self.true = self.path_of(self.v, self.w)
        times = 1.01 + rng.normal(0, 0.03, len(self.t))
        self.driven = self.path_of(self.v * times, self.w + (self.v > 0) * rng.normal(0.004, 0.05, len(self.t)))
        low, high = self.true[:, :2].min(0) - 2.5, self.true[:, :2].max(0) + 2.5
        x, y = (a.ravel() for a in np.meshgrid(*(np.arange(low[k], high[k], 2.0) for k in (0, 1))))
        self.tags = np.stack([x, y, np.full(len(x), 0.7)], 1) + rng.uniform(-0.4, 0.4, (len(x), 3))
        self.seen = [(t, self._sees(pose, rng)) for t, pose in zip(self.t[::3], self.true[::3], strict=True)]

    def path_of(self, v, w):
        dt = self.t[1]
        yaw = np.concatenate([[0.0], np.cumsum(w[:-1] * dt)])
        steps = [np.concatenate([[0.0], np.cumsum(v[:-1] * f(yaw[:-1]) * dt)]) for f in (np.cos, np.sin)]
        return np.stack([*steps, yaw], 1)

    def _sees(self, pose, rng):
        camera = se3.compose(se3.from_xyz_rpy((*pose[:2], 0, 0, 0, pose[2])), CAMERA)
        points = np.stack(se3.act(se3.inverse(camera), tuple(self.tags.T)), 1)
        ahead = (points[:, 2] > 0.3) & (points[:, 2] < 4.5) & (np.abs(points[:, :2]).max(1) < 0.8 * points[:, 2])
        return [(int(k), points[k] + rng.normal(0, 0.02, 3)) for k in np.flatnonzero(ahead)]

    def make(self, name, **fields):
        """A message; what is not given is zero or empty."""
        known = self.store.fielddefs[name][1]
        return self.store.types[name](**{f: fields[f] if f in fields else self._zero(of) for f, of in known})

    def _zero(self, of):
        kind, of = of
        if kind == Nodetype.NAME:
            return self.make(of)
        if kind == Nodetype.BASE:
            return "" if of[0] == "string" else 0.0 if "float" in of[0] else 0
        (inner, name), count = of
        if inner == Nodetype.BASE and name[0] != "string":
            return np.zeros(count if kind == Nodetype.ARRAY else 0, name[0])
        return [self._zero(of[0]) for _ in range(count if kind == Nodetype.ARRAY else 0)]

    def stamp(self, t):
        ns = round((BEGINS_S + t) * 1e9)
        return self.make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)

    def header(self, t, frame):
        return self.make("std_msgs/msg/Header", stamp=t if hasattr(t, "sec") else self.stamp(t), frame_id=frame)

    def xyzw(self, name, *numbers):
        return self.make(f"geometry_msgs/msg/{name}", **dict(zip("xyzw", map(float, numbers), strict=False)))

    def pose(self, x, y, z, yaw=0.0, covariance=None):
        turn = self.xyzw("Quaternion", 0, 0, math.sin(yaw / 2), math.cos(yaw / 2))
        at = self.make("geometry_msgs/msg/Pose", position=self.xyzw("Point", x, y, z), orientation=turn)
        if covariance is None:
            return at
        return self.make("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=covariance)

    def odometry(self, t, pose, v=0.0, w=0.0):
        linear, angular = self.xyzw("Vector3", v), self.xyzw("Vector3", 0, 0, w)
        twist = self.make("geometry_msgs/msg/Twist", linear=linear, angular=angular)
        parts = {"header": self.header(t, "odom"), "pose": self.pose(*pose[:2], 0, pose[2], covariance=np.zeros(36))}
        parts["twist"] = self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist)
        return self.make(ODOMETRY, child_frame_id="base_link", **parts)

    def odometry_rows(self, stamp=lambda t: t, driven=None, **more):
        rows = zip(self.t.tolist(), self.driven if driven is None else driven, self.v, self.w, strict=True)
        return [(t, "/odom", ODOMETRY, self.odometry(stamp(t), pose, v, w, **more)) for t, pose, v, w in rows]

    def array(self, t, row, frame=FRAME, times=1.0, cameras=1, fields=lambda robot, i, at: {}):
        found = [self._one(t, i, times * p, frame, fields) for i, p in row * cameras]
        return self.make(DETECTIONS, header=self.header(t, frame), detections=found)

    def _one(self, t, i, p, frame, fields):
        at = self.pose(*p, covariance=np.diag([9e-4] * 3 + [0.0] * 3).ravel())
        new = fields(self, i, at) or {"id": str(i), "results": [self.make(HYPOTHESIS, pose=at)]}
        return self.make("vision_msgs/msg/Detection3D", header=self.header(t, frame), **new)

    def seen_rows(self, stamp=lambda t: t, **more):
        return [(t + 0.04, "/landmarks", DETECTIONS, self.array(stamp(t), row, **more)) for t, row in self.seen if row]

    def tags_rows(self, type_name, tag):
        of = type_name.removesuffix("Array") if type_name.endswith("DetectionArray") else type_name.replace("Array", "")
        field = "detections" if type_name.endswith("DetectionArray") else "markers"
        for t, row in self.seen:
            tags = [self.make(of, **tag(self, t, i, p)) for i, p in row]
            header = {"header": self.header(t, FRAME)} if "header" in dict(self.store.fielddefs[type_name][1]) else {}
            yield t + 0.04, "/tags", type_name, self.make(type_name, **header, **{field: tags})

    def transform(self, parent, child):
        translation, rotation = self.xyzw("Vector3", *CAMERA[:3]), self.xyzw("Quaternion", *CAMERA[3:])
        moved = self.make("geometry_msgs/msg/Transform", translation=translation, rotation=rotation)
        header = self.header(0.0, parent)
        return self.make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=moved)

    def static_rows(self, *links, type_name=TF):
        links = links or (("base_link", FRAME),)
        return [
            (0.0, "/tf_static", type_name, self.make(type_name, transforms=[self.transform(*one) for one in links]))
        ]


def written(path, robot, *rows, storage=StoragePlugin.MCAP):
    """A rosbag2 folder of rows: when it was received [s], topic, type, message."""
    with Ros2Writer(path, version=9, storage_plugin=storage) as writer:
        known = {}
        for t, topic, name, m in sorted((row for some in rows for row in some), key=lambda row: row[0]):
            if topic not in known:
                known[topic] = writer.add_connection(topic, name, typestore=robot.store)
            writer.write(known[topic], round((BEGINS_S + t) * 1e9), robot.store.serialize_cdr(m, name))
    return path


def store_of(base, types=()):
    """The types of a distribution, with those of a package: fields by package and name."""
    store = get_typestore(base)
    if TF not in store.fielddefs:
        store.register({TF: typestore().fielddefs[TF]})
    for name, fields in dict(types).items():
        store.register(get_types_from_msg(fields.replace("; ", "\n") + "\n", name.replace("__", "/msg/")))
    return store


def written_ros1(path, robot, *rows, without=()):
    """A ROS 1 bag; topics of ``without`` have an empty definition, as rosserial and goroslib write it."""
    with Ros1Writer(path) as writer:
        known = {}
        for t, topic, name, m in sorted((row for some in rows for row in some), key=lambda row: row[0]):
            if topic not in known:
                text, md5 = robot.store.generate_msgdef(name, ros_version=1)
                known[topic] = writer.add_connection(topic, name, msgdef="" if topic in without else text, md5sum=md5)
            writer.write(known[topic], round((BEGINS_S + t) * 1e9), robot.store.serialize_ros1(m, name))
    return path


def converted(path, robot, *rows):
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros1", library="mcap go")
        known = {}
        for t, topic, name, m in sorted((row for some in rows for row in some), key=lambda row: row[0]):
            if topic not in known:
                text, md5 = robot.store.generate_msgdef(name, ros_version=1)
                schema = writer.register_schema(name.replace("/msg/", "/"), "ros1msg", text.encode())
                known[topic] = writer.register_channel(topic, "ros1", schema, {"md5sum": md5})
            writer.add_message(known[topic], ns(t), bytes(robot.store.serialize_ros1(m, name)), ns(t))
        writer.finish()
    return path


ARUCO = {
    "aruco_msgs__Marker": "std_msgs/Header header; uint32 id; geometry_msgs/PoseWithCovariance pose",
    "aruco_msgs__MarkerArray": "std_msgs/Header header; aruco_msgs/Marker[] markers",
}
APRILTAGS = {
    "apriltag_ros__AprilTagDetection": "int32[] id; float64[] size; geometry_msgs/PoseWithCovarianceStamped pose",
    "apriltag_ros__AprilTagDetectionArray": "std_msgs/Header header; apriltag_ros/AprilTagDetection[] detections",
    "tf__tfMessage": "geometry_msgs/TransformStamped[] transforms",
}
OLDER = {
    "vision_msgs__BoundingBox3D": "geometry_msgs/Pose center; geometry_msgs/Vector3 size",
    "vision_msgs__Detection3DArray": "std_msgs/Header header; vision_msgs/Detection3D[] detections",
}
NOETIC = OLDER | {
    "vision_msgs__ObjectHypothesisWithPose": "int64 id; float64 score; geometry_msgs/PoseWithCovariance pose",
    "vision_msgs__Detection3D": "std_msgs/Header header; vision_msgs/ObjectHypothesisWithPose[] results; "
    "vision_msgs/BoundingBox3D bbox; sensor_msgs/PointCloud2 source_cloud",
}
FOXY = OLDER | {
    "vision_msgs__ObjectHypothesisWithPose": "string id; float64 score; geometry_msgs/PoseWithCovariance pose",
    "vision_msgs__Detection3D": "std_msgs/Header header; vision_msgs/ObjectHypothesisWithPose[] results; "
    "vision_msgs/BoundingBox3D bbox; sensor_msgs/PointCloud2 source_cloud; bool is_tracking; string tracking_id",
}


def aruco(robot, t, i, p):
    at = robot.pose(*p, covariance=np.zeros(36))
    return {"header": robot.header(t, FRAME), "id": i, "pose": at, "confidence": 1.0}


def of_ros1(robot, t, i, p):
    at = robot.pose(*p, covariance=np.zeros(36))
    posed = robot.make("geometry_msgs/msg/PoseWithCovarianceStamped", header=robot.header(t, FRAME), pose=at)
    return {"id": np.array([i], np.int32), "size": np.array([0.16]), "pose": posed}


def older(robot, i, at):
    is_number = dict(robot.store.fielddefs[HYPOTHESIS][1])["id"][1][0] == "int64"
    fields = {"results": [robot.make(HYPOTHESIS, id=i if is_number else str(i), score=1.0, pose=at)]}
    return fields if is_number else fields | {"is_tracking": True, "tracking_id": str(i)}


def mcap_of_ros1(folder):
    robot = Robot(store_of(Stores.ROS1_NOETIC, ARUCO))
    tags = robot.tags_rows("aruco_msgs/msg/MarkerArray", aruco)
    return converted(folder / "a.mcap", robot, robot.static_rows(), robot.odometry_rows(), tags)


def ros1_without_definition(folder):
    robot = Robot(store_of(Stores.ROS1_NOETIC, ARUCO))
    rows = robot.static_rows(), robot.odometry_rows(), robot.tags_rows("aruco_msgs/msg/MarkerArray", aruco)
    return written_ros1(folder / "a.bag", robot, *rows, without=("/odom", "/tf_static"))


def ros1_apriltags(folder):
    robot = Robot(store_of(Stores.ROS1_NOETIC, APRILTAGS))
    tags = robot.tags_rows("apriltag_ros/msg/AprilTagDetectionArray", of_ros1)
    static = robot.static_rows(type_name="tf/msg/tfMessage")
    return written_ros1(folder / "a.bag", robot, static, robot.odometry_rows(), tags)


def noetic(folder):
    robot = Robot(store_of(Stores.ROS1_NOETIC, NOETIC))
    rows = robot.static_rows(), robot.odometry_rows(), robot.seen_rows(fields=older)
    return written_ros1(folder / "a.bag", robot, *rows)


def foxy(folder):
    robot = Robot(store_of(Stores.ROS2_FOXY, FOXY))
    rows = robot.static_rows(), robot.odometry_rows(), robot.seen_rows(fields=older)
    path = written(folder / "a", robot, *rows, storage=StoragePlugin.SQLITE3)
    with sqlite3.connect(next(path.glob("*.db3"))) as db:  # as Foxy's, it has no definitions
        for table in ("message_definitions", "metadata", "schema"):
            db.execute(f"DROP TABLE IF EXISTS {table}")
    return path


def said(capsys, *words):
    """The exit code and all that a command prints, in one line."""
    code = main([str(word) for word in words])
    out = capsys.readouterr()
    return code, " ".join(f"{out.out} {out.err}".split())


def pasted(capsys, bag, run, *more):
    """What the command that ``info`` prints does."""
    main(["info", str(bag)])
    words = shlex.split(capsys.readouterr().out.strip().splitlines()[-1])
    assert words[:2] == ["graph_slam", "replay"], " ".join(words)
    return said(capsys, *words[1 : words.index("--out")], "--out", run, *more)


def error_m(robot, run):
    """The largest error of the path, after the rigid motion that fits best."""
    path = read_tum(run / "path.tum")
    true = np.stack([np.interp(path.stamps_s - BEGINS_S, robot.t, robot.true[:, k]) for k in (0, 1)], 1)
    a, b = (of - of.mean(0) for of in (path.poses[:, :2], true))
    u, _, v = np.linalg.svd(a.T @ b)
    return float(np.linalg.norm(a @ u @ np.diag([1.0, np.linalg.det(u @ v)]) @ v - b, axis=1).max())


READ = {
    "mcap convert of a ROS 1 bag": mcap_of_ros1,
    "ROS 1 without definitions": ros1_without_definition,
    "ROS 1's apriltag_ros, tf/tfMessage": ros1_apriltags,
    "vision_msgs of Noetic": noetic,
    "vision_msgs of Foxy, in a db3 without definitions": foxy,
    "a tag in two cameras": lambda folder: driven(folder, None, lambda robot: robot.seen_rows(cameras=2)),
    "blanks after some ids": lambda folder: driven(folder, None, renamed(lambda i: f"{i}" + " " * (next(COUNT) % 2))),
}


def test_a_recording_of_older_or_other_tools_is_read_by_the_command_that_info_prints(tmp_path, capsys):
    for k, (name, make) in enumerate(READ.items()):
        (folder := tmp_path / str(k)).mkdir()
        code, text = pasted(capsys, make(folder), folder / "run")
        assert code == 0, (name, text)
        assert error_m(Robot(), folder / "run") < 0.05, (name, text)
        assert "landmarks 21 " in text, (name, text)


def driven(folder, odometry=None, seen=None, static=None):
    """A recording of a robot, of which a part is as a report has it."""
    robot = Robot()
    static = robot.static_rows() if static is None else static(robot)
    rows = odometry(robot) if odometry else robot.odometry_rows(), seen(robot) if seen else robot.seen_rows()
    return written(folder / "bag", robot, static, *rows)


def stamped_by(stamp, of="odometry_rows"):
    """Rows whose stamps have seconds and nanoseconds by a function of time."""

    def rows(robot):
        time = robot.store.types["builtin_interfaces/msg/Time"]
        return getattr(robot, of)(stamp=lambda t: time(*map(int, stamp(t))))

    return rows


def ns(t):
    return round((BEGINS_S + t) * 1e9)


def leap(t):
    return t + 8.0e6 * (t >= 8.0)


def leapt(rows):
    return [(leap(t), *rest) for t, *rest in rows]


def with_w_first(robot):
    for *row, message in robot.odometry_rows():
        q = message.pose.pose.orientation
        q.x, q.z, q.w = q.w, 0.0, q.z
        yield *row, message


def in_feet(robot):
    for *row, message in robot.odometry_rows():
        at, v = message.pose.pose.position, message.twist.twist.linear
        at.x, at.y, v.x = (3.2808 * x for x in (at.x, at.y, v.x))
        yield *row, message


def two_robots(robot):
    return [*robot.odometry_rows(), *robot.odometry_rows(driven=robot.true + np.array([7.0, 3.0, 1.0]))]


def renamed(name):
    """Sightings whose ids are others."""
    return lambda r: r.seen_rows(fields=lambda r, i, at: {"id": name(i), "results": [r.make(HYPOTHESIS, pose=at)]})


COUNT, ROWS = itertools.count(), ("odometry_rows", "seen_rows")
SLASHES = (lambda r: r.seen_rows(frame="Robot/cam "), lambda r: r.static_rows(("base_link", "robot//cam")))
CAUSES = {
    "tags 1.8 times": ((None, lambda r: r.seen_rows(times=1.8)), "range_scale", "as long as odometry says"),
    "tags 1.2 times": ((None, lambda r: r.seen_rows(times=1.2)), "range_scale", "if odometry is: odometry.distance"),
    "two robots": ((two_robots,), "two_publishers", "two robots or drivers take turns: 300 of its poses"),
    "feet": ((in_feet,), "units", "times as far as landmarks say"),
    "one id": ((None, renamed(lambda i: "tag")), "id_twice", "twice in their message"),
    "tracks": ((None, renamed(lambda i: str(next(COUNT)))), "seen_once", "less than 3"),
    "microseconds": ((stamped_by(lambda t: (BEGINS_S + t, ns(t) % 10**9 // 1000)),), "wrong_stamps", "microseconds"),
    "32 bits": ((stamped_by(lambda t: (BEGINS_S + t, ns(t) % 2**32)),), "bad_stamp", "are refused"),
    "a fast clock": ((stamped_by(lambda t: (186_000_000 + t * 1000, 0)),), "wrong_stamps", "1e+03 s for each second"),
    "NTP": ((lambda r: leapt(r.odometry_rows(leap)), lambda r: leapt(r.seen_rows(leap))), "clock_jump", "92.6 days"),
    "seconds as ns": ([stamped_by(lambda t: (1, BEGINS_S - 1e9 + t), of) for of in ROWS], "wrong_stamps", "e-09 s"),
    "w first": ((with_w_first,), "no_orientation_of_odometry", "does w come first in its quaternions?"),
    "a twist alone": ((lambda r: r.odometry_rows(driven=0.0 * r.driven),), "pose_stands", "its twist says 0.8 m/s"),
    "double slash": ((None, *SLASHES), "frame_unlinked", "did you mean robot//cam?"),
    "no transform": ((None, None, lambda r: []), "frame_unlinked", "is assumed"),
}


def found(capsys, bag, *settings):
    """What a quick check finds above a note, by code."""
    main(["check", str(bag), "--quick", "--json", *(word for one in settings for word in ("--set", one))])
    return {one["code"]: one for one in json.loads(capsys.readouterr().out)["findings"] if one["severity"] != "note"}


def test_the_cause_alone_is_said_and_its_settings_mend_it(tmp_path, capsys):
    for k, (name, (parts, code, words)) in enumerate(CAUSES.items()):
        (folder := tmp_path / str(k)).mkdir()
        bag = driven(folder, *parts)
        one = found(capsys, bag)
        assert one.keys() == {code}, (name, one)
        assert words in one[code]["text"], (name, one)
        if code == "range_scale":
            assert abs(one[code]["value"] / float(name.split()[1]) - 1.0) < 0.04, (name, one)
        if settings := one[code]["settings"]:
            assert code not in found(capsys, bag, *settings), name
        mount = ["detections.mount=0.2 0 0.4 -1.5707963 0 -1.5707963"]
        if name not in (mended := {"tags 1.8 times": settings, "feet": settings, "no transform": mount}):
            continue
        code, text = pasted(capsys, bag, folder / "run")
        assert mended[name] and code == 3 and words in text and "odometry was in doubt" not in text, text
        code, text = pasted(capsys, bag, folder / "mended", *(word for one in mended[name] for word in ("--set", one)))
        assert code == 0 and error_m(Robot(), folder / "mended") < 0.1, text


def much_noise(robot, i, at):
    at.covariance[:] = 1e6 * np.eye(6).ravel()


def test_sightings_of_which_the_noise_is_so_large_that_they_correct_nothing_are_named(tmp_path, capsys):
    bag = driven(tmp_path, seen=lambda robot: robot.seen_rows(fields=much_noise))
    for how, expected in (("message", 3), ("sigmas", 0)):
        code, text = pasted(capsys, bag, tmp_path / how, "--set", f"detections.noise={how}")
        assert code == expected and ("odometry alone: --set detections.noise=sigmas" in text) == (code == 3), text
        assert (error_m(Robot(), tmp_path / how) < 0.1) == (code == 0), text


def fix(robot, t, east, north, frame):
    longitude = 7.0 + math.degrees(east / (6_390_700.0 * math.cos(math.radians(52.0))))
    at = {"latitude": 52.0 + math.degrees(north / 6_364_900.0), "longitude": longitude, "position_covariance_type": 2}
    covariance, header = np.diag([0.04, 0.04, 0.1]).ravel(), robot.header(t, frame)
    return robot.make("sensor_msgs/msg/NavSatFix", header=header, position_covariance=covariance, **at)


def imu(robot, t, yaw):
    turn, covariance = robot.pose(0, 0, 0, yaw).orientation, np.diag([1e-3] * 3).ravel()
    header = robot.header(t, "base_link")
    return robot.make("sensor_msgs/msg/Imu", header=header, orientation=turn, orientation_covariance=covariance)


FIXES = {
    "right": (lambda t, x, y: (x, y), lambda yaw: yaw, None),
    "north, east": (lambda t, x, y: (y, x), lambda yaw: yaw, "fix_mirrored"),
    "frozen": (lambda t, x, y: (x, y) if not 12 < t < 20 else (1.0, 1.0), lambda yaw: yaw, "fix_frozen"),
    "short": (lambda t, x, y: (0.7 * x, 0.7 * y), lambda yaw: yaw, "odometry_scale"),
    "radians": (lambda t, x, y: (0.0175 * x, 0.0175 * y), lambda yaw: yaw, "unrelated"),
    "no transform": (lambda t, x, y: (x, y), lambda yaw: yaw, "mount_unknown"),
    "slips": (lambda t, x, y: (x + np.clip(t - 20, 0, 7), y), lambda yaw: yaw, "odometry_slips"),
    "late": (lambda t, x, y: (x, y), lambda yaw: yaw, "clock_offset"),
    "stays": (lambda t, x, y: (x + 4.0 * (t > 20), y), lambda yaw: yaw, "fix_jumps"),
    "jumps": (lambda t, x, y: (x + 4.0 * (20 < t < 40), y), lambda yaw: yaw, "fix_jumps"),
    "zero at north": (lambda t, x, y: (x, y), lambda yaw: yaw - math.pi / 2, "heading_offset"),
    "a compass that stands": (lambda t, x, y: (x, y), lambda yaw: 1.0, "unrelated"),
    "clockwise": (lambda t, x, y: (x, y), lambda yaw: math.pi / 2 - yaw, "heading_clockwise"),
}


def test_fixes_and_headings_are_compared_with_odometry_and_with_one_another(tmp_path, capsys):
    robot, turn = Robot(seconds=50.0), 0.7
    inputs = "inputs.names=odom gps imu", "gps.type=sensor_msgs/msg/NavSatFix", "gps.topic=/gps"
    inputs = *inputs, "imu.type=sensor_msgs/msg/Imu", "imu.topic=/imu"
    for k, (name, (at, heading, code)) in enumerate(FIXES.items()):
        rows, rng, late_s = [], np.random.default_rng(1), 0.5 * (name == "late")
        frame = "gps" if name == "no transform" else "base_link"
        for t, (x, y, yaw) in zip(robot.t[::4].tolist(), robot.true[::4], strict=True):
            z = complex(x, y) * np.exp(1j * turn)
            place = at(t, z.real + rng.normal(0, 0.1), z.imag + rng.normal(0, 0.1))
            rows.append((t + late_s + 0.03, "/gps", "sensor_msgs/msg/NavSatFix", fix(robot, t + late_s, *place, frame)))
            rows.append((t + 0.01, "/imu", "sensor_msgs/msg/Imu", imu(robot, t, heading(yaw + turn))))
        bag = written(tmp_path / str(k), robot, robot.static_rows(), robot.odometry_rows(), rows)
        one = found(capsys, bag, *inputs)
        assert one.keys() - {"fix_jumps"} == ({code} if code else set()) - {"fix_jumps"}, (name, one)
        assert code is None or code in one, (name, one)
        if code and one[code]["settings"]:
            assert found(capsys, bag, *inputs, *one[code]["settings"]) == {}, name
        if name in ("jumps", "slips", "stays"):
            code, _ = pasted(capsys, bag, tmp_path / name, "--set", "inputs.names=odom gps")
            assert code == 3 if name != "jumps" else error_m(robot, tmp_path / name) < 0.3


def test_what_cannot_be_read_is_named_for_what_it_is(tmp_path, capsys):
    robot = Robot(store_of(Stores.ROS1_NOETIC, ARUCO), seconds=3.0)
    rows = robot.static_rows(), robot.odometry_rows(), robot.tags_rows("aruco_msgs/msg/MarkerArray", aruco)
    (tmp_path / "a").mkdir()
    empty = written_ros1(tmp_path / "a/empty_0.bag", robot, *rows, without=("/tags",))
    shutil.copy(empty, tmp_path / "a/empty_2.bag")
    for words, expected in {
        ("info", empty): "its definition of aruco_msgs/msg/MarkerArray in the recording is empty",
        ("check", empty): "is not used",
        ("check", tmp_path): "give one of those in it: a",
        ("info", tmp_path / "a"): "part 1 is not there, between others",
    }.items():
        assert expected in said(capsys, *words)[1], words


def test_truth_of_other_tools_is_read_or_named(tmp_path, capsys):
    robot = Robot()
    bag = written(tmp_path / "a", robot, robot.static_rows(), robot.odometry_rows(), robot.seen_rows())
    assert pasted(capsys, bag, tmp_path / "run")[0] == 0
    rows = [(t, x, y, math.sin(a / 2), math.cos(a / 2)) for t, (x, y, a) in zip(robot.t, robot.true, strict=True)]
    tum = [f"{BEGINS_S + t:.6f} {x} {y} 0 0 0 {s} {c}\n" for t, x, y, s, c in rows]
    w_first = "".join(f"{BEGINS_S + t:.6f} {x} {y} 0 {c} 0 0 {s}\n" for t, x, y, s, c in rows)
    euroc = "".join(f"{round((BEGINS_S + t) * 1e9)},{x},{y},0,{c},0,0,{s},0\n" for t, x, y, s, c in rows)
    head = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n"
    for name, text, words in (
        ("euroc.csv", head + euroc, ""),
        ("numbered.txt", "num t x y z qx qy qz qw\n" + "".join(f"{k} {row}" for k, row in enumerate(tum)), ""),
        ("commas.csv", "".join(tum).replace(" ", ","), ""),
        ("decimal.tum", "".join(tum[:3]).replace(".", ","), "decimal commas"),
        ("kitti.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", "without stamps"),
        ("utf16.tum", "".join(tum), "iconv"),
        ("w_first.tum", w_first, "w comes first"),
    ):
        (tmp_path / name).write_text(text, encoding="utf-16" if name == "utf16.tum" else "utf-8")
        code, shown = said(capsys, "evaluate", tmp_path / "run", "--truth", tmp_path / name, "--json")
        assert words in shown and (code == 0) >= (not words), (name, shown)
        if not words:
            scores = json.loads(shown[: shown.rindex("}") + 1])
            assert max(scores["position_m"]["rmse"], scores["heading_rad"]["rmse"]) < 0.03, (name, shown)
