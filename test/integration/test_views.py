"""The layouts for RViz and Foxglove show what the node publishes, by its names, types and durability."""

import dataclasses
import json
import re

import pytest
import yaml
from places import ROOT
from rows import each

from graph_slam_ros.config.pipeline import FramesConfig
from graph_slam_ros.messages.topics import PUBLICATIONS, SUBSCRIPTIONS
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam.solution import Correction
from graph_slam_ros.tools.simulation import simulate, write_bag

CONFIG = ROOT / "config"
RVIZ = yaml.safe_load((CONFIG / "graph_slam.rviz").read_text())["Visualization Manager"]
FOXGLOVE = json.loads((CONFIG / "foxglove_layout.json").read_text())
PUBLISHED = {one.resolved(): one for one in PUBLICATIONS}
SHOWN_BY = {
    "Path": "nav_msgs/msg/Path",
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "Odometry": "nav_msgs/msg/Odometry",
}
DISPLAYS = {d["Name"]: d for d in RVIZ["Displays"] if "Topic" in d}


@each("name", DISPLAYS)
def test_a_display_of_rviz_connects_to_what_the_node_publishes(name):
    display, topic = DISPLAYS[name], DISPLAYS[name]["Topic"]
    assert not topic["Value"].startswith(("/", "~")), "relative: it follows RViz into a namespace"
    published = PUBLISHED[f"/{topic['Value']}"]
    assert SHOWN_BY[display["Class"].removeprefix("rviz_default_plugins/")] == published.type
    assert (topic["Durability Policy"] == "Transient Local") == published.latched
    assert not published.latched or topic["Reliability Policy"] == "Reliable"


def test_rviz_shows_path_pose_landmarks_graph_frames_and_a_grid_in_the_map_frame():
    shown = {d["Class"].removeprefix("rviz_default_plugins/") for d in RVIZ["Displays"] if d["Enabled"]}
    assert shown == {"Grid", "TF", "Path", "PoseWithCovariance", "MarkerArray"}
    assert [d["Topic"]["Value"] for d in DISPLAYS.values() if d["Class"].endswith("MarkerArray")] == [
        "graph_slam/graph",
        "graph_slam/landmarks",
    ]
    assert RVIZ["Global Options"]["Fixed Frame"] == FramesConfig().map
    (tool,) = (t for t in RVIZ["Tools"] if t["Class"].endswith("SetInitialPose"))
    assert tool["Topic"]["Value"] in {one.name for one in SUBSCRIPTIONS}


def panels(kind):
    return [config for name, config in FOXGLOVE["configById"].items() if name.startswith(f"{kind}!")]


def test_every_topic_of_foxglove_is_the_nodes_or_of_a_runs_recording(tmp_path):
    write_bag(simulate("pythonrobotics", 1, poses=5), tmp_path / "bag.mcap")
    replay(tmp_path / "bag.mcap", tmp_path / "run")
    recorded = open_bag(tmp_path / "run" / "run.mcap").topics
    (scene,) = panels("3D")
    assert set(scene["topics"]) <= set(PUBLISHED) | set(recorded)
    assert {"/graph_slam/path", "/graph_slam/pose", "/graph_slam/landmarks", "/graph_slam/graph"} <= set(
        scene["topics"]
    )
    assert set(recorded) - {"/tf"} <= set(scene["topics"])
    assert scene["publish"]["poseEstimateTopic"] == "/initialpose"
    for panel in panels("DiagnosticSummary"):
        assert PUBLISHED[panel["topicToRender"]].type == "diagnostic_msgs/msg/DiagnosticArray"
    for panel in panels("Plot"):
        for path in panel["paths"]:
            assert re.match(r"/[\w/]+", path["value"])[0] in PUBLISHED


def test_what_foxglove_plots_is_among_the_nodes_diagnostics():
    diagnostics = pytest.importorskip("graph_slam_ros.node.diagnostics")
    unseen = pytest.importorskip("graph_slam_ros.node.estimate").UnseenWay(0, 0)
    given = {field.name: 0 for field in dataclasses.fields(diagnostics.Estimate)}
    estimate = diagnostics.Estimate(**given | {"correction": Correction(), "unseen": unseen})
    facts = diagnostics.Facts("active", estimate=estimate)
    told = {
        status.name: set(status.values)
        for status in diagnostics.statuses(facts, diagnostics.Health("OK"), "graph_slam")
    }
    plotted = [path["value"] for panel in panels("Plot") for path in panel["paths"] if "diagnostics" in path["value"]]
    assert len(plotted) == 2
    for path in plotted:
        name, key = re.findall(r'=="(.+?)"', path)
        assert key in told[name]
