"""Reading of landmark messages with range and bearing, and of points with named fields."""

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np

from graph_slam_ros.messages.inputs.checks import MessageError
from graph_slam_ros.messages.inputs.landmarks import ObservedLandmark
from graph_slam_ros.messages.inputs.source import InputContext

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
    names = ["range"] * ("range" in kind) + angles * ("bearing" in kind)
    for one in _points(m):
        row = {name: one[name].item() for name in there}
        sigma = row.get("sigma", 0.0)
        sigma_rad = row.get("sigma_bearing", sigma if kind == "bearing" else 0.0)
        if kind == "position":
            covariance = np.diag([sigma * sigma] * 3 + [0.0] * 3).ravel() if "sigma" in there else None
            at = SimpleNamespace(x=row["x"], y=row["y"], z=row.get("z", 0.0))
            what: dict[str, Any] = {"position": at, "covariance": covariance}
        else:
            has_sigmas = there & {"sigma", "sigma_bearing"}
            sigmas = [sigma if name == "range" else sigma_rad for name in names] if has_sigmas else None
            what = {"polar": (kind, tuple(row[name] for name in names)), "sigmas": sigmas}
        size = row.get("size", row.get("diameter", 2.0 * row.get("radius", 0.0)))
        sort = next((_identity(row[one]) for one in _CLASSES if one in row), "")
        name = _identity(row.get("id"))
        yield ObservedLandmark(m.header.stamp, m.header.frame_id, name, sort=sort, size=size, **what)


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
    formats, offsets = zip(*fields.values(), strict=True)
    layout = np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": m.point_step})
    return np.concatenate([np.frombuffer(data, layout, m.width, row * m.row_step) for row in range(m.height)])


def _identity(value: float | int | None) -> str:
    if value is None or value == _UNKNOWN_ID or not math.isfinite(value):
        return ""
    return str(int(value)) if value == int(value) else str(value)


def mrpt(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """mrpt_msgs/ObservationRangeBearing, ObservationRangeBeacon: pitch is positive downwards, an id of -1 is none."""
    at = m.sensor_pose_on_robot
    T_frame_sensor = source.placed(at.position, at.orientation)
    has_bearing = hasattr(m, "sensor_std_yaw")
    sigmas = (m.sensor_std_range, m.sensor_std_yaw, m.sensor_std_pitch) if has_bearing else (m.sensor_std_range,)
    for one in m.sensed_data:
        polar = ("range_bearing", (one.range, one.yaw, -one.pitch)) if has_bearing else ("range", (one.range,))
        head, name = m.header, _identity(one.id)
        yield ObservedLandmark(
            head.stamp, head.frame_id, name, polar=polar, sigmas=sigmas, T_frame_sensor=T_frame_sensor
        )
