"""A run whose old visits are condensed: a drive through the hall of the benchmark, a window of 60 keyframes."""

from benchmarks.hall import config, hall, measurements
from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.slam import Control


def condensed_run(folder, keyframes=500, *, condense=True):
    """Drive and save; returns the folder, the pipeline and the summary."""
    settings = {"map_condense": True, "map_window_keyframes": 60} if condense else {}
    drive = [*measurements(hall(3, keyframes)), Control("end"), Control("optimize")]
    slam, summary = record_run(folder, config(PLANAR, **settings), drive, [])
    return folder, slam, summary
