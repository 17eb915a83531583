"""A run with ``map.condense`` that is killed: its map is read as it was, with the whole path."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from places import ROOT

from graph_slam_ros.runs.map_file import read_map
from graph_slam_ros.runs.restore import recover
from graph_slam_ros.runs.trajectory import read_tum

# What is on the disk before and after a newer map takes the place of an older one is copied; then it is killed.
KILLED = """
import math, os, shutil, signal, sys
from benchmarks.hall import config, hall, measurements
from graph_slam_ros.runs import recorder as runs
from graph_slam_ros.slam import GraphSlam
runs._TAIL_S, runs._BYTES_PER_S = 0.0, math.inf
folder, before, after = sys.argv[1:]
settings = config(hall(3, 2).space, map_condense=True, map_window_keyframes=40)
recorder = runs.RunRecorder(folder, settings)
slam = GraphSlam(settings, recorder.sink)
rename = os.replace
def renamed(file, to):
    is_due = str(to).endswith("map.mcap") and slam.view.keyframes.first > 100 and not os.path.exists(before)
    if is_due:
        shutil.copytree(folder, before)
    rename(file, to)
    if is_due:
        shutil.copytree(folder, after)
os.replace = renamed
for m in measurements(hall(3, 300)):
    recorder.record(slam, slam.process(m))
    recorder.flush()
    recorder._join_map()
    if len(slam.view.keyframes) == 250:
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The folders before and after the rename, and at the end."""
    there = tmp_path_factory.mktemp("killed")
    folders = {name: there / name for name in ("later", "before", "after")}
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    command = [sys.executable, "-c", KILLED, *folders.values()]
    assert subprocess.run(command, env=environment, cwd=ROOT, check=False).returncode == -signal.SIGKILL
    return folders


def test_a_killed_run_is_read_as_it_was_with_the_rest_of_its_journal(runs, tmp_path):
    assert read_map(runs["later"]).keyframes.first > 100
    summary = recover(runs["later"], tmp_path / "again")
    assert all("ingest.mcap" in loss for loss in summary["losses"])
    stamps = read_tum(tmp_path / "again" / "path.tum").stamps_s
    assert len(stamps) >= 250
    assert (np.diff(stamps) > 0).all()


def test_a_run_killed_before_the_rename_ends_where_one_killed_after_it_does(runs, tmp_path):
    """What has left the map since the old one was written is in ``condensed.mcap``, and counts no more."""
    before, after = (read_map(runs[name]) for name in ("before", "after"))
    assert before.processed < after.processed
    for name in ("before", "after"):
        recover(runs[name], tmp_path / name)
    one, other = (read_tum(tmp_path / name / "path.tum") for name in ("before", "after"))
    assert one.stamps_s.tolist() == other.stamps_s.tolist()
    assert np.abs(one.poses[:, :2] - other.poses[:, :2]).max() < 0.1
