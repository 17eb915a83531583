"""Runs whose old visits are condensed: a drive through the hall of the benchmark, a window of 60 keyframes."""

from benchmarks.hall import STEP_S, config, hall, measurements
from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.slam import Control

SEED = 3


def condensed_run(folder, keyframes=500, *, condense=True, part=slice(None), longest=1000):
    """Drive and save; returns the folder, the pipeline and the summary.

    Parameters
    ----------
    part : of the keyframes of a drive of ``longest``; default: the first ``keyframes`` of a shorter one
    """
    settings = {"map_condense": True, "map_window_keyframes": 60} if condense else {}
    whole = part == slice(None)
    drive = list(measurements(hall(SEED, keyframes if whole else longest)))
    if not whole:
        first, last = (drive[0].stamp_ns + round(k * STEP_S * 1e9) for k in (part.start or 0, part.stop or longest))
        drive = [m for m in drive if first <= m.stamp_ns < last]
    slam, summary = record_run(folder, config(PLANAR, **settings), [*drive, Control("end"), Control("optimize")], [])
    return folder, slam, summary
