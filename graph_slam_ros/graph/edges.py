"""The edge types, in the plane and in space; the arguments of their kernels are explained in ``edge_type``.

Derivatives used throughout, with J = [[0, -1], [1, 0]]:  R(theta) Exp([w]) = R(theta) (I + w J); in space
R Exp(w) = R (I + [w]x),  Log(R Exp(w)) = Log(R) + Jr^-1(Log(R)) w.

A fix that knows some axes only, or some better than others in correlated ways, is said by coordinates along the
principal axes of its covariance: each of them is one number. A position may be that of a point of the robot, an
antenna: its coordinates in the pose's frame follow what was measured, or are left out where it is the pose's own.

Sensors see a landmark by its distance, its direction, or both. With p = Ri' (l - ti), the landmark in the pose's frame,
and s = Rs' (p - ts), the same in the frame of a sensor on the robot, each residual is a function of s less what was
measured. A gradient g with respect to p becomes the row ``[-g, g x p, Ri g]``: over a step of the pose, of its heading
(in space: of its rotation vector), and of the landmark. Where a landmark is at the sensor its direction has no
derivative; 0 stands there, and it stays undetermined. Behind what was measured stands the sensor's pose in the pose's
frame, which may be left out: then it is there.

Kernels write numbers, not slices: for a slice Numba compiles an error message about its shape, which takes two seconds.
"""

import numpy as np

from graph_slam_ros.graph.edge_type import EdgeType
from graph_slam_ros.graph.vertices import R1, R2, R3, SE2, SE3
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.lie.jit import jitable, kernel
from graph_slam_ros.typing import Array, Index


