"""Read a run folder in Python: paths with stamps, landmarks with names, edges, tables for pandas."""

import json
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.files import read_text
from graph_slam_ros.runs.folder import COVARIANCES, SUMMARY, RunError, changed_since, run_config
from graph_slam_ros.runs.ledger_file import Entry, read_ledger
from graph_slam_ros.runs.run_check import check_run
from graph_slam_ros.runs.trajectory import Trajectory, read_covariances, read_landmarks, read_rows
from graph_slam_ros.slam import Config
from graph_slam_ros.typing import Array


@dataclass(frozen=True, slots=True)
class LandmarkTable:
    """The landmarks of a run, in the same order in each.

    Attributes
    ----------
    names : (n,) their ids
    positions : (n, 3) in the map frame [m]; z is 0 in the plane
    covariances : (n, 3, 3) of the positions, in the axes of the map frame [m^2]; NaN where unknown
    """

    names: tuple[str, ...]
    positions: Array
    covariances: Array

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, name: str) -> Array:
        """The position (3,) of one landmark. Raises KeyError for an unknown name."""
        if name not in self.names:
            raise KeyError(name)
        return self.positions[self.names.index(name)]

    def __repr__(self) -> str:
        return f"LandmarkTable({len(self)} landmarks)"


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
        return self._trajectory

    def odometry(self) -> Trajectory:
        """Poses of odometry alone at the keyframes, ``T_odom_base``."""
        return read_rows(self.folder / "path_odometry.tum")

    @cached_property
    def _trajectory(self) -> Trajectory:
        return read_rows(self.folder / "path.tum")

    @cached_property
    def covariances(self) -> Array:
        """Covariances of the keyframes, (n, 3, 3) or (n, 6, 6), in the tangent space of each; NaN if unknown."""
        return read_covariances(self.folder / COVARIANCES)

    @cached_property
    def landmarks(self) -> LandmarkTable:
        """All landmarks."""
        known = read_landmarks(self.folder / "landmarks.csv")
        positions = np.array([one.position for one in known.values()], dtype=float).reshape(-1, 3)
        covariances = np.array([one.covariance for one in known.values()], dtype=float).reshape(-1, 3, 3)
        return LandmarkTable(tuple(known), positions, covariances)

    @cached_property
    def edges(self) -> list[Entry]:
        """The ledger: each edge, its measurement and its verdict."""
        return read_ledger(self.folder)

    @property
    def warnings(self) -> list[str]:
        """Warnings about files that are not from the same save."""
        return changed_since(self.folder)

    def trajectory_frame(self) -> Any:
        """A pandas DataFrame of the keyframes: stamp_s, x, y, z, qx, qy, qz, qw, and the same of odometry."""
        path, odometry = self.trajectory(), self.odometry()
        names = ("x", "y", "z", "qx", "qy", "qz", "qw")
        columns = {"stamp_s": path.stamps_s} | dict(zip(names, path.poses.T, strict=True))
        columns |= {f"odometry_{name}": column for name, column in zip(names, odometry.poses.T, strict=True)}
        return _pandas().DataFrame(columns)

    def landmark_frame(self) -> Any:
        """A pandas DataFrame of the landmarks by id: x, y, z and the standard deviations of these."""
        table = self.landmarks
        sigmas = np.sqrt(np.diagonal(table.covariances, axis1=1, axis2=2))
        columns = dict(zip(("x", "y", "z"), table.positions.T, strict=True))
        columns |= dict(zip(("sigma_x", "sigma_y", "sigma_z"), sigmas.T, strict=True))
        return _pandas().DataFrame(columns, index=_pandas().Index(table.names, name="id"))

    def edge_frame(self) -> Any:
        """A pandas DataFrame of the edges by id, a column for each attribute of the ledger's ``Entry``."""
        names = [field.name for field in fields(Entry)]
        rows = [[_plain(getattr(entry, name)) for name in names] for entry in self.edges]
        return _pandas().DataFrame(rows, columns=names).set_index("edge")


def load_run(folder: Path | str) -> SavedRun:
    """The results of a run: the folder that ``replay`` or the node has written.

    Raises
    ------
    GraphSlamError
        It is no run, or its results were never written.
    """
    folder = Path(folder)
    check_run(folder)
    if not (folder / SUMMARY).is_file():
        raise RunError(f"{folder}: it has no results yet: graph_slam recover {folder} --out DIR")
    try:
        summary = json.loads(read_text(folder / SUMMARY))
    except (OSError, ValueError) as error:
        raise RunError(f"{folder / SUMMARY}: {error}") from None
    if not isinstance(summary, dict):
        raise RunError(f"{folder / SUMMARY}: not the summary of a run")
    return SavedRun(folder, summary)


def _plain(value: Any) -> Any:
    """Verdicts and reasons by name."""
    return value.name.lower() if hasattr(value, "name") else value


def _pandas() -> Any:
    try:
        import pandas
    except ImportError:
        raise GraphSlamError("data frames need pandas: pip install pandas") from None
    return pandas
