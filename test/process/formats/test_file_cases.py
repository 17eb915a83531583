"""Files of every kind of fault: all that is whole is read, what is lost is told, and the rest is refused by name."""

import bz2
import gzip
import itertools
import os
import pickle
import re
import resource
import shutil
import sqlite3
import struct
from collections import Counter
from contextlib import closing
from dataclasses import replace

import lz4.frame
import numpy as np
import pytest
import zstandard
from confined import confined
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, Footer, SummaryOffset
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from recordings import (
    CONTAINERS,
    ODOMETRY,
    RESULTS,
    TOPICS,
    Ros1Writer,
    chunks,
    definition,
    read,
    short_drive,
    to_ros1,
    to_sqlite,
    write_mcap,
)
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rows import each

from graph_slam_ros.cli import main
from graph_slam_ros.errors import ConfigError, FormatError, GraphSlamError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.parameters import parse_setting, read_parameters
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.optimization import optimize
from graph_slam_ros.overview.chosen_inputs import choose_inputs
from graph_slam_ros.recordings import mcap_records
from graph_slam_ros.recordings.bag import BagError, Topic, open_bag
from graph_slam_ros.recordings.definitions import recorded_decoder
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return short_drive(tmp_path_factory.mktemp("bag") / "drive.mcap")


@pytest.fixture(scope="module")
def messages(recorded):
    return list(open_bag(recorded).messages(TOPICS))


@pytest.fixture(scope="module")
def reference(recorded, tmp_path_factory):
    out = tmp_path_factory.mktemp("reference") / "run"
    replay(recorded, out)
    return {name: (out / name).read_bytes() for name in RESULTS}


