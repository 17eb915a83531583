"""Parameters: one tree of defaults, strict files, and a shipped file that says exactly what the code says."""

import re

import pytest
from places import ROOT
from rows import each

from graph_slam_ros.config.config import notes, parameters
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.formats.parameters import parameters_text, parse_setting, read_parameters
from graph_slam_ros.runs.folder import run_config
from graph_slam_ros.slam import Config

CONFIG = ROOT / "config"
SHIPPED = CONFIG / "planar.yaml"
IN_SPACE = {"world.dimensions": 3}


def read(tmp_path, text):
    file = tmp_path / "parameters.yaml"
    file.write_text(text)
    return Config.from_mapping(read_parameters(file))


def test_the_shipped_files_are_exactly_what_the_code_writes_of_its_defaults_or_say_the_dimensions_alone():
    assert SHIPPED.read_text() == parameters_text(Config().as_mapping(), notes())
    assert Config.from_mapping(read_parameters(SHIPPED)) == Config()
    assert Config.from_mapping(read_parameters(CONFIG / "spatial.yaml")) == Config.from_mapping(IN_SPACE)


def test_a_preset_is_found_by_its_name_where_no_file_has_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tags").write_text("world: {dimensions: 3}")
    assert Config.from_mapping(read_parameters("tags")) == Config.from_mapping(IN_SPACE)
    with pytest.raises(
        ConfigError, match="tag: No such file or directory; presets: closures, gnss, poles, ranges, tag"
    ):
        read_parameters("tag")


def test_every_input_has_a_section_and_only_those():
    gps = {"type": "sensor_msgs/msg/NavSatFix", "sigma_m": 2}
    config = Config.from_mapping({"inputs.names": "odom gps", "gps": gps})
    inputs = [(one.name, one.topic, one.sigma_m) for one in config.sources]
    assert inputs == [("odom", "odom", 0.0), ("gps", "gps", 2.0)]
    assert list(config.as_mapping())[-2:] == ["odom", "gps"]
    assert Config.from_mapping(config.as_mapping()) == config
    names = {p.name for p in parameters(["odom", "gps"])}
    assert {"odom.topic", "gps.datum", "inputs.names"} <= names
    assert "detections.topic" not in names


def test_a_file_may_be_flat_dotted_or_wrapped_as_ros_does(tmp_path):
    for text in (
        "ordering:\n  window_s: 0.2\n",
        "ordering.window_s: 0.2\n",
        "/**:\n  ros__parameters:\n    ordering:\n      window_s: 0.2\n",
        "graph_slam:\n  ros__parameters:\n    ordering.window_s: 0.2\n",
    ):
        assert read(tmp_path, text) == Config.from_mapping({"ordering": {"window_s": 0.2}})
    assert read(tmp_path, "") == Config()
    assert read(tmp_path, "tf:\n  transform_tolerance: 1\n").tf.transform_tolerance == 1.0
    odd = Config.from_mapping({"frames": {"map": 'a "quoted" \\ näme: {x}\n'}, "odometry.translation_density": 1e-6})
    assert read(tmp_path, parameters_text(odd.as_mapping())) == odd, "what is written is read back as it was"
    any_node = "/**:\n  ros__parameters:\n    use_sim_time: true\n    world: {dimensions: 3}\n"
    assert read(tmp_path, any_node) == Config.from_mapping(IN_SPACE), "what any node has is no parameter of ours"


def test_a_parameter_that_was_removed_is_refused_by_name_and_read_in_runs_that_have_it():
    with pytest.raises(ConfigError, match=r"parameter 'landmarks.follow_s' was removed: .*; leave it out"):
        Config.from_mapping({"landmarks.follow_s": 10.0})
    with pytest.raises(ConfigError, match=r"radio.use=edges was removed: the pipeline has no edges of plugins; "):
        Config.from_mapping({"inputs.names": "odom radio", "radio.use": "edges"})
    assert Config.of_saved_run({"landmarks.association": "nearest"}).landmarks.association == "joint"
    (golden,) = (CONFIG.parent / "test" / "golden").iterdir()
    assert "follow_s" in (golden / "config.yaml").read_text()
    assert run_config(golden).landmarks.sigma_m == Config().landmarks.sigma_m


