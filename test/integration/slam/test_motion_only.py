"""Odometry that only adds to the motion since a keyframe: the short way comes to the same bytes as the full one."""

import random
from dataclasses import replace

import pytest

from graph_slam_ros.measurements.types import InitialPose
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.tables import summarize
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry
from graph_slam_ros.slam.motion_only import MotionOnly
from graph_slam_ros.tools.simulation import measurements, simulate

END = Control("end"), Control("optimize")
MS = 1_000_000


def disturbed(drive, seed):
    """Odometry with uneven stamps, pauses, jumps and restarts at zero, of which some comes late or twice."""
    rng, out, jump_m = random.Random(seed), [], 0.0
    for k, m in enumerate(drive):
        if isinstance(m, Odometry):
            jump_m += 40.0 * (k % 997 == 700)
            x, *rest = m.T_odom_base
            at_zero = (0.0,) * 3 if len(rest) == 2 else (0.0,) * 6 + (1.0,)
            pose = at_zero if k % 1201 == 900 else (x + jump_m, *rest)
            m = replace(m, stamp_ns=m.stamp_ns + rng.randrange(30 * MS), T_odom_base=pose)
            if 300 < k % 1500 < 330:
                continue
        out.append((k + rng.choice((0, 0, 0, 1, 2, 40)) * rng.random(), m))
        if k % 89 == 0:
            out.append((k + 1.5, m))
    return [m for _, m in sorted(out, key=lambda one: one[0])]


def run(config, drive, folder, monkeypatch, *, is_short):
    """The files of a run, but for the time that it took, and how much of the odometry went the short way."""
    short, add = [], MotionOnly.add
    monkeypatch.setattr(MotionOnly, "add", lambda *given: is_short and short.append(add(*given)) is None and short[-1])
    recorder = RunRecorder(folder, config)
    slam = GraphSlam(config, recorder.sink)
    for m in [*drive, *END]:
        recorder.record(slam, slam.process(m))
    summary = summarize(slam)
    recorder.save(slam, summary)
    recorder.close()
    monkeypatch.undo()
    files = {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".json"}
    return files, summary, sum(short) / sum(isinstance(m, Odometry) for m in drive), slam.processed


@pytest.mark.parametrize(
    ("world", "settings", "least"),
    [
        ("warehouse", {}, 0.5),
        ("warehouse", {"ordering.window_s": 0.4, "odometry.turn_factor": 1.01, "odometry.noise": "density"}, 0.0),
        ("flight", {"world.dimensions": 3}, 0.4),
    ],
)
def test_the_short_way_of_odometry_gives_the_same_files(world, settings, least, tmp_path, monkeypatch):
    config = Config.from_mapping(settings)
    drive = disturbed(measurements(simulate(world, seed=5)), seed=7)[:1600]
    if world == "warehouse":
        drive.insert(len(drive) // 2, InitialPose((1.0, 2.0, 0.3), (0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01)))
    drive.insert(len(drive) * 3 // 4, Control("time_jump"))
    files, summary, share, processed = run(config, drive, tmp_path / "short", monkeypatch, is_short=True)
    other = run(config, drive, tmp_path / "full", monkeypatch, is_short=False)
    assert (files, summary, processed) == (other[0], other[1], other[3])
    assert share >= least
    assert other[2] == 0.0
    if least:
        counted = summary["counters"]["odometry"]
        assert {"jump", "late", "duplicate"} <= counted.keys(), counted
