"""Recordings with inputs of every kind, through replay and the command line."""

import re

import pytest
from messages import DATUM, LANDMARKS, STAMP_NS, odometry, pose, record_drive
from places import ROOT

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.formats.parameters import read_parameters
from graph_slam_ros.measurements.types import from_record
from graph_slam_ros.messages.inputs import CONVERTERS, uses
from graph_slam_ros.overview.chosen_inputs import choose_inputs
from graph_slam_ros.recordings.bag import BagError, BagWriter, open_bag
from graph_slam_ros.runs.journal import read_ingest
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.suggestion import Suggestion
from graph_slam_ros.slam import Config, Fix, Odometry, Sightings

TF = "tf2_msgs/msg/TFMessage"
EVERYTHING = {
    "inputs.names": "odom detections gps tags",
    "gps": {"topic": "/fix", "type": "sensor_msgs/msg/NavSatFix", "datum": " ".join(map(str, DATUM))},
    "tags": {"topic": "/tf", "type": TF, "use": "landmarks", "frame_prefix": "tag36h11:"},
}


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return record_drive(tmp_path_factory.mktemp("drive") / "drive.mcap", seconds=15)


def test_all_inputs_of_a_recording_are_used_together(drive, tmp_path):
    slam = replay(drive, tmp_path / "run", Config.from_mapping(EVERYTHING)).slam
    events = [from_record(record) for record in read_ingest(tmp_path / "run", [])]
    assert {m.source for m in events if isinstance(m, Odometry)} == {"odom"}
    counts = {}
    for m in events:
        if isinstance(m, Sightings | Fix):
            counts[m.topic] = counts.get(m.topic, 0) + 1
    assert counts == {"detections": 150, "gps": 15, "tags": 150}
    assert not slam.counters["detections", "frame_unknown"]
    for name, there in LANDMARKS.items():
        assert slam.view.solver.estimate([slam.view.landmarks[name].vertex])[0, :2] == pytest.approx(there, abs=0.05)


def test_an_input_without_its_topic_takes_the_only_one_of_its_type_and_else_is_refused(drive):
    bag = open_bag(drive)
    gps = {"inputs.names": "odom gps", "gps.type": "sensor_msgs/msg/NavSatFix"}
    assert choose_inputs(bag, Config.from_mapping(gps)).topics["gps"] == "/fix"
    with pytest.raises(BagError, match="no topic /gnss in the recording; of sensor_msgs/msg/NavSatFix there is /fix"):
        choose_inputs(bag, Config.from_mapping(gps | {"gps.topic": "gnss"}))
    with pytest.raises(BagError, match="no topic of type sensor_msgs/msg/Imu in the recording"):
        choose_inputs(bag, Config.from_mapping({"inputs.names": "odom imu", "imu.type": "sensor_msgs/msg/Imu"}))
    vo = {"inputs.names": "odom vo", "vo.type": "nav_msgs/msg/Odometry"}
    with pytest.raises(ConfigError, match=r"vo\.topic: /odom is odometry by odom already"):
        choose_inputs(bag, Config.from_mapping(vo))
    with pytest.raises(BagError, match="no input is used as landmarks: /landmarks cannot be one"):
        choose_inputs(bag, Config.from_mapping(gps), landmarks="/landmarks")


def test_the_page_of_inputs_has_a_row_for_every_type_with_what_it_becomes_and_its_example_is_one(tmp_path):
    page = (ROOT / "docs/inputs.md").read_text()
    rows = [line.split("|") for line in page.splitlines() if line.startswith("| ")]
    for type_name, there in CONVERTERS.items():
        package, _, name = type_name.split("/")
        becomes = [row[2] for row in rows if package in row[1] and re.search(rf"\b{name}\b", row[1])]
        assert len(becomes) == 1, f"docs/inputs.md has {len(becomes)} rows for {type_name}"
        told = dict.fromkeys(re.findall(r"\b(odometry|gyro|landmarks|fix|closure)\b", becomes[0]))
        assert [use for use in told if use in there] == list(there)
    assert f"| [{len(CONVERTERS)} message types](docs/inputs.md) |" in (ROOT / "README.md").read_text()
    configs = []
    for example in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL):
        whole = example if "ros__parameters" in example else f"/**:\n  ros__parameters:\n{example}"
        (tmp_path / "example.yaml").write_text(whole)
        configs.append(Config.from_mapping(read_parameters(tmp_path / "example.yaml")))
    assert uses(configs[0]) == {"odom": "odometry", "detections": "landmarks", "gps": "fix", "tags": "landmarks"}


def test_check_and_calibrate_read_the_topics_that_a_replay_reads(tmp_path):
    """A suggestion never comes before a topic that somebody has given."""
    path = tmp_path / "a.mcap"
    with BagWriter(path) as bag:
        for k in range(20):
            for topic in ("/odom", "/wheel/odom"):
                stamp_ns = STAMP_NS + k * 10**8
                bag.write(topic, "nav_msgs/msg/Odometry", stamp_ns, odometry(pose(0.1 * k), stamp_ns=stamp_ns))
    bag = open_bag(path)
    names = {"inputs.names": "wheels odom", "wheels.type": "nav_msgs/msg/Odometry", "wheels.topic": "wheel/odom"}
    for given in ({"odom.topic": "wheel/odom"}, {"odom.topic": "/wheel/odom"}, names | {"odom.topic": "/odom"}):
        suggested = Suggestion(bag, path, given=given)
        expected = choose_inputs(bag, Config.from_mapping(given)).topics
        assert suggested.inputs(Config.from_mapping(suggested.assumed | given)).topics == expected
    with pytest.raises(BagError, match="no topic /nothing"):
        Suggestion(bag, path, given={"odom.topic": "/nothing"}).inputs(Config.from_mapping({"odom.topic": "/nothing"}))


def test_transforms_in_the_namespace_of_the_robot_are_read_where_there_are_no_others(tmp_path):
    def topics(*names):
        path = tmp_path / f"{len(names)}.mcap"
        with BagWriter(path) as bag:
            for name in ("/robot1/odom", *names):
                type_name = "nav_msgs/msg/Odometry" if name.endswith("odom") else TF
                bag.write(name, type_name, STAMP_NS, odometry(pose(0.0)))
        return choose_inputs(open_bag(path), Config()).topics

    assert topics("/robot1/tf_static")["tf_static"] == "/robot1/tf_static"
    assert topics("/robot1/tf_static", "/tf_static")["tf_static"] == "/tf_static"
    assert "tf_static" not in topics("/robot2/tf_static", "/robot2/tf", "/robot3/tf_static")
