"""Message types that a package of its own reads: the example of the page, and plugins that fail."""

import re
import sys

import pytest
from beacons import BEACONS, TYPE, recording
from installed import installer
from places import ROOT

from graph_slam_ros.cli import main
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.messages.inputs import converters, plugins
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config

NAME = TYPE.replace("/", ".")
PAGE = (ROOT / "docs/inputs.md").read_text()
(EXAMPLE,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
(POINTS,) = re.findall(r'\[project\.entry-points\."(graph_slam_ros\.inputs)"\]\n"(.*)" = "(.*)"', PAGE)
SETTINGS = {"inputs.names": "odom radio", "radio": {"type": TYPE, "topic": "/radio", "sigma_m": 0.05}}


@pytest.fixture
def install(tmp_path, monkeypatch):
    monkeypatch.setattr(plugins, "_loaded", {})
    with installer(tmp_path, monkeypatch) as put:

        def installed(text, name=NAME, module="my_beacons", at="BEACONS"):
            return put(text, group=plugins.INPUTS, name=name, module=module, at=at)

        yield installed


def test_the_example_of_the_page_reads_a_recording_with_its_definition_or_without(install, tmp_path):
    assert POINTS == ("graph_slam_ros.inputs", NAME, "my_beacons:BEACONS")
    install(EXAMPLE)
    for defined in (True, False):
        file = recording(tmp_path / f"{defined}.mcap", defined=defined)
        done = replay(file, tmp_path / f"run_{defined}", Config.from_mapping(SETTINGS))
        assert set(done.slam.view.landmarks) == set(BEACONS), defined
        for name, at in BEACONS.items():
            found = done.slam.view.solver.estimate([done.slam.view.landmarks[name].vertex])[0]
            assert found == pytest.approx(at, abs=0.1), (defined, name)


def test_info_names_plugins_and_suggests_an_input_of_their_type(install, tmp_path, capsys):
    install(EXAMPLE)
    install("X = 1", name="nav_msgs.msg.Odometry", module="my_odometry", at="X")
    install("import not_there", name="my_msgs.msg.Other", module="my_other", at="X")
    assert main(["info", str(recording(tmp_path / "a.mcap"))]) == 0
    out = capsys.readouterr().out
    assert f"plugin: {TYPE}: read by my-beacons 1.0 as landmarks\n" in out
    assert "plugin: nav_msgs.msg.Odometry: the plugin of my-odometry 1.0 is not used: it is built in\n" in out
    line = "plugin my_other:X of my-other 1.0 cannot be loaded: ModuleNotFoundError: No module named 'not_there'\n"
    assert f"plugin: my_msgs.msg.Other: {line}" in out
    assert f"plugin.type={TYPE}" in out.splitlines()[-1]
    assert "my_odometry" not in sys.modules, "a plugin for a built-in type is not even imported"


INPUT = "from graph_slam_ros.messages.inputs import InputType\n"
UNUSABLE = (
    ("import not_there", "cannot be loaded: ModuleNotFoundError: No module named 'not_there'"),
    ("raise ValueError('two\\nlines')", "cannot be loaded: ValueError: two lines"),
    ("import sys; sys.exit(7)", "cannot be loaded: SystemExit: 7"),
    ("", "cannot be loaded: AttributeError: .*BEACONS"),
    ("def BEACONS(source, message): return []", "it is a function, not an InputType"),
    (f"{INPUT}BEACONS = InputType(dict())", "its converters are not a dictionary by landmarks, fix"),
    (f"{INPUT}BEACONS = InputType(dict(tags=print))", "its converters are not a dictionary by landmarks, fix"),
    (f"{INPUT}BEACONS = InputType(dict(fix=print), 3)", "its definition is not a text"),
    (f"{INPUT}BEACONS = InputType(dict(fix=lambda m: []))", "its converter of fix is not a function of an Inp"),
    (f"{INPUT}BEACONS = InputType(dict(fix=4))", "its converter of fix is not a function of an InputContext"),
)


def test_a_plugin_that_cannot_be_used_is_refused_in_one_line(install):
    for k, (text, line) in enumerate(UNUSABLE):
        install(text, name=f"my_msgs.msg.Type{k}", module=f"my_module{k}")
        with pytest.raises(ConfigError) as refused:
            converters(f"my_msgs/msg/Type{k}")
        begin = rf"\Amy_msgs.msg.Type{k}: plugin my_module{k}:BEACONS of my-module{k} 1.0:? {line}"
        assert re.match(begin, str(refused.value)), (text, refused.value)
        assert "\n" not in str(refused.value), text


def test_of_two_plugins_for_a_type_neither_is_used_and_without_one_the_type_is_refused(install, tmp_path):
    file = recording(tmp_path / "a.mcap")
    with pytest.raises(ConfigError, match=rf"radio.type: '{TYPE}' is no type of an input: .* no plugin reads it"):
        replay(file, tmp_path / "run", Config.from_mapping(SETTINGS))
    install(EXAMPLE)
    install(EXAMPLE, module="my_radio")
    with pytest.raises(ConfigError, match=f"{NAME}: plugins of my-beacons 1.0 and my-radio 1.0 have it: uninstall one"):
        converters(TYPE)


@pytest.mark.parametrize(
    ("body", "line"),
    [
        ("return 1 / 0", "ZeroDivisionError: division by zero"),
        ("return None", "TypeError: 'NoneType' object is not iterable"),
        ("return [3]", "as landmarks it gives a int, not ObservedLandmark"),
        ("return [ObservedLandmark(m.header.stamp, 'base_link', 'a', polar=('smell', (1.0,)))]", "FormatError: "),
        ("raise MessageError('too\\nfoggy')", r"refuses a message: too foggy"),
    ],
)
def test_what_a_plugin_fails_at_is_counted_and_named_once_and_other_inputs_go_on(body, line, install, tmp_path):
    imports = "from graph_slam_ros.messages.inputs import *\n"
    install(f"{imports}def read(source, m):\n    {body}\nBEACONS = InputType({{'landmarks': read}})\n")
    done = replay(recording(tmp_path / "a.mcap"), tmp_path / "run", Config.from_mapping(SETTINGS))
    assert done.summary["counters"]["radio"]["plugin_failed"] == 150
    assert len(done.slam.view.keyframes) > 20
    (told,) = [text for text in done.warnings if "plugin my_beacons" in text]
    assert re.match(rf"radio: plugin my_beacons:BEACONS of my-beacons 1.0:? {line}", told)
    assert "\n" not in told


def test_a_run_is_repeated_and_recovered_where_its_plugin_is_not_installed_any_more(install, tmp_path, monkeypatch):
    site = install(EXAMPLE)
    replay(recording(tmp_path / "a.mcap"), tmp_path / "run", Config.from_mapping(SETTINGS))
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path != str(site)])
    monkeypatch.setattr(plugins, "_loaded", {})
    assert converters(TYPE) is None
    assert main(["replay", str(tmp_path / "run"), "--out", str(tmp_path / "again")]) == 0
    for name in ("graph.g2o", "path.tum", "landmarks.csv"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()
    assert main(["recover", str(tmp_path / "run"), "--out", str(tmp_path / "recovered")]) == 0
