"""A run with ``map.condense`` that is killed: its map is read as it was, with the whole path."""

import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from places import ROOT

from graph_slam_ros.runs.map_journal import read_map
from graph_slam_ros.runs.restore import recover
from graph_slam_ros.runs.trajectory import read_tum

# What is on the disk before the new map replaces the old one is copied; then it goes on until it is killed.
KILLED = """
import os, shutil, signal, sys
from benchmarks.hall import config, hall, measurements
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.slam import GraphSlam
folder, before, after = sys.argv[1:]
settings = config(hall(3, 2).space, map_condense=True, map_window_keyframes=40)
recorder = RunRecorder(folder, settings)
slam = GraphSlam(settings, recorder.sink)
rename = os.replace
def renamed(file, to):
    is_due = str(to).endswith("map.mcap") and slam.first_keyframe > 100 and not os.path.exists(before)
    if is_due:
        shutil.copytree(folder, before)
    rename(file, to)
    if is_due:
        shutil.copytree(folder, after)
os.replace = renamed
for m in measurements(hall(3, 300)):
    recorder.record(slam, slam.process(m))
    recorder.flush()
    if len(slam.keyframes) == 250:
        os.kill(os.getpid(), signal.SIGKILL)
"""
RESULTS = ("path.tum", "landmarks.csv", "ledger.csv", "sightings.tum", "graph.g2o", "graph_vertices.csv", "map.mcap")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The folders before and after the rename, and at the end."""
    there = tmp_path_factory.mktemp("killed")
    folders = {name: there / name for name in ("later", "before", "after")}
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    command = [sys.executable, "-c", KILLED, *folders.values()]
    assert subprocess.run(command, env=environment, cwd=ROOT, check=False).returncode == -signal.SIGKILL
    recover(folders["after"], there / "after_recovered")
    return {**folders, "after recovered": there / "after_recovered"}


def test_a_killed_run_is_read_as_it_was(runs, tmp_path):
    state = read_map(runs["later"], losses := [])
    assert all(", 0 of " in loss for loss in losses), losses
    assert state.first_keyframe > 100
    recover(runs["later"], tmp_path / "again")
    stamps = read_tum(tmp_path / "again" / "path.tum").stamps_s
    assert len(stamps) >= state.keyframe_count
    assert (np.diff(stamps) > 0).all()


def test_a_run_killed_before_the_rename_gives_the_same_bytes(runs, tmp_path):
    """Its new map is on the disk as a part of its own, after the old one."""
    before, after = runs["before"], runs["after"]
    assert sorted(file.name for file in before.glob("map*.mcap")) == ["map.mcap", "map_1.mcap"]
    assert (before / "map_1.mcap").read_bytes() == (after / "map.mcap").read_bytes()
    recover(before, tmp_path / "before")
    for name in RESULTS:
        assert (tmp_path / "before" / name).read_bytes() == (runs["after recovered"] / name).read_bytes(), name


def test_a_new_map_that_is_torn_does_not_cost_the_old_one(runs, tmp_path):
    torn = tmp_path / "torn"
    shutil.copytree(runs["before"], torn)
    os.truncate(torn / "map_1.mcap", int(0.9 * (torn / "map_1.mcap").stat().st_size))
    recover(torn, tmp_path / "again")
    again, after = (read_tum(folder / "path.tum") for folder in (tmp_path / "again", runs["after recovered"]))
    assert again.stamps_s.tolist() == after.stamps_s.tolist()
    assert np.abs(again.poses[:, :2] - after.poses[:, :2]).max() < 0.1
