"""The error of a folder that is not a run: what it is instead, and what may have been meant."""

import itertools
import os
from pathlib import Path

from graph_slam_ros.errors import similar_file
from graph_slam_ros.runs.folder import RunError, is_recording, is_run

_MOST_SEARCHED, _MOST_NAMED = 200, 3  # folders in one that is not a run


def check_run(folder: Path) -> None:
    """Raise RunError where a folder is not a run."""
    if is_run(folder):
        return
    if not os.path.lexists(folder):
        raise RunError(f"{folder}: not a run's folder: there is nothing of that name{similar_file(folder)}")
    if is_recording(folder):
        what = "a recording" if folder.is_dir() else "a file"
        made = "graph_slam replay BAG --out RUN makes a run of a recording"
        raise RunError(f"{folder}: not a run's folder, but {what}: {made}")
    runs = []
    try:
        inside = itertools.islice(sorted(folder.iterdir()), _MOST_SEARCHED)
        runs = [str(one) for one in inside if one.is_dir() and is_run(one)][:_MOST_NAMED]
    except OSError:  # then none is named
        pass
    raise RunError(f"{folder}: not a run's folder" + (f"; in it there are runs: {', '.join(runs)}" if runs else ""))