@kernel
def _relative_pose(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [t, angle] of Z^-1 Ti^-1 Tj``, g2o's EDGE_SE2."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 6))
    for e in range(n):
        i, j = at[e]
        z = (measured[e, 0], measured[e, 1], measured[e, 2])
        d = se2.between((x[i], x[i + 1], x[i + 2]), (x[j], x[j + 1], x[j + 2]))
        r = se2.between(z, d)
        residual[e, 0], residual[e, 1], residual[e, 2] = r
        c, s = np.cos(z[2]), np.sin(z[2])
        jacobian[e, 0, 0], jacobian[e, 0, 1], jacobian[e, 0, 2] = -c, -s, c * d[1] - s * d[0]
        jacobian[e, 1, 0], jacobian[e, 1, 1], jacobian[e, 1, 2] = s, -c, -s * d[1] - c * d[0]
        jacobian[e, 2, 2] = -1.0
        c, s = np.cos(r[2]), np.sin(r[2])
        jacobian[e, 0, 3], jacobian[e, 0, 4] = c, -s
        jacobian[e, 1, 3], jacobian[e, 1, 4] = s, c
        jacobian[e, 2, 5] = 1.0
    return residual, jacobian


@kernel
def _inverse_relative_pose(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [t, angle] of (Z^-1 Ti^-1 Tj)^-1``: the error map of python-graphslam, kept to compare with it."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 6))
    for e in range(n):
        i, j = at[e]
        z = (measured[e, 0], measured[e, 1], measured[e, 2])
        b = se2.between((x[j], x[j + 1], x[j + 2]), (x[i], x[i + 1], x[i + 2]))
        x_r, y_r, theta = se2.compose(b, z)
        residual[e, 0], residual[e, 1], residual[e, 2] = x_r, y_r, se2.wrap(theta)
        c, s = np.cos(b[2]), np.sin(b[2])
        jacobian[e, 0, 0], jacobian[e, 0, 1], jacobian[e, 0, 2] = c, -s, -s * z[0] - c * z[1]
        jacobian[e, 1, 0], jacobian[e, 1, 1], jacobian[e, 1, 2] = s, c, c * z[0] - s * z[1]
        jacobian[e, 2, 2] = 1.0
        jacobian[e, 0, 3], jacobian[e, 0, 5] = -1.0, y_r
        jacobian[e, 1, 4], jacobian[e, 1, 5] = -1.0, -x_r
        jacobian[e, 2, 5] = -1.0
    return residual, jacobian


@kernel
def _pose_prior(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [t, angle] of Z^-1 T``: an anchor, or an absolute pose."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 3))
    for e in range(n):
        i = at[e, 0]
        r = se2.between((measured[e, 0], measured[e, 1], measured[e, 2]), (x[i], x[i + 1], x[i + 2]))
        residual[e, 0], residual[e, 1], residual[e, 2] = r
        c, s = np.cos(r[2]), np.sin(r[2])
        jacobian[e, 0, 0], jacobian[e, 0, 1] = c, -s
        jacobian[e, 1, 0], jacobian[e, 1, 1] = s, c
        jacobian[e, 2, 2] = 1.0
    return residual, jacobian


@kernel
def _landmark_position(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = Ri' (l - ti) - z``: a point landmark seen at z = (x, y) in the pose's frame, g2o's EDGE_SE2_XY."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 2)), np.zeros((n, 2, 5))
    for e in range(n):
        i, j = at[e]
        c, s = np.cos(x[i + 2]), np.sin(x[i + 2])
        dx, dy = x[j] - x[i], x[j + 1] - x[i + 1]
        px, py = c * dx + s * dy, c * dy - s * dx
        residual[e, 0], residual[e, 1] = px - measured[e, 0], py - measured[e, 1]
        jacobian[e, 0, 0], jacobian[e, 0, 2] = -1.0, py
        jacobian[e, 1, 1], jacobian[e, 1, 2] = -1.0, -px
        jacobian[e, 0, 3], jacobian[e, 0, 4] = c, s
        jacobian[e, 1, 3], jacobian[e, 1, 4] = -s, c
    return residual, jacobian


@kernel
def _tag_position(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """The same as a point landmark, for a landmark with an orientation that this sighting did not measure."""
    residual, of_point = _landmark_position(x, at, measured)
    n = at.shape[0]
    jacobian = np.zeros((n, 2, 6))
    for e in range(n):
        j = at[e, 1]
        c, s = np.cos(x[j + 2]), np.sin(x[j + 2])
        for k in range(2):
            for i in range(3):
                jacobian[e, k, i] = of_point[e, k, i]
            jacobian[e, k, 3] = c * of_point[e, k, 3] + s * of_point[e, k, 4]
            jacobian[e, k, 4] = c * of_point[e, k, 4] - s * of_point[e, k, 3]
    return residual, jacobian


@kernel
def _difference(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = xj - xi - z`` between two vectors."""
    n, m = measured.shape
    residual, jacobian = np.zeros((n, m)), np.zeros((n, m, 2 * m))
    for e in range(n):
        for k in range(m):
            residual[e, k] = x[at[e, 1] + k] - x[at[e, 0] + k] - measured[e, k]
            jacobian[e, k, k], jacobian[e, k, m + k] = -1.0, 1.0
    return residual, jacobian


@kernel
def _point_prior(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = x - z`` of one vector."""
    n, m = measured.shape
    residual, jacobian = np.zeros((n, m)), np.zeros((n, m, m))
    for e in range(n):
        for k in range(m):
            residual[e, k] = x[at[e, 0] + k] - measured[e, k]
            jacobian[e, k, k] = 1.0
    return residual, jacobian


AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@jitable
def _pose(x: Array, i: int) -> se3.Pose:
    return x[i], x[i + 1], x[i + 2], x[i + 3], x[i + 4], x[i + 5], x[i + 6]


@jitable
def _put(out: Array, row: int, column: int, v: so3.Vector) -> None:
    """Write a vector down a column of a Jacobian."""
    out[row, column], out[row + 1, column], out[row + 2, column] = v


@jitable
def _residual(e: se3.Pose, out: Array) -> so3.Vector:
    """``[t, rotation vector]`` of an error pose; returns the rotation vector."""
    w = so3.log(se3.rotation(e))
    out[0], out[1], out[2] = e[0], e[1], e[2]
    out[3], out[4], out[5] = w
    return w


@kernel
def _relative_pose_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [t, rotation vector] of Z^-1 Ti^-1 Tj``."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 6)), np.zeros((n, 6, 12))
    for k in range(n):
        z = _pose(measured[k], 0)
        d = se3.between(_pose(x, at[k, 0]), _pose(x, at[k, 1]))
        e = se3.between(z, d)
        w = _residual(e, residual[k])
        from_z, from_d = so3.inverse(se3.rotation(z)), so3.inverse(se3.rotation(d))
        out = jacobian[k]
        for c in range(3):
            axis = AXES[c]
            back = so3.act(from_z, axis)
            turned = so3.right_jacobian_inverse(w, so3.act(from_d, axis))
            _put(out, 0, c, (-back[0], -back[1], -back[2]))
            _put(out, 0, 3 + c, so3.act(from_z, so3.cross(se3.position(d), axis)))
            _put(out, 3, 3 + c, (-turned[0], -turned[1], -turned[2]))
            _put(out, 0, 6 + c, so3.act(se3.rotation(e), axis))
            _put(out, 3, 9 + c, so3.right_jacobian_inverse(w, axis))
    return residual, jacobian


@kernel
def _pose_prior_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [t, rotation vector] of Z^-1 T``."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 6)), np.zeros((n, 6, 6))
    for k in range(n):
        e = se3.between(_pose(measured[k], 0), _pose(x, at[k, 0]))
        w = _residual(e, residual[k])
        for c in range(3):
            _put(jacobian[k], 0, c, so3.act(se3.rotation(e), AXES[c]))
            _put(jacobian[k], 3, 3 + c, so3.right_jacobian_inverse(w, AXES[c]))
    return residual, jacobian


@kernel
def _landmark_position_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = Ri' (l - ti) - z``: a point landmark seen at z = (x, y, z) in the pose's frame."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 9))
    for k in range(n):
        i, j = at[k]
        back = so3.inverse(se3.rotation(_pose(x, i)))
        p = so3.act(back, (x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]))
        for c in range(3):
            residual[k, c] = p[c] - measured[k, c]
            jacobian[k, c, c] = -1.0
            _put(jacobian[k], 0, 3 + c, so3.cross(p, AXES[c]))
            _put(jacobian[k], 0, 6 + c, so3.act(back, AXES[c]))
    return residual, jacobian


@kernel
def _tag_position_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """The same as a point landmark, for a landmark with an orientation that this sighting did not measure."""
    residual, of_point = _landmark_position_3d(x, at, measured)
    n = at.shape[0]
    jacobian = np.zeros((n, 3, 12))
    for k in range(n):
        turn = so3.matrix(se3.rotation(_pose(x, at[k, 1])))
        for a in range(3):
            for i in range(6):
                jacobian[k, a, i] = of_point[k, a, i]
            for b in range(3):
                for c in range(3):
                    jacobian[k, a, 6 + b] += of_point[k, a, 6 + c] * turn[c, b]
    return residual, jacobian


@kernel
def _position(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = t + R p - z`` with measured = (z, p)."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 2)), np.zeros((n, 2, 3))
    for e in range(n):
        i = at[e, 0]
        px, py = measured[e, 2], measured[e, 3]
        c, s = np.cos(x[i + 2]), np.sin(x[i + 2])
        residual[e, 0] = x[i] + c * px - s * py - measured[e, 0]
        residual[e, 1] = x[i + 1] + s * px + c * py - measured[e, 1]
        jacobian[e, 0, 0], jacobian[e, 0, 1], jacobian[e, 0, 2] = c, -s, -s * px - c * py
        jacobian[e, 1, 0], jacobian[e, 1, 1], jacobian[e, 1, 2] = s, c, c * px - s * py
    return residual, jacobian


@kernel
def _coordinate(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = u'(t + R p) - z`` with measured = (u, z, p): one coordinate, along a direction u of unit length."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 1)), np.zeros((n, 1, 3))
    for e in range(n):
        i = at[e, 0]
        u, v, px, py = measured[e, 0], measured[e, 1], measured[e, 3], measured[e, 4]
        c, s = np.cos(x[i + 2]), np.sin(x[i + 2])
        residual[e, 0] = u * (x[i] + c * px - s * py) + v * (x[i + 1] + s * px + c * py) - measured[e, 2]
        jacobian[e, 0, 0], jacobian[e, 0, 1] = c * u + s * v, c * v - s * u
        jacobian[e, 0, 2] = u * (-s * px - c * py) + v * (c * px - s * py)
    return residual, jacobian


@kernel
def _heading(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = theta - z``."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 1)), np.zeros((n, 1, 3))
    for e in range(n):
        residual[e, 0] = se2.wrap(x[at[e, 0] + 2] - measured[e, 0])
        jacobian[e, 0, 2] = 1.0
    return residual, jacobian


@kernel
def _position_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = t + R p - z`` with measured = (z, p)."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 6))
    for e in range(n):
        i = at[e, 0]
        q = (x[i + 3], x[i + 4], x[i + 5], x[i + 6])
        p = (measured[e, 3], measured[e, 4], measured[e, 5])
        turn, reach = so3.matrix(q), so3.act(q, p)
        for k in range(3):
            residual[e, k] = x[i + k] + reach[k] - measured[e, k]
            row = (turn[k, 0], turn[k, 1], turn[k, 2])
            jacobian[e, k, 0], jacobian[e, k, 1], jacobian[e, k, 2] = row
            jacobian[e, k, 3], jacobian[e, k, 4], jacobian[e, k, 5] = so3.cross(p, row)
    return residual, jacobian


@kernel
def _coordinate_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = u'(t + R p) - z`` with measured = (u, z, p): one coordinate, along a direction u of unit length."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 1)), np.zeros((n, 1, 6))
    for e in range(n):
        i = at[e, 0]
        u = (measured[e, 0], measured[e, 1], measured[e, 2])
        p = (measured[e, 4], measured[e, 5], measured[e, 6])
        back = so3.act(so3.inverse((x[i + 3], x[i + 4], x[i + 5], x[i + 6])), u)
        along = back[0] * p[0] + back[1] * p[1] + back[2] * p[2]
        residual[e, 0] = u[0] * x[i] + u[1] * x[i + 1] + u[2] * x[i + 2] + along - measured[e, 3]
        jacobian[e, 0, 0], jacobian[e, 0, 1], jacobian[e, 0, 2] = back
        jacobian[e, 0, 3], jacobian[e, 0, 4], jacobian[e, 0, 5] = so3.cross(p, back)
    return residual, jacobian


@kernel
def _attitude_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = Log(Z^-1 R)``: the rotation vector from the measured orientation to the pose's, in the body's axes."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 6))
    for e in range(n):
        i = at[e, 0]
        z = (measured[e, 0], measured[e, 1], measured[e, 2], measured[e, 3])
        w = so3.log(so3.compose(so3.inverse(z), (x[i + 3], x[i + 4], x[i + 5], x[i + 6])))
        residual[e, 0], residual[e, 1], residual[e, 2] = w
        for c in range(3):
            d = so3.right_jacobian_inverse(w, AXES[c])
            jacobian[e, 0, 3 + c], jacobian[e, 1, 3 + c], jacobian[e, 2, 3 + c] = d
    return residual, jacobian


@kernel
def _heading_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = yaw - z``: the angle from the map's x to the body's x, both seen from above."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 1)), np.zeros((n, 1, 6))
    for e in range(n):
        i = at[e, 0]
        turn = so3.matrix((x[i + 3], x[i + 4], x[i + 5], x[i + 6]))
        a, b = turn[0, 0], turn[1, 0]
        residual[e, 0] = se2.wrap(np.arctan2(b, a) - measured[e, 0])
        square = max(a * a + b * b, 1e-18)  # 0 where the body points straight up: then there is no heading
        for k in range(2):  # turning about the body's y moves its x along -z, about its z along y
            da, db = (-turn[0, 2], -turn[1, 2]) if k == 0 else (turn[0, 1], turn[1, 1])
            jacobian[e, 0, 4 + k] = (a * db - b * da) / square
    return residual, jacobian


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


_POSE, _POINT = (SE2,), (R2,)
_POSE3, _POINT3 = (SE3,), (R3,)
RELATIVE_POSE = EdgeType("relative pose", (_POSE, _POSE), 3, 3, _relative_pose)
INVERSE_RELATIVE_POSE = EdgeType("inverse relative pose", (_POSE, _POSE), 3, 3, _inverse_relative_pose)
POSE_PRIOR = EdgeType("pose prior", (_POSE,), 3, 3, _pose_prior)
POSITION_PRIOR = EdgeType("position prior", (_POSE,), 4, 2, _position, (0.0, 0.0))
COORDINATE_PRIOR = EdgeType("coordinate prior", (_POSE,), 5, 1, _coordinate, (0.0, 0.0))
HEADING_PRIOR = EdgeType("heading prior", (_POSE,), 1, 1, _heading)
LANDMARK_POSITION = EdgeType("landmark position", (_POSE, _POINT), 2, 2, _landmark_position)
TAG_POSITION = EdgeType("tag position", (_POSE, _POSE), 2, 2, _tag_position)
RANGE_BEARING = EdgeType("range and bearing", (_POSE, _POINT), 5, 2, _range_and_bearing, se2.IDENTITY)
BEARING = EdgeType("bearing", (_POSE, _POINT), 4, 1, _bearing_only, se2.IDENTITY)
RANGE = EdgeType("range", (_POSE, _POINT), 4, 1, _range_only, se2.IDENTITY)
RANGE_WITH_OFFSET = EdgeType("range with offset", (_POSE, _POINT, (R1,)), 4, 1, _range_only, se2.IDENTITY)

RELATIVE_POSE_3D = EdgeType("relative pose 3D", (_POSE3, _POSE3), 7, 6, _relative_pose_3d)
POSE_PRIOR_3D = EdgeType("pose prior 3D", (_POSE3,), 7, 6, _pose_prior_3d)
POSITION_PRIOR_3D = EdgeType("position prior 3D", (_POSE3,), 6, 3, _position_3d, (0.0, 0.0, 0.0))
COORDINATE_PRIOR_3D = EdgeType("coordinate prior 3D", (_POSE3,), 7, 1, _coordinate_3d, (0.0, 0.0, 0.0))
ATTITUDE_PRIOR_3D = EdgeType("attitude prior 3D", (_POSE3,), 4, 3, _attitude_3d)
HEADING_PRIOR_3D = EdgeType("heading prior 3D", (_POSE3,), 1, 1, _heading_3d)
LANDMARK_POSITION_3D = EdgeType("landmark position 3D", (_POSE3, _POINT3), 3, 3, _landmark_position_3d)
TAG_POSITION_3D = EdgeType("tag position 3D", (_POSE3, _POSE3), 3, 3, _tag_position_3d)
RANGE_BEARING_3D = EdgeType("range and bearing 3D", (_POSE3, _POINT3), 10, 3, _range_and_bearing_3d, se3.IDENTITY)
BEARING_3D = EdgeType("bearing 3D", (_POSE3, _POINT3), 9, 2, _bearing_only_3d, se3.IDENTITY)
RANGE_3D = EdgeType("range 3D", (_POSE3, _POINT3), 8, 1, _range_only_3d, se3.IDENTITY)
RANGE_WITH_OFFSET_3D = EdgeType("range with offset 3D", (_POSE3, _POINT3, (R1,)), 8, 1, _range_only_3d, se3.IDENTITY)

DIFFERENCE = {k: EdgeType(f"difference {k.name}", ((k,), (k,)), k.dof, k.dof, _difference) for k in (R1, R2, R3)}
POINT_PRIOR = {k: EdgeType(f"prior {k.name}", ((k,),), k.dof, k.dof, _point_prior) for k in (R1, R2, R3)}
POINT_SEEN_FROM = {SE2: LANDMARK_POSITION, SE3: LANDMARK_POSITION_3D}
"""The edge type by which a pose of a kind sees where a point is."""
