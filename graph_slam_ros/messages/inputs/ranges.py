"""Reading of landmark messages with range and bearing, and of points with named fields."""

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np

from graph_slam_ros.lie import se3
from graph_slam_ros.messages.inputs import checks
from graph_slam_ros.messages.inputs.checks import MessageError
from graph_slam_ros.messages.inputs.landmarks import ObservedLandmark
from graph_slam_ros.messages.inputs.source import InputContext
from graph_slam_ros.messages.inputs.transforms import pose

_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
_CLASSES = "class_id", "class"
_FIELDS = (
    *("x", "y", "z", "range", "bearing", "elevation", "id", "sigma", "sigma_bearing"),
    *("size", "diameter", "radius", *_CLASSES),
)
_MOST_POINTS = 100_000  # landmarks in one message: a scan is no list of landmarks
_UNKNOWN_ID = -1


def point_cloud(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """sensor_msgs/PointCloud2 by the names of its fields.

    ``x``, ``y`` and perhaps ``z``; or ``range``, ``bearing`` (and ``elevation``), or some of these, in the sensor's
    frame; ``id`` where it is known; ``sigma`` (m, or rad of bearings alone) and ``sigma_bearing``
    (rad); ``size``, ``diameter`` or ``radius`` (m) of the landmark; ``class_id`` or ``class``, a number.
    """
    there = {f.name for f in m.fields} & set(_FIELDS)
    angles = [name for name in ("bearing", "elevation") if name in there]
    if {"x", "y"} <= there:
        kind = "position"
    elif angles[:1] == ["bearing"]:
        kind = "range_bearing" if "range" in there else "bearing"
    elif "range" in there:
        kind = "range"
    else:
        raise MessageError("fields_unknown")
    for one in _points(m):
        row = {name: one[name].item() for name in there}
        name, sigma = _identity(row.get("id")), row.get("sigma", 0.0)
        size = row.get("size", row.get("diameter", 2.0 * row.get("radius", 0.0)))
        sort = next((_identity(row[one]) for one in _CLASSES if one in row), "")
        if kind == "position":
            at = SimpleNamespace(x=row["x"], y=row["y"], z=row.get("z", 0.0))
            covariance = np.diag([sigma * sigma] * 3 + [0.0] * 3).ravel() if "sigma" in there else None
            frame = m.header.frame_id
            yield ObservedLandmark(m.header.stamp, frame, name, at, covariance=covariance, sort=sort, size=size)
            continue
        sigma_rad = row.get("sigma_bearing", sigma if kind == "bearing" else 0.0)
        measured = [
            row[name] for name in (["range"] if "range" in kind else []) + (angles if "bearing" in kind else [])
        ]
        sigmas = [sigma, *[sigma_rad] * 2][: len(measured)] if "range" in kind else [sigma_rad] * len(measured)
        yield ObservedLandmark(
            m.header.stamp,
            m.header.frame_id,
            name,
            polar=(kind, tuple(measured)),
            sigmas=sigmas if there & {"sigma", "sigma_bearing"} else None,
            sort=sort,
            size=size,
        )


def _points(m: Any) -> np.ndarray[Any, Any]:
    """(n,) records of the fields that are single numbers, each at its offset and in its byte order."""
    order = ">" if m.is_bigendian else "<"
    fields = {
        f.name: (order + _DATATYPES[f.datatype], f.offset)
        for f in m.fields
        if f.name in _FIELDS and f.datatype in _DATATYPES
    }
    if len(fields) < len({f.name for f in m.fields} & set(_FIELDS)):
        raise MessageError("fields_unknown")
    if any(offset + np.dtype(kind).itemsize > m.point_step for kind, offset in fields.values()):
        raise MessageError("fields_beyond_point")
    if m.width * m.height > _MOST_POINTS:
        raise MessageError("too_many_points")
    data = bytes(m.data)
    if m.row_step < m.width * m.point_step or len(data) < m.row_step * m.height:
        raise MessageError("cut_off")
    if not m.width * m.height * m.point_step:  # whatever its layout says
        return np.empty(0)
    layout = np.dtype(
        {
            "names": list(fields),
            "formats": [kind for kind, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": m.point_step,
        }
    )
    return np.concatenate([np.frombuffer(data, layout, m.width, row * m.row_step) for row in range(m.height)])


def _identity(value: float | int | None) -> str:
    if value is None or value == _UNKNOWN_ID or not math.isfinite(value):
        return ""
    return str(int(value)) if value == int(value) else str(value)


def range_bearing(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """mrpt_msgs/ObservationRangeBearing: MRPT's pitch is positive downwards, an id of -1 is none."""
    T_frame_sensor = _sensor(source, m)
    sigmas = m.sensor_std_range, m.sensor_std_yaw, m.sensor_std_pitch
    for one in m.sensed_data:
        polar = "range_bearing", (one.range, one.yaw, -one.pitch)
        name = _identity(one.id)
        yield ObservedLandmark(
            m.header.stamp, m.header.frame_id, name, polar=polar, sigmas=sigmas, T_frame_sensor=T_frame_sensor
        )


def range_beacon(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """mrpt_msgs/ObservationRangeBeacon: ranges alone."""
    T_frame_sensor = _sensor(source, m)
    for one in m.sensed_data:
        polar = "range", (one.range,)
        name, sigmas = _identity(one.id), [m.sensor_std_range]
        yield ObservedLandmark(
            m.header.stamp, m.header.frame_id, name, polar=polar, sigmas=sigmas, T_frame_sensor=T_frame_sensor
        )


def _sensor(source: InputContext, m: Any) -> se3.Pose:
    at = m.sensor_pose_on_robot
    checks.point(at.position)
    return pose(at.position, source.unit(at.orientation))
