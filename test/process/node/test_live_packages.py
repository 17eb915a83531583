"""The node with message packages that the ROS wheels lack: a bond with Nav2's lifecycle manager, inputs of plugins."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import sysconfig
import threading
from importlib.util import find_spec
from pathlib import Path

import beacons
import generate_interfaces
import pytest
from installed import installer
from live_nodes import ENVIRONMENT, PATIENCE_S, node, robot, until
from places import ROOT, executable

from graph_slam_ros import cli
from graph_slam_ros.node.bond import MISSING

# bond/msg/Status.msg of bond_core 4
STATUS = (
    "std_msgs/Header header\nstring id\nstring instance_id\nbool active\n"
    "float32 heartbeat_timeout\nfloat32 heartbeat_period\n"
)
PACKAGES = {"bond": {"Status": STATUS}, "my_msgs": {"Beacons": beacons.DEFINITION}}
(EXAMPLE,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/inputs.md").read_text(), re.DOTALL)
LANDMARKS = ("inputs.names=odom radio", f"radio.type={beacons.TYPE}", "radio.topic=/radio", "radio.sigma_m=0.05")


@pytest.fixture(autouse=True)
def packages(request, tmp_path_factory, monkeypatch):
    """Have them in processes of ``ENVIRONMENT``: built once by the project's generator, and kept by pytest's cache."""
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if not missing:
        return
    if reason := generate_interfaces.obstacle(missing):
        pytest.skip(reason)
    cache, name = getattr(request.config, "cache", None), "_".join([*missing, sysconfig.get_python_version()])
    built = Path(cache.mkdir(name)) if cache else tmp_path_factory.mktemp(name)
    if not (done := built / "built").exists():
        for one in missing:
            monkeypatch.setitem(generate_interfaces.INTERFACES, one, PACKAGES[one])
        generate_interfaces.generate(missing, Path(sys.prefix), built)
        done.touch()
    found = built / "lib" / f"python{sysconfig.get_python_version()}" / "site-packages"
    for name, folder in (("PYTHONPATH", found), ("LD_LIBRARY_PATH", built / "lib")):
        monkeypatch.setitem(ENVIRONMENT, name, os.pathsep.join(filter(None, (str(folder), ENVIRONMENT.get(name)))))


@contextlib.contextmanager
def manager():
    """The manager's end of a bond, a process that follows bondcpp, and what it says, line by line."""
    command = [sys.executable, str(ROOT / "test/bond_manager.py"), "graph_slam"]
    process = subprocess.Popen(command, env=ENVIRONMENT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    said = []
    reader = threading.Thread(target=lambda: said.extend(iter(process.stdout.readline, "")), daemon=True)
    reader.start()
    try:
        yield process, said
    finally:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(6 * PATIENCE_S)  # it ends by itself once the bond is broken
        process.kill()
        process.wait()
        reader.join()
        process.stdin.close()
        process.stdout.close()


def test_P14_a_bond_forms_when_active_and_breaks_with_whoever_goes(tmp_path):
    with node(f"output.folder:={tmp_path / 'run'}", "node.autostart:=false") as n, robot(hears=()) as r:
        assert r.change("configure", 30.0)

        def activated():
            """A manager with a bond, as Nav2's is once the node is active."""
            assert r.change("activate")
            return manager()

        with activated() as (process, said):
            until(lambda: said == ["formed\n"], r.spin, "bond")
            process.stdin.write("end\n")
            process.stdin.flush()
            until(lambda: said[1:] == ["broken: acknowledged\n"], r.spin, "acknowledgement")
            assert r.state() == "active", "which the manager changes, not the bond"
            until(lambda: "the lifecycle manager has ended the bond" in n.said, r.spin, "warning")
            assert r.change("deactivate")
        with activated() as (_, said):
            until(lambda: said == ["formed\n"], r.spin, "bond of the next activation")
            assert r.change("deactivate")
            until(lambda: said[1:] == ["broken: dead\n"], r.spin, "end by the node")
        with activated() as (_, said):
            until(lambda: said == ["formed\n"], r.spin, "bond")
            assert n.stop(signal.SIGTERM)[0] == 0
            until(lambda: said[1:] == ["broken: dead\n"], r.spin, "end by the process that was told to stop")
    assert MISSING not in n.said
    assert "Traceback" not in n.said


def test_the_example_of_the_page_reads_in_the_node_what_it_reads_in_a_replay(tmp_path, monkeypatch):
    bag, names = beacons.recording(tmp_path / "a.mcap"), ("graph.g2o", "path.tum", "landmarks.csv")
    words = ["replay", str(bag), "--force", *(word for one in LANDMARKS for word in ("--set", one)), "--out"]
    with installer(tmp_path, monkeypatch) as install:
        name = beacons.TYPE.replace("/", ".")
        site = install(EXAMPLE, group="graph_slam_ros.inputs", name=name, module="my_beacons", at="BEACONS")
        assert cli.main([*words, str(tmp_path / "offline")]) == 0
        monkeypatch.setitem(ENVIRONMENT, "PYTHONPATH", os.pathsep.join((str(site), ENVIRONMENT["PYTHONPATH"])))
        command = [executable("graph_slam"), *words, tmp_path / "live", "--ros"]
        for _ in range(3):  # a machine that is very busy loses messages, and says so
            done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
            if "did not arrive" not in done.stderr:
                break
    assert done.returncode == 0, done.stderr
    offline, live = ({name: (tmp_path / run / name).read_bytes() for name in names} for run in ("offline", "live"))
    assert offline == live
    assert all(name.encode() in live["landmarks.csv"] for name in beacons.BEACONS)
