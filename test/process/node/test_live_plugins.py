"""An input whose type a plugin reads, in a live graph where its message package is installed."""

import os
import re
import subprocess

import built_packages
import pytest
from beacons import BEACONS, DEFINITION, TYPE, recording
from executables import executable
from installed import installer
from live_nodes import ENVIRONMENT, own_domain
from places import ROOT

(EXAMPLE,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/inputs.md").read_text(), re.DOTALL)
SETTINGS = ("inputs.names=odom radio", f"radio.type={TYPE}", "radio.topic=/radio", "radio.sigma_m=0.05")


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    with own_domain() as number:
        monkeypatch.setitem(ENVIRONMENT, "ROS_DOMAIN_ID", number)
        yield


def test_the_example_of_the_page_reads_in_the_node_what_it_reads_in_a_replay(
    request, tmp_path, tmp_path_factory, monkeypatch
):
    built_packages.use("my_msgs", {"Beacons": DEFINITION}, request, tmp_path_factory, monkeypatch)
    bag, settings = recording(tmp_path / "a.mcap"), [word for one in SETTINGS for word in ("--set", one)]
    with installer(tmp_path, monkeypatch) as install:
        site = install(
            EXAMPLE, group="graph_slam_ros.inputs", name=TYPE.replace("/", "."), module="my_beacons", at="BEACONS"
        )
        monkeypatch.setitem(
            ENVIRONMENT, "PYTHONPATH", os.pathsep.join(filter(None, (str(site), ENVIRONMENT.get("PYTHONPATH"))))
        )
        for name, options in (("live", ["--ros"]), ("offline", [])):
            words = [executable("graph_slam"), "replay", bag, *options, *settings, "--out", tmp_path / name]
            done = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
            assert done.returncode == 0, done.stderr
    for name in ("graph.g2o", "path.tum", "landmarks.csv"):
        assert (tmp_path / "live" / name).read_bytes() == (tmp_path / "offline" / name).read_bytes()
    found = (tmp_path / "live" / "landmarks.csv").read_text()
    assert all(name in found for name in BEACONS)
