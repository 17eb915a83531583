"""Recordings: what is read of them, and what is written."""

import gzip

import pytest
import yaml
from recordings import ODOMETRY, TOPICS, read, short_drive, to_sqlite, write_mcap

from graph_slam_ros.overview.chosen_inputs import choose_inputs
from graph_slam_ros.recordings.bag import BagError, BagWriter, open_bag
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.simulation import simulate, write_bag


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return short_drive(tmp_path_factory.mktemp("bag") / "drive.mcap")


@pytest.fixture(scope="module")
def messages(recorded):
    return list(open_bag(recorded).messages(TOPICS))


def test_a_recording_may_be_a_folder_of_parts_in_natural_order(tmp_path, messages):
    size = len(messages) // 11
    for k in range(12):
        write_mcap(tmp_path / f"drive_{k}.mcap", messages[k * size : (k + 1) * size if k < 11 else None])
    (tmp_path / "metadata.yaml").write_text("not read")
    assert read(tmp_path) == (messages, [])


def test_of_a_folder_the_files_are_read_that_its_metadata_name(tmp_path, messages):
    half, names = len(messages) // 2, ["bag_0.mcap", "bag_1.mcap.zstd", "bag_2.mcap"]
    write_mcap(tmp_path / "bag_0.mcap", messages[:half])
    write_mcap(tmp_path / "bag_1.mcap", messages[half:])  # it was unpacked
    write_mcap(tmp_path / "bag_0_copy.mcap", messages[:half])
    metadata = {"rosbag2_bagfile_information": {"relative_file_paths": names}}
    (tmp_path / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    bag = open_bag(tmp_path)
    assert list(bag.messages(TOPICS)) == messages
    assert bag.losses == [f"{tmp_path / 'bag_2.mcap'}: not there, though metadata.yaml names it"]
    assert len(bag.warnings) == 1
    assert bag.warnings[0].startswith(f"{tmp_path / 'bag_0_copy.mcap'}: not read, as metadata.yaml does not name it")
    for content in (
        "rosbag2_bagfile_information: {relative_file_paths: [other.mcap]}",
        "[",
        "a: *b",
        "{}",
        "a: 2026-99-99",
    ):
        (tmp_path / "metadata.yaml").write_text(content)
        assert sum(topic.count for topic in open_bag(tmp_path).topics.values()) == len(messages) + half


def test_one_of_several_odometry_topics_must_be_chosen_unless_one_has_the_usual_name(tmp_path, messages):
    some = [type(m)(f"/{who}/odom", m.log_ns, m.cdr) for m in messages if m.topic == "/odom" for who in ("a", "b")]
    names = {"/a/odom": ODOMETRY, "/b/odom": ODOMETRY}
    bag = open_bag(write_mcap(tmp_path / "a.mcap", some, types=names))
    with pytest.raises(BagError, match=r"several topics .* \(/a/odom, /b/odom\): choose one with --odom"):
        choose_inputs(bag, Config())
    assert choose_inputs(bag, Config(), "/b/odom").topics["odom"] == "/b/odom"
    usual = open_bag(write_mcap(tmp_path / "b.mcap", some + messages, types=names | TOPICS))
    assert choose_inputs(usual, Config()).topics["odom"] == "/odom"


@pytest.mark.parametrize(
    ("names", "is_warned"),
    [(("a_0.mcap", "a_1.mcap"), False), (("a.mcap", "b.mcap"), True), (("a.mcap", "b.mcap", "metadata.yaml"), False)],
)
def test_a_folder_of_files_with_different_names_is_one_recording_with_a_warning(names, is_warned, tmp_path):
    recording = simulate("pythonrobotics", seed=1)
    for name in names:
        write_bag(recording, tmp_path / name) if name.endswith(".mcap") else (tmp_path / name).write_text("")
    assert len([line for line in open_bag(tmp_path).warnings if "read as one recording" in line]) == is_warned


def test_a_recording_split_by_topic_is_read_in_order_of_time(tmp_path):
    whole = tmp_path / "whole.mcap"
    write_bag(simulate("warehouse", 3, aisles=2, laps=1, aisle_m=4.0), whole)
    bag, parts = open_bag(whole), tmp_path / "parts"
    parts.mkdir()
    for name, topic in (("a", "/landmarks"), ("b", "/odom")):
        with BagWriter(parts / f"{name}.mcap") as part:
            for message in bag.messages({topic}):
                part.write(topic, bag.topics[topic].type, message.log_ns, message.cdr)
    together, apart = (replay(source, tmp_path / f"{source.stem}_run") for source in (whole, parts))
    assert apart.slam.view.graph.edge_count == together.slam.view.graph.edge_count
    assert apart.summary["counters"] == together.summary["counters"]


@pytest.mark.parametrize("is_unpacked", [False, True])
def test_a_part_that_is_still_packed_is_a_loss_with_the_command_that_unpacks_it(tmp_path, messages, is_unpacked):
    half, folder = len(messages) // 2, tmp_path / "bag"
    folder.mkdir()
    for k, some in enumerate((messages[:half], messages[half:])):
        next(to_sqlite(tmp_path / f"part_{k}", some).glob("*.db3")).rename(folder / f"bag_{k}.db3")
    second = folder / "bag_1.db3"
    (folder / "bag_1.db3.zstd").write_bytes(gzip.compress(second.read_bytes()))
    if is_unpacked:
        assert open_bag(folder).losses == []
        return
    second.unlink()
    (loss,) = open_bag(folder).losses
    assert loss.startswith("bag_1.db3.zstd: not read: ")
    assert f"zstd -dc < {folder}/bag_1.db3.zstd > {second}" in loss
