"""The launch file: its arguments are those of docs/ros.md; where launch is installed, it starts and ends the node."""

import ast
import contextlib
import importlib.util
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from places import ROOT

FILE = ROOT / "launch" / "graph_slam.launch.py"
HAS_LAUNCH = all(importlib.util.find_spec(name) for name in ("launch", "launch_ros", "rclpy"))
needs_launch = pytest.mark.skipif(not HAS_LAUNCH, reason="launch and launch_ros come with ROS, not from pip")
LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
arguments = [tuple(word.split(":=", 1)) for word in sys.argv[2:]]
included = IncludeLaunchDescription(PythonLaunchDescriptionSource(sys.argv[1]), launch_arguments=arguments)
service = LaunchService()
service.include_launch_description(LaunchDescription([included]))
sys.exit(service.run())
"""
NODE, RVIZ, TAGS = "graph_slam_ros/graph_slam_node", "rviz2/rviz2", "apriltag_ros/apriltag_node"
FRAMES, PRESETS = ("map", "odom", "base_link"), ROOT / "graph_slam_ros/config/presets"
RUN_NODE = "import sys\nfrom graph_slam_ros.cli import node_main\nsys.exit(node_main())"
TELL = """
import json, pathlib, sys
files = [pathlib.Path(b).read_text() for a, b in zip(sys.argv, sys.argv[1:]) if a == "--params-file"]
pathlib.Path({told!r}).write_text(json.dumps([sys.argv[1:], "".join(files)]))
"""


def arguments():
    """(name, default, description) of each DeclareLaunchArgument, in order, without importing launch."""
    for call in ast.walk(ast.parse(FILE.read_text())):
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "DeclareLaunchArgument":
            given = {keyword.arg: keyword.value for keyword in call.keywords}
            yield call.args[0].value, given["default_value"].value, given["description"].value


def test_the_readme_has_every_argument_with_its_default_and_meaning():
    _, _, below = (ROOT / "docs/ros.md").read_text().partition("| argument | default | |\n|---|---|---|\n")
    rows = [f"| `{name}` | {f'`{default}`' if default else ''} | {text} |" for name, default, text in arguments()]
    assert below.split("\n\n")[0].splitlines() == rows
    assert len(rows) == 13


def test_the_executable_and_the_files_it_names_are_installed():
    text = FILE.read_text()
    assert 'executable="graph_slam_node"' in text
    assert "graph_slam_node = " in (ROOT / "setup.py").read_text()
    for name in ("planar.yaml", "graph_slam.rviz"):
        assert f'_in_config("{name}")' in text
        assert (ROOT / "config" / name).is_file()


@pytest.fixture
def prefix(tmp_path):
    """What colcon would install, as far as launch looks for it."""
    index = tmp_path / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    for name in (NODE, RVIZ, TAGS):
        (index / name.split("/")[0]).touch()
    shutil.copytree(ROOT / "config", tmp_path / "share/graph_slam_ros/config")
    shutil.copytree(PRESETS, tmp_path / "share/graph_slam_ros/config/presets")
    return tmp_path


def install(prefix, name, script):
    file = prefix / "lib" / name
    file.parent.mkdir(parents=True)
    file.write_text(f"#!{sys.executable}\n{script}\n")
    file.chmod(0o755)


@contextlib.contextmanager
def launched(prefix, *words):
    """The process of a launch, and a function that gives what it has said."""
    from live_nodes import own_domain  # which needs ROS

    paths = filter(None, [str(prefix), os.environ.get("AMENT_PREFIX_PATH")])
    with own_domain() as domain:
        environment = dict(
            os.environ,
            AMENT_PREFIX_PATH=os.pathsep.join(paths),
            ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST",
            ROS_DOMAIN_ID=domain,
            ROS_LOG_DIR=str(prefix / "log"),
        )
        command = [sys.executable, "-c", LAUNCH, str(FILE), *words]
        told = prefix / f"said_{random.randrange(10**9)}"
        with told.open("w") as said:
            options = {"stdout": said, "stderr": subprocess.STDOUT, "start_new_session": True}
            process = subprocess.Popen(command, env=environment, **options)
        try:
            yield process, told.read_text
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def started(prefix, *words):
    """Of each executable that was started, its words and what its parameter files say."""
    told = {name: prefix / Path(name).name for name in (NODE, RVIZ, TAGS)}
    for name, file in told.items():
        if not (prefix / "lib" / name).exists():
            install(prefix, name, TELL.format(told=str(file)))
    with launched(prefix, *words) as (process, said):
        assert process.wait(timeout=60.0) == 0, said()
    return {name: json.loads(file.read_text()) for name, file in told.items() if file.exists()}


@needs_launch
def test_arguments_reach_the_node_and_rviz_and_without_any_the_node_has_the_shipped_parameters(prefix):
    ((name, (words, parameters)),) = started(prefix).items()
    assert name == NODE
    assert {"odom:=odom", "landmarks:=landmarks"} <= set(words)
    for text in ('map: "map"', "node.autostart: true", "use_sim_time: false"):
        assert text in parameters
    for text in ("frames.map", "output.folder:"):
        assert text not in parameters, "those of params_file stay"
    given = "namespace:=robot1 odom:=/wheels frame_prefix:=robot1/ autostart:=false use_sim_time:=true folder:=/runs/1"
    out = started(prefix, *given.split(), "log_level:=debug", "rviz:=true")
    words, parameters = out[NODE]
    assert {"__ns:=/robot1", "odom:=/wheels", "landmarks:=landmarks"} <= set(words)
    assert words[words.index("--log-level") + 1] == "debug"
    frames = (f"frames.{name}: robot1/{frame}" for name, frame in zip(("map", "odom", "base"), FRAMES, strict=True))
    for text in (*frames, "node.autostart: false", "use_sim_time: true", "output.folder: /runs/1"):
        assert text in parameters
    words, parameters = out[RVIZ]
    assert words[words.index("-f") + 1] == "robot1/map"
    assert words[words.index("-d") + 1].endswith("config/graph_slam.rviz")
    assert "__ns:=/robot1" in words
    assert "use_sim_time: true" in parameters


@needs_launch
def test_a_preset_is_below_a_file_of_ones_own_and_a_detector_is_started_where_images_are_named(prefix):
    (prefix / "own.yaml").write_text("/**: {ros__parameters: {tags: {sigma_m: 0.5}}}")
    out = started(prefix, "preset:=tags", f"params_file:={prefix}/own.yaml", "image:=/camera/image", "tag_size:=0.16")
    assert out[NODE][1].startswith(
        (PRESETS / "tags.yaml").read_text() + "/**: {ros__parameters: {tags: {sigma_m: 0.5}}}"
    )
    words, parameters = out[TAGS]
    assert {"image_rect:=/camera/image", "camera_info:=/camera/camera_info"} <= set(words)
    assert "size: 0.16" in parameters


@needs_launch
def test_the_lines_of_the_readme_for_two_robots_start_both_and_ctrl_c_ends_them_cleanly(prefix, monkeypatch):
    install(prefix, NODE, RUN_NODE)
    monkeypatch.chdir(prefix)
    line = re.search(r"namespace:=robot1 frame_prefix:=robot1/", (ROOT / "docs/ros.md").read_text())[0]
    with contextlib.ExitStack() as stack:
        several = [line.replace("robot1", name).split() for name in ("robot1", "two")]
        both = [stack.enter_context(launched(prefix, *words)) for words in several]
        for process, said in both:
            deadline = time.monotonic() + 120.0  # kernels may have to be compiled
            while "kernels ready" not in said():
                assert time.monotonic() < deadline and process.poll() is None, said()
                time.sleep(0.1)
        for process, said in both:
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to launch and to the node
            assert process.wait(timeout=60.0) == 0
            assert "process has finished cleanly" in said()
            assert "Traceback" not in said()
    assert (prefix / "robot1_graph_slam_run").is_dir()
    assert (prefix / "two_graph_slam_run").is_dir()
