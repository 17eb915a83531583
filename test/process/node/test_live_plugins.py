"""Inputs whose types plugins read, in a live graph where their message package is installed."""

import os
import re
import subprocess

import beacons
import built_packages
import pytest
from executables import executable
from installed import installer
from live_nodes import ENVIRONMENT
from places import ROOT

(EXAMPLE,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/inputs.md").read_text(), re.DOTALL)
LANDMARKS = ("inputs.names=odom radio", f"radio.type={beacons.TYPE}", "radio.topic=/radio", "radio.sigma_m=0.05")


@pytest.fixture
def replays(request, tmp_path, tmp_path_factory, monkeypatch):
    """A function that replays a recording in a node and without, where a package of plugins is installed."""
    messages = {"Beacons": beacons.DEFINITION}
    built_packages.use("my_msgs", messages, request, tmp_path_factory, monkeypatch)

    def replayed(bag, site, *settings):
        path = os.pathsep.join(filter(None, (str(site), ENVIRONMENT.get("PYTHONPATH"))))
        monkeypatch.setitem(ENVIRONMENT, "PYTHONPATH", path)
        options = [word for one in settings for word in ("--set", one)]
        for name, ros in (("live", ["--ros"]), ("offline", [])):
            words = [executable("graph_slam"), "replay", bag, *ros, *options, "--force", "--out", tmp_path / name]
            for _ in range(3):  # a machine that is very busy loses messages, and says so
                done = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
                if "did not arrive" not in done.stderr:
                    break
            assert done.returncode == 0, done.stderr
        for name in ("graph.g2o", "path.tum", "landmarks.csv"):
            assert (tmp_path / "live" / name).read_bytes() == (tmp_path / "offline" / name).read_bytes()
        return tmp_path / "live"

    return replayed


def test_the_example_of_the_page_reads_in_the_node_what_it_reads_in_a_replay(replays, tmp_path, monkeypatch):
    with installer(tmp_path, monkeypatch) as install:
        name = beacons.TYPE.replace("/", ".")
        site = install(EXAMPLE, group="graph_slam_ros.inputs", name=name, module="my_beacons", at="BEACONS")
        run = replays(beacons.recording(tmp_path / "a.mcap"), site, *LANDMARKS)
    assert all(name in (run / "landmarks.csv").read_text() for name in beacons.BEACONS)
