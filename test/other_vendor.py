"""A robot whose DDS is Eclipse Cyclone's: it knows no ROS, only topics and the types on the wire.

``python other_vendor.py drive`` drives a circle, sends odometry that drifts and landmarks that do not, and prints what
it hears as lines of JSON; ``listen`` only listens.
"""

import json
import math
import os
import sys
import threading
import time
from dataclasses import dataclass, field

os.environ["CYCLONEDDS_URI"] = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers><Peer Address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

RADIUS_M, SPEED_M_S, LANDMARKS = 3.0, 1.0, 8
TURN_DRIFT = 1.08  # what odometry makes of a turn
HZ, LOOK_EVERY, LAPS, PACE = 20, 10, 2, 10
STOP_EVERY, LAG_S = 3 * HZ, 2
PATIENCE_S = 60.0
UNKNOWN = 1e6


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    pose: Pose = field(default_factory=Pose)
    covariance: array[float64, 36] = field(default_factory=lambda: [0.0] * 36)


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    header: Header
    pose: Pose


@dataclass
class PoseWithCovarianceStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"):
    header: Header
    pose: PoseWithCovariance


@dataclass
class Path(IdlStruct, typename="nav_msgs::msg::dds_::Path_"):
    header: Header
    poses: sequence[PoseStamped]


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[TransformStamped]


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::TwistWithCovariance_"):
    twist: Twist = field(default_factory=Twist)
    covariance: array[float64, 36] = field(default_factory=lambda: [0.0] * 36)


@dataclass
class Odometry(IdlStruct, typename="nav_msgs::msg::dds_::Odometry_"):
    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


@dataclass
class ObjectHypothesis(IdlStruct, typename="vision_msgs::msg::dds_::ObjectHypothesis_"):
    class_id: str = ""
    score: float64 = 1.0


@dataclass
class ObjectHypothesisWithPose(IdlStruct, typename="vision_msgs::msg::dds_::ObjectHypothesisWithPose_"):
    hypothesis: ObjectHypothesis
    pose: PoseWithCovariance


@dataclass
class BoundingBox3D(IdlStruct, typename="vision_msgs::msg::dds_::BoundingBox3D_"):
    center: Pose = field(default_factory=Pose)
    size: Vector3 = field(default_factory=Vector3)


@dataclass
class Detection3D(IdlStruct, typename="vision_msgs::msg::dds_::Detection3D_"):
    header: Header
    results: sequence[ObjectHypothesisWithPose]
    bbox: BoundingBox3D
    id: str


@dataclass
class Detection3DArray(IdlStruct, typename="vision_msgs::msg::dds_::Detection3DArray_"):
    header: Header
    detections: sequence[Detection3D]


