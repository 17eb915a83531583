"""A parameter file of a node is one for a replay, and the other way round."""

import pytest

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.formats.parameters import read_parameters


def test_what_any_node_has_is_no_parameter_of_ours(tmp_path):
    file = tmp_path / "node.yaml"
    file.write_text("/**:\n  ros__parameters:\n    use_sim_time: true\n    world: {dimensions: 3}\n")
    assert read_parameters(file) == {"world": {"dimensions": 3}}


def test_one_underscore_is_named(tmp_path):
    file = tmp_path / "node.yaml"
    file.write_text("/**:\n  ros_parameters:\n    world: {dimensions: 3}\n")
    with pytest.raises(ConfigError, match="did you mean ros__parameters"):
        read_parameters(file)
