"""Edge types of sensors that see a landmark by its distance, its direction, or both, in the plane and in space.

With p = Ri' (l - ti), the landmark in the pose's frame, and s = Rs' (p - ts), the same in the frame of a sensor on the
robot, each residual is a function of s less what was measured. A gradient g with respect to p becomes the row
``[-g, g x p, Ri g]``: over a step of the pose, of its heading (in space: of its rotation vector), and of the landmark.
Where a landmark is at the sensor its direction has no derivative; 0 stands there, and it stays undetermined.

Behind what was measured stands the sensor's pose in the pose's frame, which may be left out: then it is there.
"""

import numpy as np

from graph_slam_ros.graph.edge_type import EdgeType
from graph_slam_ros.graph.vertices import R1, R2, R3, SE2, SE3
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.lie.jit import jitable, kernel
from graph_slam_ros.typing import Array, Index

Frames = tuple[so3.Vector, so3.Quaternion, so3.Quaternion]

_LEAST_M = 1e-9  # below this distance a direction is rounding


@jitable
def _planar_point(x: Array, i: int, j: int, sensor: Array) -> tuple[float, float, Array]:
    """Landmark j in the frame of a sensor on pose i; and in the pose's, with the rows of both rotations."""
    c, s = np.cos(x[i + 2]), np.sin(x[i + 2])
    dx, dy = x[j] - x[i], x[j + 1] - x[i + 1]
    px, py = c * dx + s * dy, c * dy - s * dx
    cs, ss = np.cos(sensor[2]), np.sin(sensor[2])
    sx, sy = px - sensor[0], py - sensor[1]
    return cs * sx + ss * sy, cs * sy - ss * sx, np.array([px, py, c, s, cs, ss])


@jitable
def _put_planar(row: Array, frames: Array, of_x: float, of_y: float) -> None:
    px, py, c, s, cs, ss = frames
    gx, gy = cs * of_x - ss * of_y, ss * of_x + cs * of_y
    row[0], row[1], row[2] = -gx, -gy, gx * py - gy * px
    row[3], row[4] = c * gx - s * gy, s * gx + c * gy


@jitable
def _range(seen: tuple[float, float, Array], row: Array) -> float:
    """Distance, and its derivative."""
    distance = np.hypot(seen[0], seen[1])
    scale = 1.0 / max(distance, _LEAST_M)
    _put_planar(row, seen[2], seen[0] * scale, seen[1] * scale)
    return distance


@jitable
def _bearing(seen: tuple[float, float, Array], row: Array) -> float:
    """Direction, and its derivative."""
    scale = 1.0 / max(seen[0] * seen[0] + seen[1] * seen[1], _LEAST_M * _LEAST_M)
    _put_planar(row, seen[2], -seen[1] * scale, seen[0] * scale)
    return np.arctan2(seen[1], seen[0])