@each(
    "name, nearest",
    [("solve.every_keyframe", "solve.every_keyframes"), ("Frames.Odom", "frames.odom"), ("frames", "frames.map")],
)
def test_F28_an_unknown_key_is_refused_with_the_nearest_known_one(name, nearest):
    with pytest.raises(ConfigError, match=f"unknown parameter '{re.escape(name)}'; did you mean '{nearest}'"):
        Config.from_mapping({name: 1.0})


@each(
    "name, value, complaint",
    [
        ("solve.every_keyframes", 2.5, "2.5 is not an integer"),
        ("solve.every_keyframes", True, "True is not an integer"),
        ("solve.every_keyframes", 10**400, r"0 is not in \[1, 1e\+06\]"),
        ("tf.publish_tf", "yes", "'yes' is not true or false"),
        ("tf.transform_publish_period", "1e-3", "'1e-3' is not a number"),
        ("tf.transform_publish_period", float("nan"), "nan is not finite"),
        ("anchor.sigma_m", -1, r"-1.0 is not in \[0, 1e\+09\]"),
        ("anchor.sigma_rad", 1e-12, r"1e-12 is not 0 or in \[1e-06, 1e\+09\]"),
        ("frames.map", 3, "3 is not a text"),
        ("frames.odom", "base_link", "is frames.base, too: each needs a name of its own"),
        ("solve.method", "newton", "'newton' is not one of gn, lm"),
    ],
)
def test_F29_a_value_of_the_wrong_type_or_out_of_range_is_refused_by_name(name, value, complaint):
    with pytest.raises(ConfigError, match=f"^{re.escape(name)}: .*{complaint}"):
        Config.from_mapping({name: value})


@each(
    "text, complaint",
    [
        ("[1, 2]\n", "not a mapping of parameters"),
        ("tf: {stamp: now\n", "not valid YAML"),
        ("1: 2\n", "1 is not a name"),
        ("? [a, b]\n: 1\n", "line 1: a key is not a name"),
        ("a:\n  ros__parameters: {}\nb:\n  ros__parameters: {}\n", r"several nodes \(a, b\)"),
        ("graph_slam:\n  ros__parameters: {}\n/**:\n  ros__parameters: {}\n", "several nodes"),
        ("/**:\n  ros__parameters: 3\n", "ros__parameters is not a mapping"),
        ("/**:\n  ros_parameters:\n    world: {dimensions: 3}\n", "did you mean ros__parameters"),
    ],
)
def test_a_file_that_is_not_plain_parameters_is_refused_by_name(tmp_path, text, complaint):
    with pytest.raises(ConfigError, match=rf"parameters\.yaml: .*{complaint}") as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_a_setting_is_read_as_yaml_reads_it():
    assert parse_setting("a.b=0.5") == ("a.b", 0.5)
    assert parse_setting("frames.map=x=y") == ("frames.map", "x=y")
    assert parse_setting("tf.publish_tf=false") == ("tf.publish_tf", False)
    assert parse_setting("output.folder=") == ("output.folder", None)


@each(
    "names, remedy",
    [
        (["odom", "tags"], r"\['odom', 'tags'\] is not one text; write the names with spaces: names: odom tags"),
        ([], r"\[\] is not one text; write the names with spaces: names: odom landmarks"),
        ("odom, tags", "'odom,' is not a name .*; separate names by spaces"),
    ],
)
def test_names_of_inputs_that_are_a_list_are_answered_with_the_line_to_write(names, remedy):
    with pytest.raises(ConfigError, match=remedy):
        Config.from_mapping({"inputs.names": names})
