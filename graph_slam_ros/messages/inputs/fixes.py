"""Messages with the robot's pose in the map (fixes), or relative to an earlier pose (closures)."""

import math
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import numpy as np

from graph_slam_ros.config.inputs import HIGHEST_M
from graph_slam_ros.graph.geometry import SPATIAL
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.measurements.types import Closure, Fix, InitialPose
from graph_slam_ros.messages.inputs import checks
from graph_slam_ros.messages.inputs.checks import MessageError
from graph_slam_ros.messages.inputs.source import InputContext
from graph_slam_ros.typing import Array

_NO_FIX = -1
_UNKNOWN = 0  # position_covariance_type
_NOT_KNOWN_M2 = 1e6
_FARTHEST_M = 1e5  # farther from its datum a flat map is none
_SEMI_MAJOR_M, _FLATTENING = 6378137.0, 1.0 / 298.257223563  # WGS 84
_ECCENTRICITY2 = _FLATTENING * (2.0 - _FLATTENING)
_EARTH_M, _STEPS = 6.37e6, 6  # its radius, nearly: a step leaves a hundredth of what was missing


def pose_fix(source: InputContext, m: Any) -> Iterator[Fix]:
    """nav_msgs/Odometry, geometry_msgs/PoseWithCovarianceStamped and PoseStamped: a pose of the robot in the map.

    It is the pose of the base, or of the configured mount. Without a known orientation, it is a position.
    """
    stamp_ns = source.stamp_ns(m.header.stamp)
    p, flat = (m.pose.pose, m.pose.covariance) if hasattr(m.pose, "covariance") else (m.pose, None)
    T_map_frame = source.T_fixed(source.config.frames.map, source.frame(m.header.frame_id))
    T_base_sensor = source.T_base_child(getattr(m, "child_frame_id", "").lstrip("/"))
    at, n = checks.point(p.position), source.space.dimensions
    covariance = SPATIAL.in_parent_axes(T_map_frame, source.pose_covariance(flat, 0.0))
    if not source.orientation_known(covariance):
        measured = tuple(map(float, se3.act(T_map_frame, at)))[:n]
        arm = tuple(map(float, se3.position(T_base_sensor)))[:n]
        block = source.checked(covariance[:n, :n], n)
        yield Fix(stamp_ns, source.name, "position", measured, block, arm if any(arm) else ())
        return
    T_map_sensor = se3.compose(T_map_frame, source.placed(p.position, p.orientation))
    T_map_base = se3.compose(T_map_sensor, se3.inverse(T_base_sensor))
    if not source.has_heading(T_map_base):
        raise MessageError("no_heading")
    if not covariance[:n, :n].any():
        covariance[:3, :3] = np.eye(3) * source.sigma_m() ** 2
        source.count("covariance_unknown")
    into_base = se3.adjoint(T_base_sensor)
    tangent = into_base @ SPATIAL.in_parent_axes(se3.inverse(T_map_sensor), covariance) @ into_base.T
    yield Fix(stamp_ns, source.name, "pose", source.of_robot(T_map_base), source.checked(source.block(tangent), n))


def initial_pose(source: InputContext, m: Any) -> Iterator[InitialPose]:
    """geometry_msgs/PoseWithCovarianceStamped in the map frame: the present pose of the base, given by a person."""
    frame = source.frame(m.header.frame_id)
    T_map_frame = source.T_fixed(source.config.frames.map, frame)
    T_map_base = se3.compose(T_map_frame, source.placed(m.pose.pose.position, m.pose.pose.orientation))
    if not source.has_heading(T_map_base):
        raise MessageError("no_heading")
    covariance = SPATIAL.in_parent_axes(T_map_frame, source.pose_covariance(m.pose.covariance, 0.0))
    unknown = np.diag(np.repeat(np.square([source.settings.sigma_m, source.settings.sigma_rad]), 3))
    for part in (slice(0, 3), slice(3, 6)):
        if not covariance[part, part].any():
            covariance[part] = unknown[part]
            covariance[:, part] = unknown[:, part]
    block = source.block(SPATIAL.in_parent_axes(se3.inverse(T_map_base), covariance))
    yield InitialPose(source.projected(T_map_base), source.checked(block, source.space.dimensions))


def gnss(source: InputContext, m: Any) -> Iterator[Fix]:
    """sensor_msgs/NavSatFix: the antenna's position east, north and up of the datum."""
    stamp_ns = source.stamp_ns(m.header.stamp)
    if m.status.status <= _NO_FIX:
        raise MessageError("no_fix")
    if not (math.isfinite(m.latitude) and math.isfinite(m.longitude)):
        raise MessageError("nonfinite")
    has_altitude = math.isfinite(m.altitude)
    if abs(m.latitude) > 90.0 or abs(m.longitude) > 360.0 or (has_altitude and abs(m.altitude) > HIGHEST_M):
        raise MessageError("not_on_earth")
    if m.latitude == m.longitude == 0.0:  # off Africa: nobody drives there, and drivers without a position say so
        raise MessageError("no_position")
    n = source.space.dimensions
    covariance = np.array(m.position_covariance, dtype=float).reshape(3, 3)
    if m.position_covariance_type == _UNKNOWN or source.settings.noise == "sigmas":
        covariance = np.eye(3) * source.sigma_m() ** 2
    if n == 3 and not has_altitude:
        source.count("no_altitude")
        covariance[2, :] = covariance[:, 2] = 0.0
        covariance[2, 2] = _NOT_KNOWN_M2
    arm = tuple(map(float, source.mount_position(m.header.frame_id, stamp_ns)))[:n]
    block = source.checked(covariance[:n, :n], n)
    here = m.latitude, m.longitude, m.altitude if has_altitude else 0.0
    source.origin.datum = source.origin.datum or here
    datum = source.settings.numbers("datum", 3) or source.origin.datum
    measured = east_north_up(here if has_altitude else (*here[:2], datum[2]), datum)
    if max(map(abs, measured)) > _FARTHEST_M:
        raise MessageError("far_from_datum")
    yield Fix(stamp_ns, source.name, "position", measured[:n], block, arm if any(arm) else (), datum)


