"""Hours of a robot's life: it drives for a part of each, parks, and every six hours its computer dies."""

import os
import resource
import threading
from dataclasses import replace

import numpy as np
from reliability import tell, times

from graph_slam_ros.analysis.path_error import alignment
from graph_slam_ros.lie import se3
from graph_slam_ros.node.session import Session
from graph_slam_ros.slam import Config, Counters, Odometry
from graph_slam_ros.tools.simulation import simulate
from graph_slam_ros.tools.simulation.recording import START_NS

S = 1_000_000_000
HOUR_NS, DRIVE_NS = 3600 * S, times(60, 600) * S
REBOOT_HOURS = 6.0
JITTER_M = 2e-5
"""Of odometry while the robot is parked."""


def life(recording, hours, rng):
    """What it measures: its drive in parts, and in between odometry that says, once a second, that it stands."""
    twist_covariance = tuple(recording.twist_covariance.ravel().tolist())
    stamps, poses = recording.stamps_ns, recording.T_odom_base
    seen = {s.stamp_ns: s for s in recording.seen[::5]}
    for hour in range(hours):
        shift_ns = hour * (HOUR_NS - DRIVE_NS)
        drive = (stamps >= START_NS + hour * DRIVE_NS) & (stamps < START_NS + (hour + 1) * DRIVE_NS)
        for k in np.flatnonzero(drive)[::5].tolist():  # odometry at 10 Hz
            stamp_ns = int(stamps[k])
            yield Odometry(stamp_ns + shift_ns, tuple(poses[k].tolist()), twist_covariance)
            for m in (seen[s] for s in stamps[k : k + 5].tolist() if s in seen):
                yield replace(m, stamp_ns=m.stamp_ns + shift_ns)
        parked = poses[np.flatnonzero(drive)[-1]]
        for second in range(1, (HOUR_NS - DRIVE_NS) // S):
            at = parked + np.append(JITTER_M * rng.standard_normal(2), 0.0)
            yield Odometry(stamp_ns + shift_ns + second * S, tuple(at.tolist()), twist_covariance)


class Computer:
    """Where the pipeline runs, as in the node; it can die."""

    def __init__(self, folder):
        self.config = Config.from_mapping({"output.folder": str(folder), "output.keep_earlier": 2})
        self.told = []
        self.keyframes = 0  # that were told of
        self.failures = 0
        self.start()

    def start(self):
        self.session = Session(self.config, Counters(), self.heard, lambda *said: self.told.append(said))
        if self.session.was_cut_off:
            self.session.load("")

    def heard(self, slam, _update):
        self.keyframes = len(slam.view.keyframes)

    def die(self):
        """Nothing is saved; what is told is all that may be known of afterwards."""
        self.failures += self.session.failures
        told = self.keyframes
        self.session._recorder.abandon()
        self.start()
        return told - len(self.session.slam.view.keyframes)


def usage():
    """Open files, threads and resident memory."""
    pages = int(open("/proc/self/statm").read().split()[1])  # noqa: SIM115
    return len(os.listdir("/proc/self/fd")), threading.active_count(), pages * resource.getpagesize() / 2**20


def test_T19_hours_of_driving_parking_and_dying(tmp_path):
    hours = times(1, 24)
    every = REBOOT_HOURS if hours > REBOOT_HOURS else 0.5
    recording = simulate("warehouse", 3, aisles=3, laps=-(-hours * DRIVE_NS // (60 * S)))
    assert recording.stamps_ns[-1] - recording.stamps_ns[0] >= hours * DRIVE_NS
    computer, reboots, lost = Computer(tmp_path / "run"), 1, 0
    before = None
    for m in life(recording, hours, np.random.default_rng(0)):
        if m.stamp_ns - START_NS > reboots * every * HOUR_NS:
            lost += max(0, computer.die())
            reboots += 1
            before = before or usage()
        computer.session.ingest([m])
    session = computer.session
    after = usage()
    keyframes = len(session.slam.view.keyframes)
    faults = computer.failures + session.failures
    session.finish()
    names = list(session.slam.view.landmarks)
    at = [session.slam.view.solver.estimate([session.slam.view.landmarks[name].vertex])[0][:2] for name in names]
    true = np.array([recording.landmarks[name][:2] for name in names])
    found = np.column_stack((at, np.zeros(len(at))))
    moved = np.stack(se3.act(alignment(found[:, :2], true), tuple(found.T)), axis=1)[:, :2]
    error_m = float(np.sqrt(np.mean(np.sum((moved - true) ** 2, axis=1))))
    mib = (after[2] - before[2]) / max(keyframes, 1) * 10_000
    worst = {"error_m": error_m, "mib_per_10000": mib, "files": after[0] - before[0], "threads": after[1] - before[1]}
    tell("soak", tried=hours, reboots=reboots - 1, keyframes=keyframes, faults=faults, failed=lost, worst=worst)
    assert faults == 0
    assert lost == 0
    assert after[0] <= before[0] + 1
    assert after[1] <= before[1] + 1
    assert error_m < 0.5
    assert not [said for said in computer.told if "Error" in said[1]]
