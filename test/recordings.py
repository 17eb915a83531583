"""Recordings for tests, as we and as other tools write them."""

from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from graph_slam_ros.messages.interfaces import INTERFACES, typestore
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.tools.simulation import simulate, write_bag

ODOMETRY, DETECTIONS = "nav_msgs/msg/Odometry", "vision_msgs/msg/Detection3DArray"
TOPICS = {"/odom": ODOMETRY, "/landmarks": DETECTIONS}
RESULTS = ("graph.g2o", "path.tum", "sightings.tum", "landmarks.csv")


def short_drive(file):
    """As written by our own writer."""
    write_bag(simulate("manhattan", 2, poses=60, blocks=6), file)
    return file


def definition(type_name):
    return typestore().generate_msgdef(type_name, ros_version=2)[0]


def write_mcap(file, messages, *, text=definition, types=TOPICS, encoding="cdr", schemas=True, **options):
    """An mcap file as another tool might write it."""
    with file.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, name in types.items():
            schema = writer.register_schema(name, "ros2msg", text(name).encode()) if schemas else 0
            channels[topic] = writer.register_channel(topic, encoding, schema)
        for m in messages:
            writer.add_message(channels[m.topic], m.log_ns, m.cdr, m.log_ns, 0)
        writer.finish()
    return file


def read(path):
    bag = open_bag(path)
    return list(bag.messages(TOPICS)), bag.losses


def chunks(file):
    """Where each chunk's data begins and ends in the file."""
    found = []
    data = file.read_bytes()
    with file.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk):
                at = data.index(record.data)
                found.append((at, at + len(record.data)))
    return found


def to_sqlite(folder, messages):
    with Ros2Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {
            topic: writer.add_connection(topic, name, typestore=typestore()) for topic, name in TOPICS.items()
        }
        for m in messages:
            writer.write(connections[m.topic], m.log_ns, m.cdr)
    return folder


def to_ros1(file, messages, compression=None, chunk_bytes=2**20):
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, fields in INTERFACES["vision_msgs"].items():
        store.register(get_types_from_msg(fields.replace("std_msgs/Header", "Header"), f"vision_msgs/msg/{name}"))
    writer = Ros1Writer(file)
    writer.chunk_threshold = chunk_bytes
    if compression:
        writer.set_compression(compression)
    with writer:
        connections = {topic: writer.add_connection(topic, name, typestore=store) for topic, name in TOPICS.items()}
        for m in messages:
            ours = typestore().deserialize_cdr(m.cdr, TOPICS[m.topic])
            raw = store.serialize_ros1(with_seq(store, ours), TOPICS[m.topic])
            writer.write(connections[m.topic], m.log_ns, raw)
    return file


def with_seq(store, message):
    """A ROS 2 message object with the header field that ROS 1 has besides."""
    name = getattr(message, "__msgtype__", None)
    if name is None:
        return [with_seq(store, m) for m in message] if isinstance(message, list) else message
    fields = {field: with_seq(store, getattr(message, field)) for field in message.__dataclass_fields__}
    fields.pop("__msgtype__", None)
    if name == "std_msgs/msg/Header":
        fields["seq"] = 3
    return store.types[name](**fields)


def by_rosbags_mcap(folder, messages):
    with Ros2Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            topic: writer.add_connection(topic, name, typestore=typestore()) for topic, name in TOPICS.items()
        }
        for m in messages:
            writer.write(connections[m.topic], m.log_ns, m.cdr)
    return folder


def without_metadata(folder):
    (folder / "metadata.yaml").unlink()
    return folder


CONTAINERS = {
    "mcap by rosbags": lambda folder, messages: by_rosbags_mcap(folder / "bag", messages),
    "sqlite3 folder": lambda folder, messages: to_sqlite(folder / "bag", messages),
    "sqlite3 file": lambda folder, messages: next(to_sqlite(folder / "bag", messages).glob("*.db3")),
    "sqlite3 folder without metadata": lambda folder, messages: without_metadata(to_sqlite(folder / "bag", messages)),
    "ROS 1": lambda folder, messages: to_ros1(folder / "drive.bag", messages),
}