def east_north_up(here: tuple[float, float, float], datum: tuple[float, ...]) -> tuple[float, float, float]:
    """Coordinates [m] in the plane tangent to the ellipsoid at the datum.

    Parameters
    ----------
    here, datum : latitude [deg], longitude [deg], height above the ellipsoid [m]
    """
    latitude, longitude = math.radians(datum[0]), math.radians(datum[1])
    (cp, sp), (cl, sl) = (math.cos(latitude), math.sin(latitude)), (math.cos(longitude), math.sin(longitude))
    turn = np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])
    east, north, up = (turn @ (_earth_centred(*here) - _earth_centred(*datum))).tolist()
    return east, north, up


def geodetic(points: Array, datum: tuple[float, ...]) -> Array:
    """Latitude [deg], longitude [deg] and height [m] of points (n, 3) east, north and up of a datum."""
    degree_m = np.array([np.deg2rad(_EARTH_M), np.deg2rad(_EARTH_M) * np.cos(np.deg2rad(datum[0])), 1.0])
    out = np.tile(np.array(datum), (len(points), 1))
    for row, point in zip(out, points, strict=True):
        for _ in range(_STEPS):
            missing = point - east_north_up((float(row[0]), float(row[1]), float(row[2])), datum)
            row += missing[[1, 0, 2]] / degree_m
    return out


def _earth_centred(latitude_deg: float, longitude_deg: float, height_m: float) -> Array:
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    radius = _SEMI_MAJOR_M / math.sqrt(1.0 - _ECCENTRICITY2 * math.sin(latitude) ** 2)  # of the prime vertical
    out = (radius + height_m) * math.cos(latitude)
    up = (radius * (1.0 - _ECCENTRICITY2) + height_m) * math.sin(latitude)
    return np.array([out * math.cos(longitude), out * math.sin(longitude), up])


def imu(source: InputContext, m: Any) -> Iterator[Fix]:
    """sensor_msgs/Imu: the attitude in space, the heading in the plane; an orientation in ENU is assumed."""
    stamp_ns = source.stamp_ns(m.header.stamp)
    covariance = np.array(m.orientation_covariance, dtype=float).reshape(3, 3)
    if covariance[0, 0] == -1.0:
        raise MessageError("no_orientation")
    plane = source.space.dimensions == 2
    if source.settings.noise == "sigmas" or not (covariance[2:, 2:] if plane else covariance).any():
        if source.settings.sigma_rad == 0.0:
            raise MessageError("noise_unknown")
        covariance = np.eye(3) * source.settings.sigma_rad**2
    if not np.isfinite(covariance).all():
        raise MessageError("nonfinite_covariance")
    T_base_imu = source.T_base(source.frame(m.header.frame_id), stamp_ns)
    q = so3.compose(source.unit(m.orientation), so3.inverse(se3.rotation(T_base_imu)))
    T_map_base = 0.0, 0.0, 0.0, float(q[0]), float(q[1]), float(q[2]), float(q[3])
    if plane:
        if not source.has_heading(T_map_base):
            raise MessageError("no_heading")
        block = source.checked(covariance[2:, 2:], 0)
        yield Fix(stamp_ns, source.name, "heading", source.projected(T_map_base)[2:], block)
        return
    turn = so3.matrix(q)
    block = source.checked(turn.T @ covariance @ turn, 0)
    yield Fix(stamp_ns, source.name, "attitude", T_map_base[3:], block)


def closures(source: InputContext, m: Any) -> Iterable[Closure]:
    """vision_msgs/Detection3DArray as loop closures: where the robot's base was earlier is what is detected.

    Its pose in the header's frame at the header's stamp, with its covariance; ``id`` is the earlier stamp in
    nanoseconds. Of the standard messages only this one holds two stamps, a pose and a covariance.
    """
    return source.each(m.detections, partial(_closure, source, source.stamp_ns(m.header.stamp), m.header.frame_id))


def _closure(source: InputContext, stamp_ns: int, frame: str, one: Any) -> Closure:
    if not one.id.isdecimal() or len(one.id) > 19 or int(one.id) == 0:
        raise MessageError("id_not_a_stamp")
    if int(one.id) == stamp_ns:
        raise MessageError("closure_with_itself")
    T_base_frame = source.T_base(source.frame(one.header.frame_id or frame), stamp_ns)
    if not len(one.results):
        raise MessageError("no_result")
    at = one.results[0].pose
    T_frame_earlier = source.placed(at.pose.position, at.pose.orientation)
    covariance = source.pose_covariance(at.covariance, 0.0)
    if not source.block(covariance).any():
        raise MessageError("noise_unknown")
    T_base_earlier = se3.compose(T_base_frame, T_frame_earlier)
    # T exp(d) inverted is T^-1 exp(-Ad(T) d)
    into_base = se3.adjoint(T_base_earlier)
    tangent = into_base @ SPATIAL.in_parent_axes(se3.inverse(T_frame_earlier), covariance) @ into_base.T
    T_earlier_base = source.projected(se3.inverse(T_base_earlier))
    block = source.checked(source.block(tangent), source.space.dimensions)
    return Closure(stamp_ns, int(one.id), source.name, T_earlier_base, block)
