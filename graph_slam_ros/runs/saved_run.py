"""Read a run folder in Python: paths with stamps, landmarks with names, edges."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from graph_slam_ros.config import Config
from graph_slam_ros.runs.folder import COVARIANCES, SUMMARY, RunError, changed_since, check_run, run_config, summary_of
from graph_slam_ros.runs.ledger_file import Entry, read_ledger
from graph_slam_ros.runs.trajectory import LandmarkTable, Trajectory, read_covariances, read_landmarks, read_rows
from graph_slam_ros.typing import Array


@dataclass(frozen=True)
class SavedRun:
    """The results in a run folder; each file is read when it is first needed.

    Attributes
    ----------
    folder : path of the folder
    summary : the content of ``run.json``: numbers, counters, losses
    """

    folder: Path
    summary: dict[str, Any]

    def __repr__(self) -> str:
        s = self.summary
        return f"SavedRun({str(self.folder)!r}: {s.get('keyframes')} keyframes, {s.get('landmarks')} landmarks)"

    @cached_property
    def config(self) -> Config:
        """The parameters of the run."""
        return run_config(self.folder)

    def trajectory(self) -> Trajectory:
        """Estimated poses ``T_map_base`` at the keyframes, in their order, with their stamps."""
        return read_rows(self.folder / "path.tum")

    def odometry(self) -> Trajectory:
        """Poses of odometry alone at the keyframes, ``T_odom_base``."""
        return read_rows(self.folder / "path_odometry.tum")

    @cached_property
    def covariances(self) -> Array:
        """Covariances of the keyframes, (n, 3, 3) or (n, 6, 6), in the tangent space of each; NaN if unknown."""
        return read_covariances(self.folder / COVARIANCES)

    @cached_property
    def landmarks(self) -> LandmarkTable:
        """All landmarks."""
        return read_landmarks(self.folder / "landmarks.csv")

    @cached_property
    def edges(self) -> list[Entry]:
        """The ledger, each edge, its measurement and its verdict."""
        return read_ledger(self.folder)

    @property
    def warnings(self) -> list[str]:
        """Warnings about files that are not from the same save."""
        return changed_since(self.folder)


def load_run(folder: Path | str) -> SavedRun:
    """The results of a run: the folder that ``replay`` or the node has written.

    Raises
    ------
    GraphSlamError
        It is no run, or its results were never written.
    """
    folder = Path(folder)
    check_run(folder)
    if not (summary := summary_of(folder)):
        raise RunError(f"{folder}: no {SUMMARY} in it that can be read: graph_slam recover {folder} --out DIR")
    return SavedRun(folder, summary)