@kernel
def _range_and_bearing(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [|p| - range, angle of p - bearing]``."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 2)), np.zeros((n, 2, 5))
    for e in range(n):
        seen = _planar_point(x, at[e, 0], at[e, 1], measured[e, 2:])
        residual[e, 0] = _range(seen, jacobian[e, 0]) - measured[e, 0]
        residual[e, 1] = se2.wrap(_bearing(seen, jacobian[e, 1]) - measured[e, 1])
    return residual, jacobian


@kernel
def _bearing_only(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = angle of p - bearing``."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 1)), np.zeros((n, 1, 5))
    for e in range(n):
        seen = _planar_point(x, at[e, 0], at[e, 1], measured[e, 1:])
        residual[e, 0] = se2.wrap(_bearing(seen, jacobian[e, 0]) - measured[e, 0])
    return residual, jacobian


@kernel
def _range_only(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = |p| - range``; with a third vertex, an offset that all ranges of a sensor share: ``|p| + o - range``."""
    n, ends = at.shape
    residual, jacobian = np.zeros((n, 1)), np.zeros((n, 1, 3 + ends))
    for e in range(n):
        seen = _planar_point(x, at[e, 0], at[e, 1], measured[e, 1:])
        residual[e, 0] = _range(seen, jacobian[e, 0]) - measured[e, 0]
        if ends == 3:
            residual[e, 0] += x[at[e, 2]]
            jacobian[e, 0, 5] = 1.0
    return residual, jacobian


@jitable
def _spatial_point(x: Array, i: int, j: int, sensor: Array) -> tuple[so3.Vector, Frames]:
    """Landmark j in the frame of a sensor on pose i; and in the pose's, with the rotations of both."""
    q = (x[i + 3], x[i + 4], x[i + 5], x[i + 6])
    turn = (sensor[3], sensor[4], sensor[5], sensor[6])
    p = so3.act(so3.inverse(q), (x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]))
    s = so3.act(so3.inverse(turn), (p[0] - sensor[0], p[1] - sensor[1], p[2] - sensor[2]))
    return s, (p, q, turn)


@jitable
def _put_spatial(row: Array, frames: Frames, of_sensor: so3.Vector) -> None:
    p, q, turn = frames
    g = so3.act(turn, of_sensor)
    row[0], row[1], row[2] = -g[0], -g[1], -g[2]
    row[3], row[4], row[5] = so3.cross(g, p)
    row[6], row[7], row[8] = so3.act(q, g)


@jitable
def _distance(p: so3.Vector, frames: Frames, row: Array) -> float:
    """Distance, and its derivative."""
    distance = np.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    scale = 1.0 / max(distance, _LEAST_M)
    _put_spatial(row, frames, (scale * p[0], scale * p[1], scale * p[2]))
    return distance


@jitable
def _put_direction(p: so3.Vector, frames: Frames, measured: Array, residual: Array, jacobian: Array) -> None:
    """Azimuth from x towards y and elevation above that plane, less those measured, and their derivatives."""
    flat = np.hypot(p[0], p[1])
    square = max(flat * flat, _LEAST_M * _LEAST_M)
    whole = max(flat * flat + p[2] * p[2], _LEAST_M * _LEAST_M)
    up = p[2] / (whole * max(flat, _LEAST_M))
    residual[0] = se2.wrap(np.arctan2(p[1], p[0]) - measured[0])
    residual[1] = np.arctan2(p[2], flat) - measured[1]
    _put_spatial(jacobian[0], frames, (-p[1] / square, p[0] / square, 0.0))
    _put_spatial(jacobian[1], frames, (-up * p[0], -up * p[1], flat / whole))


@kernel
def _range_and_bearing_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [|p| - range, azimuth, elevation of p less those measured]``."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 9))
    for e in range(n):
        p, frames = _spatial_point(x, at[e, 0], at[e, 1], measured[e, 3:])
        residual[e, 0] = _distance(p, frames, jacobian[e, 0]) - measured[e, 0]
        _put_direction(p, frames, measured[e, 1:], residual[e, 1:], jacobian[e, 1:])
    return residual, jacobian


@kernel
def _bearing_only_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [azimuth, elevation of p less those measured]``."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 2)), np.zeros((n, 2, 9))
    for e in range(n):
        p, frames = _spatial_point(x, at[e, 0], at[e, 1], measured[e, 2:])
        _put_direction(p, frames, measured[e], residual[e], jacobian[e])
    return residual, jacobian


@kernel
def _range_only_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = |p| - range``; with a third vertex, an offset that all ranges of a sensor share: ``|p| + o - range``."""
    n, ends = at.shape
    residual, jacobian = np.zeros((n, 1)), np.zeros((n, 1, 7 + ends))
    for e in range(n):
        p, frames = _spatial_point(x, at[e, 0], at[e, 1], measured[e, 1:])
        residual[e, 0] = _distance(p, frames, jacobian[e, 0]) - measured[e, 0]
        if ends == 3:
            residual[e, 0] += x[at[e, 2]]
            jacobian[e, 0, 9] = 1.0
    return residual, jacobian


RANGE_BEARING = EdgeType("range and bearing", ((SE2,), (R2,)), 5, 2, _range_and_bearing, se2.IDENTITY)
BEARING = EdgeType("bearing", ((SE2,), (R2,)), 4, 1, _bearing_only, se2.IDENTITY)
RANGE = EdgeType("range", ((SE2,), (R2,)), 4, 1, _range_only, se2.IDENTITY)
RANGE_WITH_OFFSET = EdgeType("range with offset", ((SE2,), (R2,), (R1,)), 4, 1, _range_only, se2.IDENTITY)
RANGE_BEARING_3D = EdgeType("range and bearing 3D", ((SE3,), (R3,)), 10, 3, _range_and_bearing_3d, se3.IDENTITY)
BEARING_3D = EdgeType("bearing 3D", ((SE3,), (R3,)), 9, 2, _bearing_only_3d, se3.IDENTITY)
RANGE_3D = EdgeType("range 3D", ((SE3,), (R3,)), 8, 1, _range_only_3d, se3.IDENTITY)
RANGE_WITH_OFFSET_3D = EdgeType("range with offset 3D", ((SE3,), (R3,), (R1,)), 8, 1, _range_only_3d, se3.IDENTITY)
