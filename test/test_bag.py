"""Recordings: all containers give the same; of damaged ones all that is whole is read and what is lost is told."""

import os
import shutil
import struct
from importlib.metadata import version

import numpy as np
import pytest
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.replay import choose_inputs, replay
from graph_slam_ros.ros.bag import BagError, BagWriter, open_bag
from graph_slam_ros.ros.definitions import recorded_decoder
from graph_slam_ros.ros.interfaces import INTERFACES, typestore
from graph_slam_ros.simulation import simulate, write_bag
from graph_slam_ros.slam import Config

ODOMETRY, DETECTIONS = "nav_msgs/msg/Odometry", "vision_msgs/msg/Detection3DArray"
TOPICS = {"/odom": ODOMETRY, "/landmarks": DETECTIONS}
SINGLE_FILES = pytest.mark.skipif(
    version("rosbags").split(".")[:2] < ["0", "11"], reason="this rosbags reads folders only"
)
RESULTS = ("graph.g2o", "path.tum", "sightings.tum", "landmarks.csv")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A short drive, as written by our own writer."""
    file = tmp_path_factory.mktemp("bag") / "drive.mcap"
    write_bag(simulate("manhattan", 2, poses=60, blocks=6), file)
    return file


@pytest.fixture(scope="module")
def messages(recorded):
    return list(open_bag(recorded).messages(TOPICS))


@pytest.fixture(scope="module")
def reference(recorded, tmp_path_factory):
    out = tmp_path_factory.mktemp("reference") / "run"
    replay(recorded, out)
    return {name: (out / name).read_bytes() for name in RESULTS}


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


# -- whole recordings -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", list(CompressionType), ids=lambda c: c.name)
def test_mcap_is_read_whatever_its_compression(tmp_path, messages, compression):
    file = write_mcap(tmp_path / "a.mcap", messages, compression=compression, chunk_size=20_000)
    assert len(chunks(file)) > 3
    assert read(file) == (messages, [])


@pytest.mark.parametrize("chunking", [True, False])
def test_mcap_without_index_or_summary_is_read_whole(tmp_path, messages, chunking):
    from mcap.writer import IndexType

    file = write_mcap(
        tmp_path / "a.mcap",
        messages,
        index_types=IndexType.NONE,
        repeat_channels=False,
        repeat_schemas=False,
        use_statistics=False,
        use_summary_offsets=False,
        use_chunking=chunking,
    )
    bag = open_bag(file)
    assert {t.name: t.count for t in bag.topics.values()} == {
        name: sum(m.topic == name for m in messages) for name in TOPICS
    }
    assert read(file) == (messages, [])


def test_a_recording_may_be_a_folder_of_parts_in_natural_order(tmp_path, messages):
    size = len(messages) // 11
    for k in range(12):
        write_mcap(tmp_path / f"drive_{k}.mcap", messages[k * size : (k + 1) * size if k < 11 else None])
    (tmp_path / "metadata.yaml").write_text("not read")
    assert read(tmp_path) == (messages, [])


def to_sqlite(folder, messages):
    with Ros2Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {
            topic: writer.add_connection(topic, name, typestore=typestore()) for topic, name in TOPICS.items()
        }
        for m in messages:
            writer.write(connections[m.topic], m.log_ns, m.cdr)
    return folder


def to_ros1(file, messages):
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, fields in INTERFACES["vision_msgs"].items():
        store.register(get_types_from_msg(fields.replace("std_msgs/Header", "Header"), f"vision_msgs/msg/{name}"))
    with Ros1Writer(file) as writer:
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


CONTAINERS = {
    "mcap by rosbags": lambda folder, messages: by_rosbags_mcap(folder / "bag", messages),
    "sqlite3 folder": lambda folder, messages: to_sqlite(folder / "bag", messages),
    "sqlite3 file": lambda folder, messages: next(to_sqlite(folder / "bag", messages).glob("*.db3")),
    "sqlite3 folder without metadata": lambda folder, messages: without_metadata(to_sqlite(folder / "bag", messages)),
    "ROS 1": lambda folder, messages: to_ros1(folder / "drive.bag", messages),
}


NO_FOLDERS = {"sqlite3 file", "sqlite3 folder without metadata"}


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


@pytest.mark.parametrize(
    "container", [pytest.param(c, marks=SINGLE_FILES) if c in NO_FOLDERS else c for c in CONTAINERS]
)
def test_every_container_gives_the_same_results(tmp_path, messages, reference, container):
    done = replay(CONTAINERS[container](tmp_path, messages), tmp_path / "run")
    assert done.losses == []
    assert {name: (tmp_path / "run" / name).read_bytes() for name in RESULTS} == reference


def test_our_own_files_carry_checksums_in_every_chunk(recorded, tmp_path, messages):
    replay(recorded, tmp_path / "run")
    for file in (recorded, tmp_path / "run" / "run.mcap", tmp_path / "run" / "ingest.mcap"):
        with file.open("rb") as stream:
            found = [r for r in StreamReader(stream, emit_chunks=True).records if isinstance(r, Chunk)]
        assert found
        assert all(chunk.uncompressed_crc for chunk in found), file.name


@SINGLE_FILES
def test_our_writer_is_read_by_rosbags(tmp_path, messages):
    from rosbags.highlevel import AnyReader

    with BagWriter(tmp_path / "a.mcap") as writer:
        for m in messages:
            writer.write(m.topic, TOPICS[m.topic], m.log_ns, m.cdr)
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        assert [(c.topic, c.msgtype, t, bytes(raw)) for c, t, raw in reader.messages()] == [
            (m.topic, TOPICS[m.topic], m.log_ns, m.cdr) for m in messages
        ]


# -- damaged recordings ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fraction", [0.15, 0.4, 0.77, 0.95])
@pytest.mark.parametrize("compression", list(CompressionType), ids=lambda c: c.name)
def test_F1_of_a_truncated_file_every_whole_chunk_is_read_and_the_loss_is_told(
    tmp_path, messages, compression, fraction
):
    whole = write_mcap(tmp_path / "whole.mcap", messages, compression=compression, chunk_size=20_000)
    cut = int(whole.stat().st_size * fraction)
    bounds = chunks(whole)
    (tmp_path / "cut.mcap").write_bytes(whole.read_bytes()[:cut])
    got, losses = read(tmp_path / "cut.mcap")
    assert got == messages[: len(got)]
    in_whole_chunks = sum(end <= cut for _, end in bounds) / len(bounds)
    assert len(got) / len(messages) == pytest.approx(in_whole_chunks, abs=1.5 / len(bounds))
    assert len(losses) == 1
    assert losses[0].startswith(f"cut.mcap: cut off after {len(got)} messages")


@pytest.mark.parametrize("fraction", [0.3, 0.8])
def test_F1_of_a_truncated_file_without_chunks_every_whole_message_is_read(tmp_path, messages, fraction):
    whole = write_mcap(tmp_path / "whole.mcap", messages, use_chunking=False)
    data = whole.read_bytes()
    cut = int(len(data) * fraction)
    (tmp_path / "cut.mcap").write_bytes(data[:cut])
    got, losses = read(tmp_path / "cut.mcap")
    ends = [data.index(m.cdr) + len(m.cdr) for m in messages]
    assert got == messages[: sum(end <= cut for end in ends)]
    assert len(losses) == 1


def test_F1_cut_at_every_one_of_many_places_nothing_but_a_loss_or_a_refusal_comes_of_it(tmp_path, messages):
    whole = write_mcap(tmp_path / "whole.mcap", messages, chunk_size=20_000).read_bytes()
    file = tmp_path / "cut.mcap"
    refused = 0
    for cut in [*range(1, 400, 23), *range(400, len(whole), len(whole) // 60), *range(len(whole) - 40, len(whole))]:
        file.write_bytes(whole[:cut])
        try:
            got, losses = read(file)
        except BagError as error:
            refused += 1
            assert "\n" not in str(error)
            continue
        assert got == messages[: len(got)]
        assert losses or got == messages, "cut in the summary, after the last message"
    assert 0 < refused < 40


def test_F3_a_flipped_bit_in_a_chunk_costs_that_chunk_alone_and_is_told(tmp_path, messages):
    whole = write_mcap(tmp_path / "a.mcap", messages, compression=CompressionType.NONE, chunk_size=20_000)
    data, bounds = whole.read_bytes(), chunks(whole)
    for first, last in (bounds[0], bounds[len(bounds) // 2], bounds[-1]):
        damaged = bytearray(data)
        damaged[(first + last) // 2] ^= 0x10
        whole.write_bytes(damaged)
        got, losses = read(whole)
        missing = [m for m in messages if m not in got]
        assert got == [m for m in messages if m in got]
        assert 0 < len(missing) < 2.5 * len(messages) / len(bounds)
        assert losses == [
            f"a.mcap: a damaged chunk of {last - first + 49} bytes was passed over (its checksum is another)",
            f"a.mcap: {len(missing)} of its messages could not be read",
        ]


def test_a_loss_is_told_once_however_often_the_file_is_read(tmp_path, recorded):
    (tmp_path / "cut.mcap").write_bytes(recorded.read_bytes()[:-1000])
    bag = open_bag(tmp_path / "cut.mcap")
    for _ in range(3):
        list(bag.messages(TOPICS))
    assert len(bag.losses) == 1


def test_whatever_byte_of_a_file_is_wrong_it_is_read_or_refused_in_one_line(tmp_path, messages):
    whole = write_mcap(tmp_path / "a.mcap", messages[:60], compression=CompressionType.LZ4, chunk_size=8_000)
    data, rng = whole.read_bytes(), np.random.default_rng(0)
    intact = messages[:60]
    for at in [*range(0, 100, 5), *rng.integers(0, len(data), 150), *range(len(data) - 300, len(data), 7)]:
        damaged = bytearray(data)
        damaged[at] ^= 1 << int(rng.integers(8))
        whole.write_bytes(damaged)
        try:
            got, losses = read(whole)
        except BagError as error:
            assert "\n" not in str(error)
            continue
        wrong = [m for m in got if (m.topic, m.cdr) not in {(i.topic, i.cdr) for i in intact}]
        assert not wrong or losses or at < 1000, "a header outside of a chunk has no checksum"
        assert len(got) == len(intact) or losses


def test_a_sqlite3_file_cut_in_half_is_refused_or_its_loss_told(tmp_path, messages):
    folder = to_sqlite(tmp_path / "bag", messages)
    (file,) = folder.glob("*.db3")
    data = file.read_bytes()
    for size in (len(data) // 2, 5000, 100):
        file.write_bytes(data[:size])
        try:
            got, losses = read(folder)
        except BagError as error:
            assert "\n" not in str(error)
            continue
        assert losses
        assert len(got) < len(messages)


# -- what is no recording -------------------------------------------------------------------------------------------


def make_fifo(path):
    os.mkfifo(path)
    return path


def make_file(path, content):
    path.write_bytes(content)
    return path


NO_RECORDINGS = {
    "empty file": (lambda p: make_file(p / "a.mcap", b""), "a.mcap: the file is empty"),
    "wrong magic": (lambda p: make_file(p / "a.mcap", b"hello, world, this is no recording"), "a.mcap: not a readable"),
    "wrong magic, no suffix": (
        lambda p: make_file(p / "a", b"hello, world, this is no recording"),
        "a: not a readable",
    ),
    "wrong magic in db3": (lambda p: make_file(p / "a.db3", b"hello, world" * 100), "a.db3: not a readable"),
    "wrong magic in bag": (lambda p: make_file(p / "a.bag", b"hello, world" * 100), "a.bag: not a readable"),
    "magic alone": (lambda p: make_file(p / "a.mcap", b"\x89MCAP0\r\n"), "a.mcap: no topic in it"),
    "folder without recording": (lambda p: p, "no recording"),
    "missing": (lambda p: p / "a.mcap", "a.mcap: no such file or folder"),
    "fifo": (lambda p: make_fifo(p / "a.mcap"), "a.mcap: neither a file nor a folder"),
    "folder with a fifo": (lambda p: make_fifo(p / "a.mcap").parent, "no recording"),
    "folder with an empty part": (lambda p: make_file(p / "a.mcap", b"").parent, "a.mcap: the file is empty"),
    "device": (lambda p: type(p)("/dev/zero"), "neither a file nor a folder"),
}


@pytest.mark.parametrize("kind", NO_RECORDINGS)
def test_F7_what_is_no_recording_is_refused_in_one_line(tmp_path, kind):
    path, complaint = NO_RECORDINGS[kind]
    with pytest.raises(BagError, match=complaint) as caught:
        open_bag(path(tmp_path))
    assert "\n" not in str(caught.value)


# -- schemas --------------------------------------------------------------------------------------------------------


def replay_with(tmp_path, messages, **options):
    file = write_mcap(tmp_path / "a.mcap", messages, **options)
    return replay(file, tmp_path / "run", odometry="/odom", landmarks="/landmarks")


def edited(old, new):
    def text(name):
        whole = definition(name)
        assert name != ODOMETRY or old in whole
        return whole.replace(old, new)

    return text


def test_F11_without_a_schema_the_refusal_says_so(tmp_path, messages):
    with pytest.raises(BagError, match="/odom has no type: the recording lacks its schema"):
        replay_with(tmp_path, messages, schemas=False)
    with pytest.raises(BagError, match=r"no topic of type nav_msgs/msg/Odometry .* /odom \(no type\)"):
        choose_inputs(open_bag(tmp_path / "a.mcap"), Config())


def test_F11_a_schema_without_text_is_decoded_by_our_own_definition(tmp_path, messages, reference):
    replay_with(tmp_path, messages, text=lambda name: "")
    assert (tmp_path / "run" / "graph.g2o").read_bytes() == reference["graph.g2o"]


@pytest.mark.parametrize(
    "old, new, complaint",
    [
        ("string child_frame_id\n", "", "nav_msgs/msg/Odometry of this recording has no field 'child_frame_id'"),
        ("float64[36] covariance\n", "float64[36] spread\n", "has no field 'covariance'"),
        ("float64 w\n", "", "geometry_msgs/msg/Quaternion of this recording has no field 'w'"),
        ("uint32 nanosec", "uint64 nanosec", "field 'nanosec' of builtin_interfaces/msg/Time has another type"),
        (
            "string child_frame_id\n",
            "int32 child_frame_id\n",
            "field 'child_frame_id' of nav_msgs/msg/Odometry has another",
        ),
        (
            "string child_frame_id\n",
            "= ] [ =\n",
            "the recorded definition of nav_msgs/msg/Odometry is not",
        ),
    ],
)
def test_F11_a_schema_that_lacks_what_we_need_is_refused_by_field_and_nothing_is_touched(
    tmp_path, messages, old, new, complaint
):
    with pytest.raises(BagError, match=f"topic /odom: .*{complaint}"):
        replay_with(tmp_path, messages, text=edited(old, new))
    assert not (tmp_path / "run").exists()


def test_F11_a_schema_with_more_fields_is_decoded_by_itself(tmp_path, messages, reference):
    text = definition(ODOMETRY).replace("string child_frame_id\n", "string child_frame_id\nint8[] extra\nint64 more\n")
    theirs = get_typestore(Stores.EMPTY)
    theirs.register({**typestore().fielddefs, **get_types_from_msg(text, ODOMETRY)})
    longer = []
    for m in messages:
        if m.topic == "/odom":
            ours = typestore().deserialize_cdr(m.cdr, ODOMETRY)
            message = theirs.types[ODOMETRY](
                header=ours.header,
                child_frame_id=ours.child_frame_id,
                extra=np.array([1, 2, 3], dtype=np.int8),
                more=7,
                pose=ours.pose,
                twist=ours.twist,
            )
            m = type(m)(m.topic, m.log_ns, bytes(theirs.serialize_cdr(message, ODOMETRY)))
        longer.append(m)
    done = replay_with(tmp_path, longer, text=lambda name: text if name == ODOMETRY else definition(name))
    assert done.summary["counters"] == {}
    assert (tmp_path / "run" / "graph.g2o").read_bytes() == reference["graph.g2o"]


def test_another_encoding_is_refused_by_name(tmp_path, messages):
    with pytest.raises(BagError, match="topic /odom: messages are encoded as 'json', not cdr"):
        replay_with(tmp_path, messages, encoding="json")


def test_big_endian_messages_are_read(messages):
    decode = recorded_decoder(open_bag_topic())
    m = next(m for m in messages if m.topic == "/odom")
    ours = typestore().deserialize_cdr(m.cdr, ODOMETRY)
    big = bytes(typestore().serialize_cdr(ours, ODOMETRY, little_endian=False))
    assert struct.unpack_from(">i", big, 4)[0] == ours.header.stamp.sec
    assert decode(big).pose.pose == ours.pose.pose


def open_bag_topic():
    from graph_slam_ros.ros.bag import Topic

    return Topic("/odom", ODOMETRY, 1)


# -- topics ---------------------------------------------------------------------------------------------------------


def test_an_unknown_topic_is_refused_with_those_there_are(recorded):
    with pytest.raises(
        BagError, match=r"no topic /wheel in the recording; there are .*/odom \(nav_msgs/msg/Odometry\)"
    ):
        choose_inputs(open_bag(recorded), Config(), "/wheel")


def test_a_topic_of_another_type_is_refused(recorded):
    with pytest.raises(
        BagError, match="topic /ground_truth is geometry_msgs/msg/PoseStamped, not nav_msgs/msg/Odometry"
    ):
        choose_inputs(open_bag(recorded), Config(), "/ground_truth")


def test_one_of_several_odometry_topics_must_be_chosen_unless_one_has_the_usual_name(tmp_path, messages):
    some = [type(m)(f"/{who}/odom", m.log_ns, m.cdr) for m in messages if m.topic == "/odom" for who in ("a", "b")]
    names = {"/a/odom": ODOMETRY, "/b/odom": ODOMETRY}
    bag = open_bag(write_mcap(tmp_path / "a.mcap", some, types=names))
    with pytest.raises(BagError, match=r"several topics .* \(/a/odom, /b/odom\): choose one with --odom"):
        choose_inputs(bag, Config())
    assert choose_inputs(bag, Config(), "/b/odom").topics["odom"] == "/b/odom"
    usual = open_bag(write_mcap(tmp_path / "b.mcap", some + messages, types=names | TOPICS))
    assert choose_inputs(usual, Config()).topics["odom"] == "/odom"


def test_a_recording_without_landmarks_is_dead_reckoning(tmp_path, messages):
    odometry = [m for m in messages if m.topic == "/odom"]
    file = write_mcap(tmp_path / "a.mcap", odometry, types={"/odom": ODOMETRY})
    done = replay(file, tmp_path / "run")
    assert done.summary["landmarks"] == 0
    assert done.slam.trajectory() == pytest.approx(np.array([k.T_odom_base for k in done.slam.keyframes]), abs=1e-9)


def test_parts_that_disagree_about_a_topics_type_are_refused(tmp_path, messages):
    write_mcap(tmp_path / "a_0.mcap", messages)
    write_mcap(tmp_path / "a_1.mcap", messages, types={"/odom": DETECTIONS, "/landmarks": DETECTIONS})
    with pytest.raises(BagError, match=r"a_1\.mcap: topic /odom is vision_msgs/msg/Detection3DArray here"):
        open_bag(tmp_path)


def test_reading_writes_nothing_beside_the_recording(tmp_path, recorded):
    shutil.copy(recorded, tmp_path / "b.mcap")
    read(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["b.mcap"]


def test_a_recording_split_by_topic_is_read_in_order_of_time(tmp_path):
    whole = tmp_path / "whole.mcap"
    write_bag(simulate("warehouse", 3, aisles=2, laps=1, aisle_m=6.0), whole)
    bag, parts = open_bag(whole), tmp_path / "parts"
    parts.mkdir()
    for name, topic in (("a", "/landmarks"), ("b", "/odom")):
        with BagWriter(parts / f"{name}.mcap") as part:
            for message in bag.messages({topic}):
                part.write(topic, bag.topics[topic].type, message.log_ns, message.cdr)
    together, apart = (replay(source, tmp_path / f"{source.stem}_run") for source in (whole, parts))
    assert apart.slam.graph.edge_count == together.slam.graph.edge_count
    assert apart.summary["counters"] == together.summary["counters"]


def test_a_run_s_graph_keeps_the_classes_of_its_edges(tmp_path):
    write_bag(simulate("warehouse", 3, aisles=2, laps=1, aisle_m=6.0), tmp_path / "bag.mcap")
    done = replay(tmp_path / "bag.mcap", tmp_path / "run")
    graph = read_g2o(tmp_path / "run" / "graph.g2o").graph
    assert set(graph.labels) == {"anchor", "odometry", "landmarks"}
    count: dict[str, int] = {}
    for table in graph.tables.values():
        for code, label in enumerate(graph.labels):
            count[label] = count.get(label, 0) + int((table.label.values == code).sum())
    assert count == {name: part["edges"] for name, part in done.summary["classes"].items()}
