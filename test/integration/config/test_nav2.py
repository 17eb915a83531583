"""The worked example with Nav2: its parameters are read strictly, fit each other, and put a drive on its floor plan."""

import re

import numpy as np
import pytest
import yaml
from places import ROOT

from graph_slam_ros.formats.parameters import read_parameters
from graph_slam_ros.lie import se2
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.simulation import simulate, write_bag

TEXT = (ROOT / "docs" / "nav2.md").read_text()
SECTIONS = {
    node: section["ros__parameters"]
    for node, section in yaml.safe_load((ROOT / "config" / "nav2.yaml").read_text()).items()
}


@pytest.fixture(scope="module")
def config():
    """As `graph_slam replay --config` reads it."""
    return Config.from_mapping(read_parameters(ROOT / "config" / "nav2.yaml"))


def test_P14_the_nodes_of_the_example_fit_each_other(config):
    manager = SECTIONS["lifecycle_manager_localization"]
    assert set(SECTIONS) == {"map_server", "graph_slam", "lifecycle_manager_localization"}
    assert set(manager["node_names"]) == set(SECTIONS) - {"lifecycle_manager_localization"}
    assert manager["autostart"]
    assert "bond_timeout" not in manager, "the node keeps the bond"
    assert not config.node.autostart
    assert config.tf.publish_tf
    assert config.frames.map == SECTIONS["map_server"]["frame_id"]
    assert len(config.survey) == 10
    assert config.start_pose == (0.0, -2.0, 1.57)


def test_what_the_page_says_is_in_the_example_is(config):
    (survey,) = re.findall(r"```csv\n(.*?)```", TEXT, re.DOTALL)
    assert survey in config.landmarks.surveyed
    for key in re.findall(r"`((?:anchor|tf|landmarks|node)\.\w+)`", TEXT):
        assert key in {f"{section}.{name}" for section, names in config.as_mapping().items() for name in names}
    for node in ("map_server", "lifecycle_manager_localization"):
        assert f"`{node}`" in TEXT


def test_a_drive_lies_on_the_plan_without_being_aligned(config, tmp_path):
    recording = simulate("warehouse", 7)
    write_bag(recording, tmp_path / "drive.mcap")
    done = replay(tmp_path / "drive.mcap", tmp_path / "run", config)
    at = np.searchsorted(recording.stamps_ns, done.slam.view.keyframes.stamps_ns)
    off = done.slam.view.trajectory() - recording.T_world_base[at]
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.15
    assert np.abs(se2.wrap(off[:, 2])).max() < 0.05
    surveyed = done.summary["classes"]["surveyed"]
    assert surveyed["edges"] == len(config.survey)
    assert surveyed["chi2"] < 40.0  # of 20 numbers
    assert len(done.slam.view.landmarks) > 2 * len(config.survey)
    for name, landmark in done.slam.view.landmarks.items():
        found = done.slam.view.solver.estimate([landmark.vertex])[0]
        assert found[:2] == pytest.approx(recording.landmarks[name][:2], abs=0.15), "surveyed or not"