BARE = {"index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False}
BARE["use_summary_offsets"] = False


@each("options", [*({"compression": one} for one in CompressionType), BARE, BARE | {"use_chunking": False}])
def test_F2_F5_mcap_is_read_whatever_its_compression_and_without_index_or_summary(tmp_path, messages, options):
    file = write_mcap(tmp_path / "a.mcap", messages, chunk_size=20_000, **options)
    assert len(chunks(file)) > 3 or not options.get("use_chunking", True)
    assert read(file) == (messages, [])
    counts = {topic.name: topic.count for topic in open_bag(file).topics.values()}
    assert counts == Counter(m.topic for m in messages)


CODECS = {f"ROS 1, {codec.name}": codec for codec in Ros1Writer.CompressionFormat}


@each("container", [*CONTAINERS, *CODECS, "messages compressed one by one"])
def test_F5_F8_every_container_gives_the_same_messages_with_and_without_metadata(tmp_path, messages, container):
    if container in CODECS:
        bag = to_ros1(tmp_path / "a.bag", messages, CODECS[container])
    elif container in CONTAINERS:
        bag = CONTAINERS[container](tmp_path, messages)
    else:  # as rosbag2 does
        bag = to_sqlite(tmp_path / "bag", [replace(m, cdr=zstandard.compress(m.cdr)) for m in messages])
    assert read(bag) == (messages, [])


@each("fraction, compression", zip((0.15, 0.4, 0.77, 0.95), itertools.cycle(CompressionType)))
def test_F1_of_a_truncated_file_every_whole_chunk_is_read_and_the_loss_is_told(
    tmp_path, messages, compression, fraction
):
    whole = write_mcap(tmp_path / "whole.mcap", messages, compression=compression, chunk_size=20_000)
    cut = int(whole.stat().st_size * fraction)
    bounds = chunks(whole)
    (tmp_path / "cut.mcap").write_bytes(whole.read_bytes()[:cut])
    bag = open_bag(tmp_path / "cut.mcap")
    got, _, losses = list(bag.messages(TOPICS)), list(bag.messages(TOPICS)), bag.losses  # told once
    assert got == messages[: len(got)]
    in_whole_chunks = sum(end <= cut for _, end in bounds) / len(bounds)
    assert len(got) / len(messages) == pytest.approx(in_whole_chunks, abs=1.5 / len(bounds))
    if len(got) == len(messages):
        assert losses == [], "cut in the summary behind the messages"
        assert bag.warnings == [f"cut.mcap: cut off in the summary at its end; all {len(got)} messages were read"]
        return
    (loss,) = losses
    assert loss.startswith(f"cut.mcap: cut off after {len(got)} messages")


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


def make(path, content):
    """A file, or a FIFO where there is no content."""
    os.mkfifo(path) if content is None else path.write_bytes(content)


NO_RECORDINGS = {  # a file's name and content (None: a FIFO), what is opened, and what is said
    "empty file": ("a.mcap", b"", "a.mcap", "a.mcap: the file is empty"),
    "wrong magic": ("a.mcap", b"hello, this is no recording", "a.mcap", "a.mcap: not a readable"),
    "wrong magic, no suffix": ("a", b"hello, this is no recording", "a", "a: not a readable"),
    "a graph": ("a.g2o", b"VERTEX_SE2 0 0 0 0", "a.g2o", "(a graph: graph_slam optimize)"),
    "wrong magic in db3": ("a.db3", b"hello, world" * 100, "a.db3", "a.db3: not a readable"),
    "wrong magic in bag": ("a.bag", b"hello, world" * 100, "a.bag", "a.bag: not a readable"),
    "magic alone": ("a.mcap", b"\x89MCAP0\r\n", "a.mcap", "a.mcap: no topic in it"),
    "folder without recording": ("a", b"", "", "no recording"),
    "missing": ("b", b"", "a.mcap", "a.mcap: no such file or folder"),
    "fifo": ("a.mcap", None, "a.mcap", "a.mcap: neither a file nor a folder"),
    "folder with a fifo": ("a.mcap", None, "", "no recording"),
    "folder with an empty part": ("a.mcap", b"", "", "a.mcap: the file is empty"),
    "device": ("a", b"", "/dev/zero", "neither a file nor a folder"),
}


@each("kind", NO_RECORDINGS)
def test_F7_what_is_no_recording_is_refused_in_one_line(tmp_path, kind):
    name, content, opened, complaint = NO_RECORDINGS[kind]
    make(tmp_path / name, content)
    with pytest.raises(BagError, match=complaint) as caught:
        open_bag(tmp_path / opened)
    assert "\n" not in str(caught.value)


def replay_with(tmp_path, messages, definition_of=None, **options):
    """Replay an mcap file of these messages; of odometry with another definition."""
    if definition_of is not None:
        options["text"] = lambda name: definition_of if name == ODOMETRY else definition(name)
    file = write_mcap(tmp_path / "a.mcap", messages, **options)
    return replay(file, tmp_path / "run", odometry="/odom", landmarks="/landmarks")


def test_F11_F12_without_a_schema_or_in_another_encoding_the_refusal_says_so(tmp_path, messages):
    with pytest.raises(BagError, match="topic /odom: messages are encoded as 'json': record them in ROS"):
        replay_with(tmp_path, messages, encoding="json")
    with pytest.raises(BagError, match="/odom has no type: the recording lacks its schema"):
        replay_with(tmp_path, messages, schemas=False)
    with pytest.raises(BagError, match=r"no topic of type nav_msgs/msg/Odometry .* /odom \(no type\)"):
        choose_inputs(open_bag(tmp_path / "a.mcap"), Config())


def type_of_types(count, *fields):
    """Types that each have fields of the next one's type."""
    texts = [f"MSG: my/A{k}\n" + "".join(f"my/A{k + 1} {field}\n" for field in fields) for k in range(count)]
    return ("=" * 80 + "\n").join(["my/A0 first\n" + WHOLE, *texts, f"MSG: my/A{count}\nint8 last\n"])


WHOLE, CHILD = definition(ODOMETRY), "string child_frame_id\n"
SCHEMAS = [
    (WHOLE.replace(CHILD, ""), "nav_msgs/msg/Odometry of this recording has no field 'child_frame_id'"),
    (WHOLE.replace("float64[36] covariance\n", "float64[36] spread\n"), "has no field 'covariance'"),
    (WHOLE.replace("float64 w\n", ""), "geometry_msgs/msg/Quaternion of this recording has no field 'w'"),
    (WHOLE.replace("uint32 nanosec", "uint64 nanosec"), "'nanosec' of builtin_interfaces/msg/Time has another type"),
    (WHOLE.replace(CHILD, "int32 child_frame_id\n"), "field 'child_frame_id' of nav_msgs/msg/Odometry has another"),
    (WHOLE.replace(CHILD, "= ] [ =\n"), "the recorded definition of nav_msgs/msg/Odometry is not"),
    ("\n" * 2_000_000 + WHOLE, "the recorded .* is longer than 65536 bytes"),
    ("geometry_msgs/Pose[1000000000] poses\n" + WHOLE, "the recorded .* has more than 10000 values"),
    (WHOLE.replace(CHILD, f"{CHILD}nav_msgs/Odometry again\n"), "the recorded .* has more than 10000 values"),
    (type_of_types(40, "left", "right"), "the recorded .* has more than 10000 values"),
]


@each("text, complaint", SCHEMAS)
def test_F11_a_schema_that_lacks_what_we_need_or_never_ends_is_refused_and_nothing_is_touched(
    tmp_path, messages, text, complaint
):
    with pytest.raises(BagError, match=f"topic /odom: .*{complaint}"):
        replay_with(tmp_path, messages, text)
    assert not (tmp_path / "run").exists()


def test_F11_a_schema_with_more_fields_is_decoded_by_itself_and_one_without_text_by_ours(tmp_path, messages, reference):
    text = WHOLE.replace(CHILD, f"{CHILD}int8[] extra\nint64 more\n")
    theirs = get_typestore(Stores.EMPTY)
    theirs.register({**typestore().fielddefs, **get_types_from_msg(text, ODOMETRY)})
    longer = []
    for m in messages:
        if m.topic == "/odom":
            ours = typestore().deserialize_cdr(m.cdr, ODOMETRY)
            fields = {name: getattr(ours, name) for name in ("header", "child_frame_id", "pose", "twist")}
            message = theirs.types[ODOMETRY](extra=np.array([1, 2, 3], dtype=np.int8), more=7, **fields)
            m = replace(m, cdr=bytes(theirs.serialize_cdr(message, ODOMETRY)))
        longer.append(m)
    assert replay_with(tmp_path, longer, text).summary["counters"] == {}
    assert (tmp_path / "run" / "graph.g2o").read_bytes() == reference["graph.g2o"]
    shutil.rmtree(tmp_path / "run")
    replay_with(tmp_path, messages, text=lambda name: "")
    assert (tmp_path / "run" / "graph.g2o").read_bytes() == reference["graph.g2o"]


def test_F12_big_endian_messages_are_read(messages):
    decode = recorded_decoder(Topic("/odom", ODOMETRY, 1))
    m = next(m for m in messages if m.topic == "/odom")
    ours = typestore().deserialize_cdr(m.cdr, ODOMETRY)
    big = bytes(typestore().serialize_cdr(ours, ODOMETRY, little_endian=False))
    assert struct.unpack_from(">i", big, 4)[0] == ours.header.stamp.sec
    assert decode(big).pose.pose == ours.pose.pose


def head_of_chunk(file, number):
    """Where a chunk's record begins: its opcode; 9 bytes on its fields."""
    codec = {b"\0" * 4: 0, b"\4\0\0\0zstd": 4, b"\3\0\0\0lz4": 3}
    first = chunks(file)[number][0]
    data = file.read_bytes()
    return next(first - 49 - size for text, size in codec.items() if data[first - 8 - size - 4 : first - 8] == text)


@each("offset", [0, 1, 8, 25, 37, 41, 45])
@each("summary", [True, False])
def test_F3_a_damaged_head_of_a_chunk_costs_that_chunk_alone(tmp_path, messages, offset, summary):
    """Its opcode, length, size, checksum, codec, the length of its data: after each the next chunk is found again."""
    options = {} if summary else {"use_summary_offsets": False, "use_statistics": False, "repeat_channels": False}
    file = write_mcap(tmp_path / "a.mcap", messages, compression=CompressionType.ZSTD, chunk_size=20_000, **options)
    number = len(chunks(file)) // 2
    data = bytearray(file.read_bytes())
    data[head_of_chunk(file, number) + offset] ^= 0x40
    file.write_bytes(data)
    got, losses = read(file)
    assert got == [m for m in messages if m in got]
    assert 0 < len(messages) - len(got) < 3 * len(messages) / (sum(len(m.cdr) for m in messages) // 20_000)
    assert losses or (offset == 0 and not summary), "a record of an unknown kind is passed over, as the format says"
    assert all("bytes" in loss or "messages could not be read" in loss for loss in losses)


def test_F3_of_a_damaged_recording_without_checksums_one_is_warned(tmp_path, messages, capsys):
    bare = CONTAINERS["mcap by rosbags"](tmp_path, messages)
    checked = write_mcap(tmp_path / "a.mcap", messages)
    loose = write_mcap(tmp_path / "b.mcap", messages, use_chunking=False)
    summed = write_mcap(tmp_path / "c.mcap", messages, use_chunking=False, enable_data_crcs=True)
    for file, has_none in ((bare, True), (checked, False), (loose, True), (summed, False)):
        bag = open_bag(file)
        assert len(list(bag.messages(TOPICS))) == len(messages)
        assert bag.warnings == [], "rosbag2 writes none: of a file that reads well there is nothing to say"
        whole = file / "bag.mcap" if file.is_dir() else file
        intact = whole.read_bytes()
        data = bytearray(intact)
        if file in (loose, summed):
            data[data.index(messages[40].cdr) - 31] = 0x70  # a kind of record that nobody knows is passed over
        else:
            data[len(data) // 2 : len(data) // 2 + 2000] = b"\xff" * 2000
        whole.write_bytes(data)
        bag = open_bag(file)
        assert len(list(bag.messages(TOPICS))) < len(messages)
        assert bag.losses
        assert [("carries no checksums" in warning) for warning in bag.warnings] == [True] * has_none
    data = bytearray(intact)
    data[data.index(messages[40].cdr) + 60] ^= 1
    summed.write_bytes(data)
    got, losses = read(summed)
    assert (len(got), losses) == (len(messages), ["c.mcap: damaged: its data do not agree with their checksum"])
    assert main(["info", str(bare)]) == 3
    assert "graph_slam: beware: bag.mcap: carries no checksums" in capsys.readouterr().err


def read_of(file):
    """Also where not even a topic is left."""
    try:
        return read(file)
    except BagError as error:
        return [], [str(error)]


PACKED = [("a.mcap.gz", "gzip", gzip), ("a.bag", "gzip", gzip), ("a.db3.zstd", "zstd", zstandard)]
PACKED += [("a.mcap.bz2", "bzip2", bz2), ("a.lz4", "lz4", lz4.frame)]


@each("name, codec, library", PACKED)
def test_F5_a_file_that_is_compressed_as_a_whole_is_refused_and_the_codec_named(
    tmp_path, recorded, name, codec, library
):
    (tmp_path / name).write_bytes(library.compress(recorded.read_bytes()))
    said = f"{name}: the whole file is compressed with {codec}: unpack it first: {codec} -dc <"
    with pytest.raises(BagError, match=said):
        open_bag(tmp_path / name)


ZEROS = bytes(64 * 2**20)  # 64 MiB of nothing


def huge_frame():
    """A zstd frame that says to be 2^60 bytes: the frame's head with a content size of eight bytes."""
    return b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2**60) + zstandard.compress(b"x" * 50)[6:]


def test_F6_a_bomb_in_an_mcap_chunk_is_passed_over_and_nothing_is_allocated_for_it(tmp_path, messages):
    zstd, lz4s = zstandard.compress, lz4.frame.compress
    bombs = [  # in the second chunk, the third, ...: codec, data, the size it says, and what is said of it
        ("zstd", zstd(ZEROS), 2**29, "536870912 bytes; 268435456 is the limit"),
        ("lz4", lz4s(b"x"), 2**60, f"{2**60} bytes; 268435456 is the limit"),
        ("zstd", zstd(ZEROS), len(ZEROS), "1000 to 1 is the limit"),
        ("zstd", zstd(ZEROS), 1000, "says to be 1000 bytes and is more"),
        ("lz4", lz4s(ZEROS), 1001, "says to be 1001 bytes and is more"),
        ("zstd", zstd(b"x" * 500), 1002, "says to be 1002 bytes and is 500"),
        ("zstd", huge_frame(), 1003, "says to be 1003 bytes|zstd: "),
    ]
    file = write_mcap(tmp_path / "a.mcap", messages, chunk_size=8_000)
    with file.open("rb") as stream:
        records = [
            r for r in StreamReader(stream, emit_chunks=True).records if not isinstance(r, Footer | SummaryOffset)
        ]
    whole = [record for record in records if isinstance(record, Chunk)]
    for chunk, (codec, data, size, _) in zip(whole[1:], bombs, strict=False):
        chunk.compression, chunk.data, chunk.uncompressed_size, chunk.uncompressed_crc = codec, data, size, 0
    out = RecordBuilder()
    out.write(mcap_records.MAGIC)
    for record in [*records, Footer(summary_start=0, summary_offset_start=0, summary_crc=0)]:
        record.write(out)
    out.write(mcap_records.MAGIC)
    file.write_bytes(out.end())
    got, losses = confined(read, file, mib=64)
    assert 0 < len(got) < len(messages)
    assert [said for *_, said in bombs if not re.search(said, "; ".join(losses))] == []


@each("codec, said", [("bz2", 1000), ("lz4", 2**31), ("lz4", len(ZEROS))])
def test_F6_a_bomb_in_a_ros_1_chunk_is_passed_over_and_nothing_is_allocated_for_it(tmp_path, messages, codec, said):
    file = to_ros1(tmp_path / "a.bag", messages)
    pack = {"bz2": bz2.compress, "lz4": lz4.frame.compress}[codec]
    chunk = ros1_record(pack(ZEROS), op=b"\5", compression=codec.encode(), size=struct.pack("<I", said))
    at = 13 + 4096  # after the magic and the bag's own record
    data = file.read_bytes()
    file.write_bytes(data[:at] + chunk + data[at:])
    got, losses = confined(read, file, mib=64)
    assert got == messages
    assert "a damaged chunk" in losses[0]


def test_F6_a_bomb_in_a_message_of_rosbag2_is_passed_over(tmp_path, messages):
    bombs = [zstandard.compress(ZEROS), huge_frame()]
    spoiled = [replace(messages[k], cdr=bombs[k - 5]) if k in (5, 6) else messages[k] for k in range(len(messages))]
    got, losses = confined(read, to_sqlite(tmp_path / "bag", spoiled), mib=64)
    assert got == messages[:5] + messages[7:]
    assert len(losses) == 2
    assert all("was passed over (it says to be" in loss for loss in losses)


def ros1_record(data, **fields):
    parts = [name.encode() + b"=" + value for name, value in fields.items()]
    header = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


@each("length", [2**31, 2**64 - 1])
def test_F19_a_length_that_cannot_be_is_refused_before_anything_is_allocated(tmp_path, messages, length):
    """Of a record, the data of a chunk, the first record, the summary."""
    whole = write_mcap(tmp_path / "a.mcap", messages, chunk_size=20_000)
    data = whole.read_bytes()
    for place in (head_of_chunk(whole, 1) + 1, chunks(whole)[1][0] - 8, 9, len(data) - 28):
        whole.write_bytes(data[:place] + struct.pack("<Q", length) + data[place + 8 :])
        got, losses = confined(read_of, whole, mib=64)
        assert losses or got == messages
        assert len(got) >= len(messages) // 2 or place == 9


@each("fraction", [0.02, 0.3, 0.6, 0.95])
def test_F9_a_sqlite3_file_that_is_cut_is_read_up_to_there(tmp_path, messages, fraction):
    folder = to_sqlite(tmp_path / "bag", messages)
    (file,) = folder.glob("*.db3")
    data = file.read_bytes()
    file.write_bytes(data[: int(fraction * len(data))])
    got, losses = read_of(folder)
    assert got == messages[: len(got)]
    assert len(got) >= 0.7 * fraction * len(messages) or fraction < 0.1
    if got:
        counted = {name: topic.count for name, topic in open_bag(folder).topics.items() if topic.count}
        expected = Counter(m.topic for m in got)
        assert counted.keys() == expected.keys(), "info chooses among topics that have messages"
        assert sum(counted.values()) - len(got) in (0, 1), "of the last one the end may be lost"
        rare = min(expected, key=expected.__getitem__)
        assert list(open_bag(folder).messages({rare})) == [m for m in got if m.topic == rare]
    assert losses
    assert all("\n" not in loss for loss in losses)


def test_F9_a_damaged_page_is_told_and_what_is_before_it_is_read(tmp_path, messages):
    folder = to_sqlite(tmp_path / "bag", messages)
    (file,) = folder.glob("*.db3")
    data = bytearray(file.read_bytes())
    size = struct.unpack_from(">H", data, 16)[0]
    for page in range(1, len(data) // size, 3):
        spoiled = data.copy()
        spoiled[page * size : page * size + 100] = b"\xff" * 100
        file.write_bytes(spoiled)
        got, losses = read_of(folder)
        assert losses or len(got) == len(messages)
        assert [(m.topic, m.log_ns) for m in got] == [(m.topic, m.log_ns) for m in messages[: len(got)]]


def test_F9_what_is_still_in_the_log_of_writes_is_read_too_and_the_files_stay_as_they_are(tmp_path, messages):
    folder = to_sqlite(tmp_path / "bag", messages)
    (file,) = folder.glob("*.db3")
    with closing(sqlite3.connect(file)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("UPDATE messages SET timestamp = timestamp + 1")
        database.commit()
        copy = tmp_path / "copy"
        shutil.copytree(folder, copy)  # as a recorder that was killed leaves it
    (copied,) = copy.glob("*.db3")
    before = copied.read_bytes()
    assert (copy / f"{copied.name}-wal").stat().st_size
    assert read(copy) == ([replace(m, log_ns=m.log_ns + 1) for m in messages], [])
    assert copied.read_bytes() == before


@each("fraction", [0.3, 0.7, 0.9, 0.99])
def test_F10_a_ros_1_bag_without_index_is_read_up_to_where_it_is_cut(tmp_path, messages, fraction):
    file = to_ros1(tmp_path / "a.bag", messages, chunk_bytes=8_000)
    data = file.read_bytes()
    active = tmp_path / "drive.bag.active"
    active.write_bytes(data[: int(fraction * len(data))])
    got, losses = read(tmp_path / "drive.bag.active")
    assert got == messages[: len(got)]
    assert len(got) > 0.6 * fraction * len(messages)
    assert len(losses) == (len(got) < len(messages) or fraction < 1)
    assert losses[0].startswith(f"drive.bag.active: cut off after {len(got)} messages, ")


def test_F10_a_damaged_chunk_of_a_ros_1_bag_is_passed_over(tmp_path, messages):
    file = to_ros1(tmp_path / "a.bag", messages, Ros1Writer.CompressionFormat.BZ2, chunk_bytes=8_000)
    data = bytearray(file.read_bytes())
    places = [found.end() for found in re.finditer(b"BZh9", data)]
    data[places[2] + 40] ^= 1
    file.write_bytes(data)
    got, losses = read(file)
    assert 0 < len(messages) - len(got) < 2 * len(messages) / len(places)
    assert len(losses) == 1 and "a damaged chunk" in losses[0]


def test_F13_messages_that_were_written_out_of_order_are_put_in_order_and_ties_stay_as_they_were(tmp_path, messages):
    """Of one time they stay as they came: numbers of channels are the recorder's, and many write no sequence."""
    rng = np.random.default_rng(3)
    shuffled = [messages[k] for k in np.argsort(np.arange(len(messages)) + rng.uniform(0, 30, len(messages)))]
    same = [replace(m, log_ns=m.log_ns // 10**9 * 10**9) for m in shuffled]
    ordered = sorted(same, key=lambda m: m.log_ns)
    assert same != ordered
    for container in (lambda folder: write_mcap(folder / "a.mcap", same), lambda folder: to_sqlite(folder / "b", same)):
        assert read(container(tmp_path)) == (ordered, [])
    got, losses = read(write_mcap(tmp_path / "c.mcap", shuffled))
    assert (sorted(got, key=messages.index), losses) == (messages, [])
    assert [m.log_ns for m in got] == sorted(m.log_ns for m in messages)


def test_F14_a_recording_larger_than_memory_is_streamed(tmp_path):
    """768 MiB, in chunks of 4 MiB, with a quarter of that to spare."""
    file = tmp_path / "large.mcap"
    payload = np.random.default_rng(0).bytes(2**14) * 16
    with file.open("wb") as stream:
        writer = Writer(stream, chunk_size=2**22, compression=CompressionType.ZSTD)
        writer.start()
        channel = writer.register_channel("/scan", "cdr", 0)
        for k in range(768 * 4):
            writer.add_message(channel, k, payload, k, k)
        writer.finish()
    assert file.stat().st_size < 16 * 2**20
    assert confined(count_of, file, mib=192) == (3072, 3072 * len(payload), [])


def count_of(path):
    bag, count, size = open_bag(path), 0, 0
    for message in bag.messages(set(bag.topics)):
        count, size = count + 1, size + len(message.cdr)
    return count, size, bag.losses


def test_F14_of_many_parts_few_are_open_at_once(tmp_path, messages):
    for k in range(0, len(messages), 2):
        write_mcap(tmp_path / f"drive_{k // 2}.mcap", messages[k : k + 2])
    parts = len(list(tmp_path.glob("*.mcap")))
    assert parts > 60
    got, losses = confined(with_few_descriptors, tmp_path)
    assert (got, losses) == (messages, [])


def with_few_descriptors(path):
    most = len(os.listdir("/proc/self/fd")) + 10
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    return read(path)


def refused(tmp_path, text, complaint):
    file = tmp_path / "parameters.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=rf"parameters\.yaml: {complaint}"):
        read_parameters(file)


@each(
    "text, hint",
    [
        ("0123", "0123 is 83 to YAML: write 83, or '0123' for a text"),
        ("12:30:45", "12:30:45 is 45045 to YAML: write 45045, or '12:30:45' for a text"),
        ("1:30.5", "1:30.5 is 90.5 to YAML"),
        ("1_000", "1_000 is 1000 to YAML"),
        ("0b11", "0b11 is 3 to YAML"),
        ("yes", "yes is true to YAML: write true, or 'yes' for a text"),
        ("Off", "Off is false to YAML: write false, or 'Off' for a text"),
    ],
)
def test_F29_what_yaml_reads_in_its_own_way_is_refused_with_a_hint(tmp_path, text, hint):
    refused(tmp_path, f"tf:\n  stamp: {text}\n", f"line 2: {re.escape(hint)}")
    with pytest.raises(ConfigError, match=re.escape(f"tf.stamp: {hint}")):
        parse_setting(f"tf.stamp={text}")
    texts = {"1e5": 1e5, "-2.5E-3": -0.0025, ".5": 0.5, "-7": -7, "0x1f": 31, "false": False, f"'{text}'": text}
    (tmp_path / "good.yaml").write_text("".join(f"k{k}: {one}\n" for k, one in enumerate(texts)))
    assert [(v, type(v)) for v in read_parameters(tmp_path / "good.yaml").values()] == [
        (v, type(v)) for v in texts.values()
    ]


BILLION_LAUGHS = "a: &a [x, x]\n" + "".join(f"{b}: &{b} [*{a}, *{a}]\n" for a, b in itertools.pairwise("abcdefghij"))
HOSTILE = {
    "a key twice": ("tf:\n  stamp: now\n  stamp: now\n", "line 3: 'stamp' is given twice"),
    "python/object": ("tf: !!python/object/apply:os.system [id]", "line 1: the tag .*python/object.* is not read"),
    "tag that cannot be": ("tf: !!int ''", "line 1: the tag tag:yaml.org,2002:int is not read"),
    "alias bomb": (BILLION_LAUGHS, "line 2: aliases are not read"),
    "alias of itself": ("a: &a [*a]", "line 1: aliases are not read"),
    "merge": ("a: &a {x: 1}\nb: {<<: *a}\n", "line 2: aliases are not read"),
    "nested lists": ("[" * 5000, "line 1: more than 50 levels"),
    "nested blocks": ("- " * 3000, "line 1: more than 50 levels"),
    "nested maps": ("{a: " * 3000, "line 1: more than 50 levels"),
    "many values": ("a: [" + "1," * 500_000 + "]", "line 1: more than 50 levels, or than 20000 values"),
    "large": ("#" * 2**20 + "#", "larger than 1048576 bytes"),
}


@each("name", HOSTILE)
def test_F30_F31_hostile_yaml_is_refused_at_once(tmp_path, name):
    refused(tmp_path, *HOSTILE[name])


def test_F31_what_is_no_file_of_parameters_is_refused_and_not_waited_for(tmp_path):
    make(tmp_path / "fifo.yaml", None)
    for path, why in (
        (tmp_path / "fifo.yaml", "a FIFO, socket or device, not a regular file"),
        (tmp_path, "a folder, not a regular file"),
        (tmp_path / "none", "No such"),
    ):
        with pytest.raises(ConfigError, match=f"{re.escape(str(path))}: {why}"):
            read_parameters(path)


@each("content", [pickle.dumps({"tf": 1}), b"\x93NUMPY\x01\x00v\x00{'descr': '|O'}"])
def test_F32_pickles_and_arrays_of_objects_are_no_file_of_ours(tmp_path, content):
    for name, read_it in (("a.yaml", read_parameters), ("a.g2o", read_g2o), ("a.mcap", open_bag)):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(GraphSlamError, match=re.escape(name)):
            read_it(tmp_path / name)


GRAPH = """\
# two poses and a landmark
VERTEX_SE2 10 0 0 0
VERTEX_SE2 11 1.5 -2e-3 .25
VERTEX_XY 7 3. +4
EDGE_SE2 10 11 1 0 0.1 10 1 -2 20 3 30
"""


def graph_of(folder, text, **options):
    file = folder / "graph.g2o"
    file.write_text(text, encoding="utf-8")
    return read_g2o(file, **options)


BAD_LINES = {
    "VERTEX_SE2 12 1 2": "VERTEX_SE2 needs 4 fields after the tag, found 3",
    "EDGE_SE2 10 7 1 0 0.1 10 1 -2 20 3 30": "EDGE_SE2 to vertex 7, which is a VERTEX_XY",
    "EDGE_SE2 11 11 1 0 0.1 10 1 -2 20 3 30": "edge from vertex 11 to itself",
    "FIX": "FIX names no vertex",
    "VERTEX_SE2 11 1.5 -2e-3 .26": "vertex 11 was declared before, with other values",  # F21
    # F23: no plain finite number, no id
    **{f"VERTEX_SE2 12 1 2 {w}": f"'{w}' is not a finite number" for w in ("nan", "inf", "-Infinity", "1e999", "1_0")},
    **{f"VERTEX_SE2 12 {w} 2 3": f"'{w}' is not a finite number" for w in ("\u0661", "0x10", "1,5", ".")},
    **{f"VERTEX_SE2 {w} 1 2 3": f"'{w}' is not an id" for w in ("1.0", "\u0661", "1_0", "9" * 20)},
    "EDGE_SE2 10 12 1 0 0.1 10 1 -2 20 3 30": "edge to vertex 12, which is not declared (--lenient leaves it out)",
    "FIX 12": "FIX names vertex 12, which is not declared",  # F24, as the line before
    "EDGE_SE2 10 11 1 0 0.1 0 0 0 0 0 0": "information is not positive definite",  # F25: no information, no turn
    "VERTEX_SE3:QUAT 12 0 0 0 0 0 0 0": "the quaternion is zero",
}


@each("line, why", BAD_LINES.items())
def test_F20_to_F25_a_bad_line_is_named_and_in_lenient_reading_left_out(tmp_path, line, why):
    text = f"{GRAPH}{line}\nFIX 11\n"
    with pytest.raises(FormatError) as refusal:
        graph_of(tmp_path, text)
    assert str(refusal.value).startswith(f"graph.g2o:{len(GRAPH.splitlines()) + 1}: ")
    assert why in str(refusal.value)
    assert "\n" not in str(refusal.value)
    file = graph_of(tmp_path, text, lenient=True)
    assert (file.ids[:3], file.graph.edge_count, file.fixed) == ([10, 11, 7], 1, [1])
    assert file.graph.initial.values[3:6].tolist() == [1.5, -2e-3, 0.25]
    assert file.skipped == [str(refusal.value)]


def test_F22_unknown_tags_are_counted_and_told_once_each_and_written_back(tmp_path, capsys):
    odd = ["WHAT 1", "EDGE_SE2_LOTSOFXY 10 7  0.5 1e3", "WHAT nan inf 1_0"]
    (tmp_path / "a.g2o").write_text("\n".join([odd[0], GRAPH + odd[1], odd[2], "EDGE_SE2_XY 10 7 1 2 1 0 1\n"]))
    assert main(["optimize", str(tmp_path / "a.g2o"), "--out", str(tmp_path / "b.g2o")]) == 3
    said = capsys.readouterr().err.splitlines()
    assert [line.split(":")[2] for line in said] == [" 2 WHAT", " 1 EDGE_SE2_LOTSOFXY"]
    lines = (tmp_path / "b.g2o").read_text().splitlines()
    assert [line for line in lines if line in odd] == odd


def test_F26_without_fix_the_pose_of_the_least_id_is_held(tmp_path):
    text = GRAPH.replace("VERTEX_XY 7 3. +4\n", "VERTEX_SE2 5 9 8 0.5\n") + "EDGE_SE2 11 5 1 0 0 1 0 0 1 0 1\n"
    solved = optimize(graph_of(tmp_path, text))
    assert solved.file.ids == [10, 11, 5]
    assert solved.solver.estimate([2]).tolist() == [[9.0, 8.0, 0.5]]
    assert solved.report.chi2_final < 1e-12
