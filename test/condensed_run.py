"""Runs whose old visits are condensed: a drive through the hall of the benchmark, a window of 60 keyframes."""

import functools
import tempfile
from pathlib import Path

from benchmarks.hall import STEP_S, config, hall, measurements
from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.slam import Control

SEED, KEYFRAMES, WINDOW = 3, 500, 60
_folder = tempfile.TemporaryDirectory()


def bounded(space=PLANAR, **values):
    """Parameters of a pipeline that condenses."""
    return config(space, map_condense=True, map_window_keyframes=WINDOW, **values)


@functools.cache
def condensed_run(last=KEYFRAMES, *, condense=True, first=0, of=None):
    """Drive keyframes ``first`` to ``last`` of ``of``, once: the folder, which nobody may change, pipeline, summary."""
    drive = list(measurements(hall(SEED, of or last)))
    begin_ns, end_ns = (drive[0].stamp_ns + round(k * STEP_S * 1e9) for k in (first, last))
    drive = [m for m in drive if begin_ns <= m.stamp_ns and (m.stamp_ns < end_ns or last == (of or last))]
    folder = Path(_folder.name) / f"run_{first}_{last}_of_{of or last}{'_condensed' * condense}"
    settings = bounded() if condense else config(PLANAR)
    slam, summary = record_run(folder, settings, [*drive, Control("end"), Control("optimize")], [])
    return folder, slam, summary
