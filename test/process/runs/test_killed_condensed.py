"""A run with ``map.condense`` that is killed: its map is read as it was, with the whole path."""

import os
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
from benchmarks.lifelong import config, hall, measurements
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.slam import GraphSlam
settings = config(hall(3, 2).space, map_condense=True, map_window_keyframes=60)
recorder = RunRecorder(sys.argv[1], settings)
slam = GraphSlam(settings, recorder.sink)
for m in measurements(hall(3, 500)):
    update = slam.process(m)
    recorder.record(slam, update)
    recorder.flush()
    if update.condensed is not None and slam.first_keyframe > 200 and int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGKILL)
    if len(slam.keyframes) == 430:
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("at_once", [0, 1])
def test_a_killed_run_is_read_as_it_was(tmp_path, at_once):
    root = Path(__file__).resolve().parents[3]
    run = subprocess.run(
        [sys.executable, "-c", KILLED, tmp_path / "run", str(at_once)],
        env=os.environ | {"PYTHONPATH": f"{root}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"},
        cwd=root,
        check=False,
    )
    assert run.returncode == -signal.SIGKILL
    losses = []
    state = read_map(tmp_path / "run", losses)
    assert all(", 0 of " in loss for loss in losses), losses
    assert state.first_keyframe > 200
    recover(tmp_path / "run", tmp_path / "again")
    count = state.keyframe_count
    stamps = read_tum(tmp_path / "again" / "path.tum").stamps_s
    assert len(stamps) >= count
    assert (np.diff(stamps) > 0).all()
