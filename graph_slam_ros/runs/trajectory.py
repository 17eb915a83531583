"""Paths and maps read from files: TUM trajectories, and a run's tables of landmarks and covariances."""

import csv
import io
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.errors import GraphSlamError, similar_file
from graph_slam_ros.formats.files import read_text
from graph_slam_ros.lie import se3
from graph_slam_ros.typing import Array

_SEPARATED = re.compile(r"[\s,;]+")
_NANOSECONDS = 1e14  # no seconds are so many
MOST = 1e20  # a number of a path is smaller: the squares of larger ones are not finite
_NAMES = (
    r"t|time.*|stamp.*|sec.*",
    *(rf"(?:[pt]|[pt].*[._])?{axis}" for axis in "xyz"),
    *(rf"[qor](?:.*[._])?{axis}" for axis in "xyzw"),
)
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


def read_tum(path: Path, *, follow: bool = False) -> Trajectory:
    """Poses of a TUM file (stamp x y z qx qy qz qw) in order of stamp; ``follow``: it may be a symbolic link."""
    return read_rows(path, follow=follow).in_order()


def read_rows(path: Path, *, follow: bool = False) -> Trajectory:
    """Poses of a TUM file in the order of its rows, which in a run's files are in the order of its keyframes.

    Commas may separate the numbers, stamps may be nanoseconds, and a header may name other columns (EuRoC, TUM-VI).
    Raises GraphSlamError: no such file, nothing in it, or rows that are not eight numbers.
    """
    try:
        lines = read_text(path, follow=follow).splitlines()
    except FileNotFoundError:
        raise GraphSlamError(f"{path}: no such file{similar_file(path)}") from None
    except OSError as error:
        raise GraphSlamError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError as error:
        why = "UTF-16: iconv -f utf-16 -t utf-8" if error.object[:2] in (b"\xff\xfe", b"\xfe\xff") else "binary"
        raise GraphSlamError(f"{path}: not a readable text file ({why})") from None
    found, columns, is_first = list[list[float]](), list[int](), True
    for number, line in enumerate(lines, start=1):
        words = _SEPARATED.split(line.strip(" \t#,;"))
        is_header = is_first and not line.lstrip().startswith("#") and re.match("[a-z]", words[0], re.IGNORECASE)
        if not line.strip() or line.lstrip().startswith("#") or is_header:
            columns = _columns(line) or columns
            is_first &= not is_header
            continue
        is_first = False
        try:
            row = [float(word) for word in words]
        except ValueError as error:
            raise GraphSlamError(f"{path}:{number}: {error}") from None
        if columns and len(row) > max(columns):
            row = [row[k] for k in columns]
        if len(row) != 8 or not np.abs(row).max() < MOST:
            why = "; 12 are KITTI's, without stamps: evo_traj kitti --save_as_tum adds them" if len(row) == 12 else ""
            why = "; are these decimal commas? sed 's/,/./g'" if len(line.split()) == 8 < len(row) else why
            raise GraphSlamError(f"{path}:{number}: a row of a TUM file is eight finite numbers below {MOST:.0e}{why}")
        found.append(row)
    if not found:
        raise GraphSlamError(f"{path}: no pose in it")
    rows = np.array(found)
    if np.median(rows[:, 0]) > _NANOSECONDS:
        rows[:, 0] *= 1e-9
    return _normalized(rows[:, 0], rows[:, 1:], str(path))


def _columns(header: str) -> list[int]:
    """The columns of stamp, position and quaternion (w last) that a header names; none where it does not name all."""
    names = [re.sub(r"\[.*?\]", "", word).strip().lower() for word in re.split("[,;]", header.strip(" \t#"))]
    names = names if len(names) > 1 else header.strip(" \t#").lower().split()
    at = [next((k for k, name in enumerate(names) if re.fullmatch(kind, name)), -1) for kind in _NAMES]
    return at if min(at) >= 0 else []


def trajectory(stamps_s: Array, poses: Array, source: str) -> Trajectory:
    """Poses in order of stamp, with unit quaternions, because files contain rounded ones."""
    return _normalized(stamps_s, poses, source).in_order()


def _normalized(stamps_s: Array, poses: Array, source: str) -> Trajectory:
    norm = np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    if not (norm > 0.0).all():
        raise GraphSlamError(f"{source}: a quaternion of zeros is no rotation")
    return Trajectory(stamps_s, np.hstack([poses[:, :3], poses[:, 3:] / norm]))


def read_landmarks(path: Path) -> LandmarkTable:
    """The landmarks of a run's ``landmarks.csv``; none where there is no such file."""
    try:
        rows = csv.DictReader(io.StringIO(read_text(path), newline=""))
        known = {row["id"]: _landmark(row) for row in rows}
    except FileNotFoundError:
        known = {}
    except OSError as error:
        raise GraphSlamError(f"{path}: {error.strerror}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise GraphSlamError(f"{path}: not a table of landmarks ({error})") from None
    positions = np.array([at for at, _ in known.values()], dtype=float).reshape(-1, 3)
    covariances = np.array([covariance for _, covariance in known.values()], dtype=float).reshape(-1, 3, 3)
    return LandmarkTable(tuple(known), positions, covariances)


def _landmark(row: dict[str, str]) -> tuple[Point, Array]:
    names = "xyz" if "z" in row else "xy"
    covariance = np.zeros((3, 3))
    for i, a in enumerate(names):
        for j, b in enumerate(names[i:], start=i):
            covariance[i, j] = covariance[j, i] = float(row[f"cov_{a}{b}"])
    at = float(row["x"]), float(row["y"]), float(row.get("z", 0.0))
    if not max(map(abs, at)) < 1e9 or (np.abs(covariance) >= MOST).any():
        raise ValueError(f"{row['id']} is at {at}, variance {covariance.max():.3g}")
    return at, covariance


def read_covariances(path: Path) -> Array:
    """Covariances of a run's table, (n, 3, 3) or (n, 6, 6), in each pose's tangent space. Raises GraphSlamError."""
    try:
        lines = read_text(path).splitlines()[1:]
        rows = np.array([[float(word) for word in line.split(",")[1:]] for line in lines])
        if (np.abs(rows) >= MOST).any():
            raise ValueError(f"a number of {MOST:.0e} or more")
        dof = {6: 3, 21: 6}[rows.shape[-1]]
    except OSError as error:
        raise GraphSlamError(f"{path}: {error.strerror}") from None
    except (KeyError, ValueError) as error:
        raise GraphSlamError(f"{path}: not a table of covariances ({error})") from None
    upper = np.triu_indices(dof)
    out = np.empty((len(rows), dof, dof))
    out[:, upper[0], upper[1]] = out[:, upper[1], upper[0]] = rows
    return out
