"""A robot whose DDS is Eclipse Cyclone's: it knows no ROS, only topics and the types on the wire.

``python other_vendor.py 250`` drives so many steps, with odometry that drifts and landmarks that do not, and prints
what it hears as lines of JSON; ``0`` only listens.
"""

import dataclasses
import functools
import json
import os
import sys
import threading
import time
import types

os.environ["CYCLONEDDS_URI"] = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers><Peer Address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from live_drive import Drive
from rosbags.typesys.base import Nodetype

from graph_slam_ros.messages.interfaces import typestore

PATIENCE_S, STOP_EVERY, LAG_S = 120.0, 60, 2
_SURE = Policy.Reliability.Reliable(duration(seconds=1))
LATCHED = Qos(_SURE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
RELIABLE = Qos(_SURE, Policy.Durability.Volatile, Policy.History.KeepLast(1000))
HEARD = {
    "path": ("rt/graph_slam/path", "nav_msgs/msg/Path", LATCHED),
    "pose": ("rt/graph_slam/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", LATCHED),
    "tf": ("rt/tf", "tf2_msgs/msg/TFMessage", RELIABLE),
}
SENT = {"/odom": "nav_msgs/msg/Odometry", "/landmarks": "vision_msgs/msg/Detection3DArray"}


@functools.cache
def kind(name):
    """A message as Cyclone has it, from its definition."""
    package, _, short = name.split("/")
    annotations = {field: _type(*of) for field, of in typestore().fielddefs[name][1]}
    body = {"__annotations__": annotations, "__module__": __name__}
    typename = {"typename": f"{package}::msg::dds_::{short}_"}
    return dataclasses.dataclass(types.new_class(short, (IdlStruct,), typename, lambda space: space.update(body)))


def _type(node, of):
    if node == Nodetype.NAME:
        return kind(of)
    if node == Nodetype.BASE:
        return {"string": str, "bool": bool}.get(of[0]) or getattr(idl, of[0])
    inner, size = _type(*of[0]), of[1]
    return idl.array[inner, size] if node == Nodetype.ARRAY else idl.sequence[inner]


def wire(value):
    """A message of rosbags as one of Cyclone."""
    if isinstance(value, list):
        return [wire(one) for one in value]
    if hasattr(value, "__msgtype__"):
        names = [field for field, _ in typestore().fielddefs[value.__msgtype__][1]]
        return kind(value.__msgtype__)(**{name: wire(getattr(value, name)) for name in names})
    return value.tolist() if hasattr(value, "tolist") else value


class Robot:
    """Hears what the node publishes, and sends what a drive has."""

    def __init__(self):
        participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
        self._readers = {
            name: DataReader(participant, Topic(participant, topic, kind(of), qos=qos), qos=qos)
            for name, (topic, of, qos) in HEARD.items()
        }
        self._writers = {
            topic: DataWriter(participant, Topic(participant, f"rt{topic}", kind(of), qos=RELIABLE), qos=RELIABLE)
            for topic, of in SENT.items()
        }
        self._newest_s = 0

    def send(self, topic, cdr):
        self._writers[topic].write(wire(typestore().deserialize_cdr(cdr, SENT[topic])))

    def spin(self):
        time.sleep(0.002)
        for name, reader in self._readers.items():
            for sample in reader.take(100):
                if isinstance(sample, kind(HEARD[name][1])):  # of a writer that has left there is no message
                    tell(name, dataclasses.asdict(sample))
                    self._newest_s = sample.header.stamp.sec if name == "path" else self._newest_s

    def until(self, what, condition):
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > deadline:
                tell("fault", f"no {what} in {PATIENCE_S:g} s")
                sys.exit(1)
            self.spin()

    def drive(self, steps):
        """Of a latched topic only the newest message is kept: now and then it waits for the path to here."""
        self.until("subscriber", lambda: all(one.get_matched_subscriptions() for one in self._writers.values()))
        drive = Drive(1_700_000_000 * 10**9)
        for k in range(steps):
            drive.sees = k % 30 == 0
            drive.step(self)
            self.spin()
            if k % STOP_EVERY == STOP_EVERY - 1:
                self.until("path to here", lambda: self._newest_s >= drive.stamp_ns // 10**9 - LAG_S)
        tell("sent", {"truth": drive.truth, "odometry": drive.odom})


def tell(what, value):
    print(json.dumps([what, value]), flush=True)


if __name__ == "__main__":
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    robot = Robot()
    if steps := int(sys.argv[1]):
        robot.drive(steps)
    while not ended.is_set():
        robot.spin()
