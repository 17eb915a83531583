"""A node that is killed between a trial of the calibration and its use: the journal has all, and nothing is lost."""

import signal
import subprocess
import sys
from pathlib import Path

from imperfect import Faults, imperfect_drive

from graph_slam_ros.node.session import Session
from graph_slam_ros.runs.folder import run_config
from graph_slam_ros.runs.journal import read_measurements
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.slam import Config, Control, Counters

RESULTS = ("graph.g2o", "ledger.csv", "path.tum", "covariances.csv", "landmarks.csv")
CALIBRATES = {
    "calibrate.groups": "auto",
    "odometry.translation_density": 0.01,
    "odometry.lateral_density": 0.002,
    "odometry.rotation_density": 0.01,
    "landmarks.added_sigma_m": 0.0,
    "robust.noise_scale": "configured",  # larger estimated noise would ask for a longer drive
}

KILLED = """
import os, signal, sys
sys.path[:0] = {paths!r}
from test_calibration_killed import drive, session
now = session({folder!r})
for m in drive():
    now.ingest([m])
    if now.slam._calibrator._job is not None:
        os.kill(os.getpid(), signal.SIGKILL)
"""


def drive():
    return imperfect_drive(Faults(distance=0.95, turn=1.05, clock_s=0.12, yaw=0.08), seconds=24.0)


def session(folder):
    config = Config.from_mapping({**CALIBRATES, "output.folder": str(folder), "output.keep_earlier": 3})
    return Session(config, Counters(), lambda *_: None, lambda *_: None)


def results(folder):
    return {name: (folder / name).read_bytes() for name in RESULTS}


def test_killed_between_a_trial_and_its_use_the_journal_gives_the_bytes_of_an_undisturbed_run(tmp_path):
    run = tmp_path / "run"
    script = KILLED.format(paths=[str(Path(__file__).parent), *sys.path], folder=str(run))
    assert subprocess.run([sys.executable, "-c", script], timeout=300, check=False).returncode == -signal.SIGKILL
    done = drive()
    ingested = list(read_measurements(run, []))
    count = len(ingested)
    assert 50 < count < len(done)
    undisturbed = session(tmp_path / "undisturbed")
    undisturbed.ingest(done[:count])
    stamps_ns = undisturbed.slam.keyframes.stamps_ns.tolist()
    assert not undisturbed.slam.corrected
    undisturbed.finish()
    assert undisturbed.slam.corrected, "a last trial, at the end"
    end = (Control("end"), Control("optimize"))
    record_run(tmp_path / "again", run_config(run), [*ingested, *end], [])
    assert results(tmp_path / "again") == results(tmp_path / "undisturbed")

    restarted = session(run)
    assert restarted.was_cut_off
    restarted.resume()
    assert not restarted.slam.calibration, "it was not used yet"
    assert restarted.slam.keyframes.stamps_ns.tolist() == stamps_ns
    restarted.ingest(done[count:])
    restarted.finish()
    # A drive of 24 s determines some of its four faults only: which, depends on where its trials fall.
    assert "yaw" in {name for _, name in restarted.slam.calibration}, "it is found anew"
    replay(run, tmp_path / "restarted")
    assert results(tmp_path / "restarted") == results(run)