_SURE = Policy.Reliability.Reliable(duration(seconds=1))
LATCHED = Qos(_SURE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
RELIABLE = Qos(_SURE, Policy.Durability.Volatile, Policy.History.KeepLast(1000))
HEARD = {
    "path": ("rt/graph_slam/path", Path, LATCHED),
    "pose": ("rt/graph_slam/pose", PoseWithCovarianceStamped, LATCHED),
    "tf": ("rt/tf", TFMessage, RELIABLE),
}


def main() -> None:
    """Listen from the beginning to the end; in between, drive."""
    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
    readers = {}
    for name, (topic, kind, qos) in HEARD.items():
        readers[name] = DataReader(participant, Topic(participant, topic, kind, qos=qos), qos=qos)
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    paths: list[Path] = []
    driving = drive(participant, paths) if sys.argv[1] == "drive" else iter(())
    while not ended.is_set():
        for name, reader in readers.items():
            for sample in reader.take(100):
                if not isinstance(sample, (Path, PoseWithCovarianceStamped, TFMessage)):
                    continue  # of a writer that has left there is no message
                if isinstance(sample, Path):
                    paths[:] = [sample]
                tell(name, SAID[name](sample))
        if next(driving, None) is None:
            time.sleep(0.01)


def tell(what, value) -> None:
    print(json.dumps([what, value]), flush=True)


def drive(participant, paths):
    """Drive, step by step; tells when all is sent, and where the robot then is and where odometry puts it.

    Of a latched topic only the newest message is kept: now and then it waits for the path to here, so that however busy
    the machine is some are heard in between.
    """
    writers = []
    for name, kind in (("rt/odom", Odometry), ("rt/landmarks", Detection3DArray)):
        writers.append(DataWriter(participant, Topic(participant, name, kind, qos=RELIABLE), qos=RELIABLE))
    deadline = time.monotonic() + PATIENCE_S
    while not all(writer.get_matched_subscriptions() for writer in writers):
        if time.monotonic() > deadline:
            tell("fault", f"nobody subscribes in {PATIENCE_S:g} s")
            return
        time.sleep(0.01)
        yield True
    truth = reckoned = (0.0, 0.0, 0.0)
    begin, turn = time.monotonic(), SPEED_M_S / RADIUS_M
    for k in range(int(LAPS * 2.0 * math.pi * RADIUS_M / SPEED_M_S * HZ)):
        head = Header(Time(1_700_000_000 + k // HZ, 10**9 // HZ * (k % HZ)), "odom")
        writers[0].write(Odometry(head, "base_link", PoseWithCovariance(posed(reckoned)), moving(turn * TURN_DRIFT)))
        if k % LOOK_EVERY == 0:
            head = Header(head.stamp, "base_link")
            writers[1].write(Detection3DArray(head, list(seen(head, truth))))
        truth, reckoned = moved(truth, turn), moved(reckoned, turn * TURN_DRIFT)
        while time.monotonic() < begin + k / (HZ * PACE):
            time.sleep(0.001)
            yield True
        if k % STOP_EVERY == STOP_EVERY - 1:
            stopped, here_ns = time.monotonic(), stamp_ns(head)
            while not (paths and stamp_ns(paths[0].poses[-1].header) >= here_ns - LAG_S * 10**9):
                if time.monotonic() > stopped + PATIENCE_S:
                    tell("fault", f"no path to within {LAG_S} s of here in {PATIENCE_S:g} s")
                    return
                time.sleep(0.001)
                yield True
            begin += time.monotonic() - stopped
    tell("sent", {"truth": truth, "odometry": reckoned})


def moved(at, turn):
    """After one message's time, along an arc."""
    x, y, heading = at
    step, turned = SPEED_M_S / HZ, turn / HZ
    along = heading + 0.5 * turned
    return x + step * math.cos(along), y + step * math.sin(along), heading + turned


def moving(turn: float) -> TwistWithCovariance:
    covariance = [0.0] * 36
    for k, sigma in enumerate((0.05, 0.01, 1.0, 1.0, 1.0, 0.1)):
        covariance[7 * k] = sigma**2
    return TwistWithCovariance(Twist(Vector3(SPEED_M_S, 0.0, 0.0), Vector3(0.0, 0.0, turn)), covariance)


def seen(head: Header, at):
    """What stands around the circle, as far as it is near, from where the robot is."""
    x, y, heading = at
    for k in range(LANDMARKS):
        angle = 2.0 * math.pi * k / LANDMARKS
        dx, dy = (RADIUS_M + 1.0) * math.cos(angle) - x, RADIUS_M + (RADIUS_M + 1.0) * math.sin(angle) - y
        if math.hypot(dx, dy) < 3.0:
            c, s = math.cos(heading), math.sin(heading)
            covariance = [0.0] * 36
            for row in range(6):
                covariance[7 * row] = 0.05**2 if row < 3 else UNKNOWN
            place = Pose(Point(c * dx + s * dy, c * dy - s * dx, 0.0))
            one = ObjectHypothesisWithPose(ObjectHypothesis(), PoseWithCovariance(place, covariance))
            yield Detection3D(head, [one], BoundingBox3D(), f"post{k}")


def posed(at) -> Pose:
    x, y, heading = at
    return Pose(Point(x, y, 0.0), Quaternion(0.0, 0.0, math.sin(0.5 * heading), math.cos(0.5 * heading)))


def stamp_ns(header: Header) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def numbers(pose: Pose) -> list:
    p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


def of_path(m: Path):
    return {"frame": m.header.frame_id, "poses": [[stamp_ns(p.header), *numbers(p.pose)] for p in m.poses]}


def of_pose(m: PoseWithCovarianceStamped):
    about = {"frame": m.header.frame_id, "stamp_ns": stamp_ns(m.header)}
    return about | {"pose": numbers(m.pose.pose), "covariance": list(m.pose.covariance)}


def of_tf(m: TFMessage):
    return [[t.header.frame_id, t.child_frame_id, stamp_ns(t.header), t.transform.translation.x] for t in m.transforms]


SAID = {"path": of_path, "pose": of_pose, "tf": of_tf}

if __name__ == "__main__":
    main()
