"""The map of a report: paths, landmarks with their ellipses, and a floor plan."""

import base64
import io
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from graph_slam_ros.analysis.evaluation import truth_in_map
from graph_slam_ros.analysis.trajectories import Truth
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.files import read_bytes, read_text
from graph_slam_ros.lie import se3
from graph_slam_ros.runs.folder import LANDMARKS
from graph_slam_ros.runs.trajectory import LandmarkTable, Trajectory, read_landmarks, read_rows
from graph_slam_ros.tools.report.packing import Packing, shown

MOST_KEYFRAMES, MOST_TRUTH = 20_000, 8_000  # of a path: more are thinned
_MM = 1e-3
_SIGMAS, _CORNERS, _MOST_ELLIPSES = 2.0, 24, 2_000
_MOST_PIXELS = 16_000_000
_STRAIGHT = 1e-6  # rad
_MOST_OUTSIDE = 0.5  # part of the keyframes


def paths(
    pack: Packing, run: Path, saved: SavedGraph, known: Truth | None, other: Path | None, *, align: bool = True
) -> dict[str, Any]:
    """The paths and landmarks of a run, in the frame map; the truth is laid on them.

    Raises GraphSlamError: a file that is missing or damaged.
    """
    path, reckoned = keyframe_paths(saved)
    T_map_odom = se3.compose(tuple(path.poses[0].tolist()), se3.inverse(tuple(reckoned.poses[0].tolist())))
    drawn = {"odometry": reckoned.moved(T_map_odom), "estimate": path}
    out: dict[str, Any] = {"keyframes": len(path.stamps_s), "stamps": pack.column(path.stamps_s, "f8")}
    if known is not None:
        drawn["truth"] = _thinned(truth_in_map(run, known, align=align), MOST_TRUTH)
    if other is not None:
        drawn["other"] = read_rows(other / "path.tum")
    every = max(1, math.ceil(len(path.stamps_s) / MOST_KEYFRAMES))
    out["every"] = every
    out["paths"] = {}
    for name, one_path in drawn.items():
        # places of keyframes are needed one by one for edges, so only what is drawn as a line is thinned
        out["paths"][name] = [pack.fixed(column, _MM, is_path=True) for column in one_path.poses[:, :3].T]
    out["landmarks"] = _landmarks(pack, _known_landmarks(run, saved))
    return out


def keyframe_paths(saved: SavedGraph) -> tuple[Trajectory, Trajectory]:
    """The estimate and odometry at the keyframes."""
    whole = saved.whole_path
    estimate, odometry = (Trajectory(whole.stamps_ns / 1e9, se3.in_space(of)) for of in (whole.poses(), whole.odometry))
    return estimate, odometry


def _known_landmarks(run: Path, saved: SavedGraph) -> LandmarkTable:
    """The landmarks of the run's table; of its map, without covariances, where it has none yet."""
    if landmarks := read_landmarks(run / LANDMARKS):
        return landmarks
    points, n = np.zeros((len(saved.landmarks), 3)), saved.space.dimensions
    for point, vertex in zip(points, saved.landmarks.values(), strict=True):
        point[:n] = saved.view.solver.estimate([vertex])[0][:n]
    return LandmarkTable(tuple(saved.landmarks), points, np.full((len(points), 3, 3), np.nan))


def _thinned(path: Trajectory, most: int) -> Trajectory:
    every = max(1, math.ceil(len(path.stamps_s) / most))
    return path.at(slice(None, None, every))


def _landmarks(pack: Packing, landmarks: LandmarkTable) -> dict[str, Any]:
    """Positions by name, and an ellipse of two sigmas about each."""
    points, covariances = landmarks.positions, landmarks.covariances
    sigmas = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
    corners = _ellipses(points, covariances[:, :2, :2])
    return {
        "names": pack.texts([shown(name) for name in landmarks.names]),
        "points": [pack.fixed(column, _MM) for column in points.T],
        "sigmas": [pack.column(column) for column in sigmas.T],
        "ellipses": [pack.fixed(column, _MM) for column in corners.T],
    }


def _ellipses(points: Any, covariances: Any) -> Any:
    """Corners (m, 2) of the ellipses, one after another with a NaN between them."""
    known = np.isfinite(covariances).all(axis=(1, 2))
    some = np.flatnonzero(known)[:_MOST_ELLIPSES]
    if not len(some):
        return np.zeros((0, 2))
    values, vectors = np.linalg.eigh(covariances[some])
    axes = vectors * (_SIGMAS * np.sqrt(np.maximum(values, 0.0)))[:, None, :]
    turn = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    corners = points[some, None, :2] + (axes @ circle).transpose(0, 2, 1)
    return np.concatenate([corners, np.full((len(some), 1, 2), np.nan)], axis=1).reshape(-1, 2)


def floor_plan(file: Path) -> dict[str, Any]:
    """The picture of a ``map.yaml`` of Nav2, and where it lies in map. Raises GraphSlamError: it cannot be read."""
    from PIL import Image

    try:
        content = yaml.safe_load(read_text(file, follow=True))
        resolution, (x, y, yaw) = float(content["resolution"]), map(float, content["origin"])
        data = read_bytes(file.parent / os.fspath(content["image"]), follow=True)
        with Image.open(io.BytesIO(data)) as picture:
            if picture.width * picture.height > _MOST_PIXELS:
                raise GraphSlamError(f"{file}: its image has more than {_MOST_PIXELS} pixels")
            drawn = picture.convert("L")
            if abs(yaw) > _STRAIGHT:
                (x, y), drawn = _unturned(drawn, resolution, (x, y, yaw))
            packed = io.BytesIO()
            drawn.save(packed, format="PNG", optimize=True)
            size = drawn.size
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError, Image.DecompressionBombError) as error:
        raise GraphSlamError(f"{file}: not a map.yaml of Nav2 with its image ({error})") from None
    url = f"data:image/png;base64,{base64.b64encode(packed.getvalue()).decode()}"
    width, height = (resolution * pixels for pixels in size)
    return {"url": url, "x": x, "y": y, "width": width, "height": height}


def _unturned(picture: Any, resolution: float, origin: tuple[float, float, float]) -> tuple[tuple[float, float], Any]:
    """A picture that is turned about its lower left corner, as an upright one with clear corners, and its origin."""
    from PIL import Image

    x, y, yaw = origin
    turned = picture.convert("LA").rotate(math.degrees(yaw), Image.Resampling.BILINEAR, expand=True)
    half = 0.5 * resolution * np.array(picture.size)
    middle = [x, y] + np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]) @ half
    left, low = (middle - 0.5 * resolution * np.array(turned.size)).tolist()
    return (left, low), turned


def outside(file: Path, plan: dict[str, Any], saved: SavedGraph) -> list[str]:
    """A warning where most of the drive is outside of the floor plan."""
    at = saved.whole_path.poses()[:, :2] - [plan["x"], plan["y"]]
    count = int(np.count_nonzero(((at < 0.0) | (at > [plan["width"], plan["height"]])).any(axis=1)))
    if count <= _MOST_OUTSIDE * len(at):
        return []
    mend = "anchor.pose or landmarks.surveyed_file puts the map into its frame"
    return [f"{file}: {count} of {len(at)} keyframes are outside of the floor plan: is it of this place? {mend}"]
