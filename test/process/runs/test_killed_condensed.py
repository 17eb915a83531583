"""A run with ``map.condense`` that is killed: its map is read as it was, with the whole path."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from graph_slam_ros.runs.map_journal import read_map
from graph_slam_ros.runs.restore import recover
from graph_slam_ros.runs.trajectory import read_tum

KILLED = """
import os, signal, sys
from benchmarks.hall import config, hall, measurements
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.slam import GraphSlam
folder, when = sys.argv[1:]
settings = config(hall(3, 2).space, map_condense=True, map_window_keyframes=60)
recorder = RunRecorder(folder, settings)
slam = GraphSlam(settings, recorder.sink)
rename = os.replace
def killed(file, to):
    if when == "before the rename" and str(to).endswith("map.mcap") and slam.first_keyframe > 200:
        os.kill(os.getpid(), signal.SIGKILL)
    rename(file, to)
os.replace = killed
for m in measurements(hall(3, 700)):
    update = slam.process(m)
    recorder.record(slam, update)
    recorder.flush()
    if update.condensed is not None and slam.first_keyframe > 200 and when != "later":
        os.kill(os.getpid(), signal.SIGKILL)
    if len(slam.keyframes) == 600:
        os.kill(os.getpid(), signal.SIGKILL)
"""
RESULTS = ("path.tum", "landmarks.csv", "ledger.csv", "sightings.tum", "graph.g2o", "graph_vertices.csv", "map.mcap")


def killed(folder, when):
    root = Path(__file__).resolve().parents[3]
    run = subprocess.run(
        [sys.executable, "-c", KILLED, folder, when],
        env=os.environ | {"PYTHONPATH": f"{root}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"},
        cwd=root,
        check=False,
    )
    assert run.returncode == -signal.SIGKILL
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    there = tmp_path_factory.mktemp("killed")
    whens = ("before the rename", "after the rename", "later")
    return {when: killed(there / when.replace(" ", "_"), when) for when in whens}


@pytest.mark.parametrize("when", ["after the rename", "later"])
def test_a_killed_run_is_read_as_it_was(runs, tmp_path, when):
    losses = []
    state = read_map(runs[when], losses)
    assert all(", 0 of " in loss for loss in losses), losses
    assert state.first_keyframe > 200
    recover(runs[when], tmp_path / "again")
    count = state.keyframe_count
    stamps = read_tum(tmp_path / "again" / "path.tum").stamps_s
    assert len(stamps) >= count
    assert (np.diff(stamps) > 0).all()


def test_a_run_killed_before_the_rename_gives_the_same_bytes(runs, tmp_path):
    """Its new map is on the disk as a part of its own, after the old one."""
    before, after = runs["before the rename"], runs["after the rename"]
    assert sorted(file.name for file in before.glob("map*.mcap")) == ["map.mcap", "map_1.mcap"]
    assert (before / "map_1.mcap").read_bytes() == (after / "map.mcap").read_bytes()
    recover(before, tmp_path / "before")
    recover(after, tmp_path / "after")
    for name in RESULTS:
        assert (tmp_path / "before" / name).read_bytes() == (tmp_path / "after" / name).read_bytes(), name


@pytest.mark.parametrize("part", [0.001, 0.9])
def test_a_new_map_that_is_torn_does_not_cost_the_old_one(runs, tmp_path, part):
    """What came since the old map is driven again from the journal, and is not condensed then."""
    torn = tmp_path / "torn"
    shutil.copytree(runs["before the rename"], torn)
    new = torn / "map_1.mcap"
    os.truncate(new, int(part * new.stat().st_size))
    recover(torn, tmp_path / "again")
    recover(runs["after the rename"], tmp_path / "after")
    again, after = (read_tum(tmp_path / name / "path.tum") for name in ("again", "after"))
    assert again.stamps_s.tolist() == after.stamps_s.tolist()
    assert np.abs(again.poses[:, :2] - after.poses[:, :2]).max() < 0.1
