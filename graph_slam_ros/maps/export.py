"""Export of a run to other formats: its path as TUM or GeoJSON, its graph as g2o, both as mcap for viewers.

Everything is read from the map of the run. So a run that never ended can be exported, too.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.formats.durable import replaced
from graph_slam_ros.formats.g2o_writer import write_g2o, write_text
from graph_slam_ros.formats.strict import is_gzipped
from graph_slam_ros.formats.tum import tum_text
from graph_slam_ros.messages import results, to_msg
from graph_slam_ros.messages.inputs.fixes import geodetic
from graph_slam_ros.recordings.bag import BagWriter
from graph_slam_ros.runs.condensed_map import WholePath
from graph_slam_ros.runs.folder import RunError, is_run
from graph_slam_ros.runs.restore import restored
from graph_slam_ros.runs.tables import graph_file, numbered
from graph_slam_ros.slam import MapView
from graph_slam_ros.typing import Array


def export(folder: Path, out: Path, target: str, losses: list[str], *, last_drive: bool = False) -> list[Path]:
    """Write a run in another format. Returns the files.

    Parameters
    ----------
    target : one of ``TARGETS``
    losses : what could not be read of the run is added
    last_drive : of the path only the last drive, not those of the map that it began in; TUM only
    """
    if out.resolve().parent == folder.resolve():
        raise RunError(f"{out}: cannot be read from and written to at once")
    if is_run(out.resolve().parent):
        raise RunError(f"{out}: a run is there, with files of its own")
    if target == "mcap" and out.suffix != ".mcap":
        raise RunError(f"{out}: what reads mcap wants a name that ends in .mcap")
    view = restored(folder, losses).view
    whole = WholePath.of(view, folder)
    if last_drive:
        if target != "tum":
            raise RunError(f"--last-drive: {target} holds a whole map; as TUM it is the path of the last drive")
        return _tum(view, whole, out, view.drives[-1])
    return TARGETS[target](view, whole, out)


def files_of(out: Path, target: str) -> list[Path]:
    """The files that ``export`` writes."""
    if target != "g2o":
        return [out]
    whole = out.with_suffix("") if is_gzipped(out) else out
    return [out, whole.with_name(f"{whole.stem}_vertices.csv")]


def _tum(view: MapView, whole: WholePath, out: Path, first: int = 0) -> list[Path]:
    write_text(out, tum_text(whole.stamps_ns.tolist()[first:], whole.poses()[first:]))
    return [out]


def _g2o(view: MapView, whole: WholePath, out: Path) -> list[Path]:
    """All accepted edges. g2o has neither stamps nor names; a second table has these."""
    ids, table = numbered(view)
    _, names_file = files_of(out, "g2o")
    write_g2o(out, graph_file(view, ids), view.solver.estimate)
    write_text(names_file, table)
    return [out, names_file]


def _geojson(view: MapView, whole: WholePath, out: Path) -> list[Path]:
    """The path as a line, and landmarks as points: longitude and latitude (WGS 84), in space with the height."""
    if not view.datum:
        raise RunError(f"{out}: nothing says where on earth this map is: no NavSatFix of the recording was used")
    n = view.space.dimensions

    def feature(kind: str, points: Array, **properties: Any) -> dict[str, Any]:
        at = geodetic(np.pad(points, ((0, 0), (0, 3 - n))), view.datum)[:, [1, 0, 2][:n]].tolist()
        shape = {"type": kind, "coordinates": at if kind == "LineString" else at[0]}
        return {"type": "Feature", "geometry": shape, "properties": properties}

    stamps_s = (whole.stamps_ns / 1e9).tolist()
    features = [feature("LineString", whole.poses()[:, :n], name="path", stamps_s=stamps_s)]
    for name, landmark in view.landmarks.items():
        features.append(feature("Point", view.solver.estimate([landmark.vertex])[:, :n], name=name))
    write_text(out, json.dumps({"type": "FeatureCollection", "features": features}))
    return [out]


def _mcap(view: MapView, whole: WholePath, out: Path) -> list[Path]:
    """Every keyframe at its stamp with its covariance; at the last stamp the path and the landmarks.

    The covariance of a keyframe that was condensed is not known: all variances are those of what a pose does not have.
    """
    frame, unused = view.config.frames.map, to_msg.UNUSED
    path, stamps_ns, dof = whole.poses(), whole.stamps_ns.tolist(), view.space.dof
    unknown = np.broadcast_to(unused * np.eye(dof), (view.keyframes.first, dof, dof))
    poses = zip(stamps_ns, path, np.concatenate((unknown, view.keyframe_covariances())), strict=True)
    last_ns, landmarks = view.keyframes[-1].stamp_ns, results.landmark_estimates(view)
    with replaced(out) as new, BagWriter(new) as bag:
        for stamp_ns, at, covariance in poses:
            pose = to_msg.pose_with_covariance_stamped(stamp_ns, frame, tuple(at.tolist()), covariance, unused)
            bag.write("/pose", results.POSE, stamp_ns, pose)
        bag.write("/path", results.PATH, last_ns, to_msg.path(frame, np.array(stamps_ns), path))
        bag.write("/landmarks", results.LANDMARKS, last_ns, results.landmarks(view, landmarks))
        bag.write("/landmarks_estimate", results.ESTIMATES, last_ns, results.landmarks_estimate(view, landmarks))
    return [out]


TARGETS = {"tum": _tum, "g2o": _g2o, "geojson": _geojson, "mcap": _mcap}
