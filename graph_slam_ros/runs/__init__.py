"""The run folder: everything a run leaves behind, written the same way by the node and by replay.

``graph.g2o`` and ``graph_vertices.csv`` (stamp and name of each vertex), ``ledger.csv`` and ``ledger_changes.csv``
(each edge, what is believed of it, and how that came: ``ledger_file``), ``path.tum`` and ``path_odometry.tum``
(estimate and dead reckoning at keyframes), ``covariances.csv``, ``sightings.tum`` and ``odometry.tum`` (the same two at
sightings), ``landmarks.csv``, ``path.png``, ``run.mcap``, ``ingest.mcap`` (the journal), ``map.mcap`` (the map as it
grew: ``map_log``), ``config.yaml``, ``run.json``.

Covariances are written as their upper triangle, row by row. Those of ``covariances.csv``, of each pose of ``path.tum``,
are in the pose's tangent space, with (x, y, theta) or (x, y, z, rotation vector) along and about the axes of the robot;
those of ``landmarks.csv`` are in the axes of map. What is not known is nan; what a point does not have is empty.
"""

from graph_slam_ros.runs.folder import (
    COVARIANCES,
    GRAPH,
    PICTURE,
    SUMMARY,
    RunError,
    changed_since,
    check_room,
    earlier_runs,
    incomplete_runs,
    is_cut_off,
    is_incomplete,
    is_name_of_earlier,
    is_run,
    keep_earlier,
    missing,
    recording_of,
    run_config,
    suggested_out,
    summary_of,
)
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.restore import (
    complete,
    config_of,
    freeze,
    map_of,
    record_run,
    recover,
    restored,
    restored_and_solved,
    save_copy,
    stopwatch,
)
from graph_slam_ros.runs.tables import account, graph_file, numbered, summarize

__all__ = [
    "COVARIANCES",
    "GRAPH",
    "PICTURE",
    "SUMMARY",
    "RunError",
    "RunRecorder",
    "account",
    "changed_since",
    "check_room",
    "complete",
    "config_of",
    "earlier_runs",
    "freeze",
    "graph_file",
    "incomplete_runs",
    "is_cut_off",
    "is_incomplete",
    "is_name_of_earlier",
    "is_run",
    "keep_earlier",
    "map_of",
    "missing",
    "numbered",
    "record_run",
    "recording_of",
    "recover",
    "restored",
    "restored_and_solved",
    "run_config",
    "save_copy",
    "stopwatch",
    "suggested_out",
    "summarize",
    "summary_of",
]
