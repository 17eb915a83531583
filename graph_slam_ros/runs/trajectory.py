"""Paths and maps read from files: TUM trajectories, and a run's tables of landmarks and covariances."""

import csv
import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.errors import GraphSlamError, similar_file
from graph_slam_ros.formats.files import read_text
from graph_slam_ros.lie import se3
from graph_slam_ros.typing import Array

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses at stamps.

    Attributes
    ----------
    stamps_s : (n,) seconds, increasing, but in the rows of a file where a clock was set back or an old drive came later
    poses : (n, 7) x, y, z [m], qx, qy, qz, qw
    has_orientation : False where only positions are known: the quaternions then mean nothing
    """

    stamps_s: Array
    poses: Array
    has_orientation: bool = True

    def moved(self, T_new_old: se3.Pose) -> "Trajectory":
        """The same trajectory in another frame."""
        return replace(self, poses=np.stack(se3.compose(T_new_old, tuple(self.poses.T)), axis=1))

    def in_plane(self) -> "Trajectory":
        """The trajectory in the plane, without height, roll and pitch."""
        return replace(self, poses=se3.in_space(se3.in_plane(self.poses)))

    def in_order(self) -> "Trajectory":
        """The same poses in order of stamp."""
        return self.at(np.argsort(self.stamps_s, kind="stable"))

    def at(self, index: Any) -> "Trajectory":
        """The part with these indices: a slice, numbers or a mask."""
        return replace(self, stamps_s=self.stamps_s[index], poses=self.poses[index])


@dataclass(frozen=True, slots=True)
class Landmark:
    """A landmark of a run.

    Attributes
    ----------
    position : in map [m]
    covariance : (3, 3) of the position in the axes of map, zero for what a plane does not have; NaN where unknown
    """

    position: Point
    covariance: Array


def read_tum(path: Path, *, follow: bool = False) -> Trajectory:
    """Poses of a TUM file (stamp x y z qx qy qz qw) in order of stamp; ``follow``: it may be a symbolic link.

    Raises
    ------
    GraphSlamError
        As ``read_rows``.
    """
    return read_rows(path, follow=follow).in_order()


def read_rows(path: Path, *, follow: bool = False) -> Trajectory:
    """Poses of a TUM file in the order of its rows, which in a run's files are in the order of its keyframes.

    Raises
    ------
    GraphSlamError
        No such file, nothing in it, or rows that are not eight numbers.
    """
    try:
        lines = read_text(path, follow=follow).splitlines()
    except FileNotFoundError:
        raise GraphSlamError(f"{path}: no such file{similar_file(path)}") from None
    except OSError as error:
        raise GraphSlamError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise GraphSlamError(f"{path}: not a readable text file ({type(error).__name__})") from None
    found = []
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            try:
                found.append([float(word) for word in line.split()])
            except ValueError as error:
                raise GraphSlamError(f"{path}:{number}: {error}") from None
            if len(found[-1]) != 8 or not np.isfinite(found[-1]).all():
                raise GraphSlamError(f"{path}:{number}: a row of a TUM file is eight finite numbers")
    if not found:
        raise GraphSlamError(f"{path}: no pose in it")
    rows = np.array(found)
    return _normalized(rows[:, 0], rows[:, 1:], str(path))


def trajectory(stamps_s: Array, poses: Array, source: str) -> Trajectory:
    """Poses in order of stamp, with unit quaternions, because files contain rounded ones."""
    return _normalized(stamps_s, poses, source).in_order()


def _normalized(stamps_s: Array, poses: Array, source: str) -> Trajectory:
    norm = np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    if not (norm > 0.0).all():
        raise GraphSlamError(f"{source}: a quaternion of zeros is no rotation")
    return Trajectory(stamps_s, np.hstack([poses[:, :3], poses[:, 3:] / norm]))


def read_landmarks(path: Path) -> dict[str, Landmark]:
    """Landmarks by id of a run's ``landmarks.csv``; empty where there is no such file."""
    try:
        table = io.StringIO(read_text(path), newline="")
        return {row["id"]: _landmark(row) for row in csv.DictReader(table)}
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise GraphSlamError(f"{path}: {error.strerror}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise GraphSlamError(f"{path}: not a table of landmarks ({error})") from None


def _landmark(row: dict[str, str]) -> Landmark:
    names = "xyz" if "z" in row else "xy"
    covariance = np.zeros((3, 3))
    for i, a in enumerate(names):
        for j, b in enumerate(names[i:], start=i):
            covariance[i, j] = covariance[j, i] = float(row[f"cov_{a}{b}"])
    return Landmark((float(row["x"]), float(row["y"]), float(row.get("z", 0.0))), covariance)


def read_covariances(path: Path) -> Array:
    """Covariances of a run's ``covariances.csv``, (n, 3, 3) or (n, 6, 6), each in its pose's tangent space.

    Raises
    ------
    GraphSlamError
        It is no such table.
    """
    try:
        lines = read_text(path).splitlines()[1:]
        rows = np.array([[float(word) for word in line.split(",")[1:]] for line in lines])
        dof = {6: 3, 21: 6}[rows.shape[-1]]
    except OSError as error:
        raise GraphSlamError(f"{path}: {error.strerror}") from None
    except (KeyError, ValueError) as error:
        raise GraphSlamError(f"{path}: not a table of covariances ({error})") from None
    upper = np.triu_indices(dof)
    out = np.empty((len(rows), dof, dof))
    out[:, upper[0], upper[1]] = out[:, upper[1], upper[0]] = rows
    return out
