"""An extended Kalman filter of a pose that moves along a stretch, and of all that is seen from there, as one kernel.

An observation that does not fit costs a fixed amount and changes nothing. Vertices are in the order of their last
observation, the last first: those that are not observed any more are the end of the covariance, and are let go.
"""

from math import log

import numpy as np

from graph_slam_ros.graph.records import call_native
from graph_slam_ros.graph.vertices import adjoint_of_inverse, append_motion, retract_at, right_jacobian_at
from graph_slam_ros.lie.jit import jitable, kernel
from graph_slam_ros.typing import Array, Index

_ROUNDING = 1e-6  # of a cost
_LINEAR_RAD = 0.1  # by which an observation turns the pose: beyond, it is linearised again
_MOST_LINEARIZATIONS = 5

# of an observation: where its parts begin, and their sizes; what it is of; vertices and columns that are kept
AT, ENDS, MEASURED, NUMBERS, RESIDUAL, COLUMNS, WIDTH, NOISE, WHAT, KEPT, KEPT_COLUMNS, FIELDS = range(12)
# of a vertex: where its stored numbers begin; its kind and degrees of freedom
STORED, CODE, DOF = range(3)
# sums: the shared error, cost and spread, and the number of observations that do not fit
SHARED, COST, SPREAD, UNFIT = range(4)
FINE, FAILED, TOO_MUCH = range(3)


@kernel
def filter_stretch(
    linearize: Index,
    observations: Index,
    begins: Index,
    numbers: Array,
    integers: Index,
    limits: Array,
    vertices: Index,
    motions: Array,
    noises: Array,
    variances: Array,
    shared: Array,
    jump: int,
    there: Array,
    first: int,
    without: int,
    most: float,
    scale: float,
    x: Array,
    covariance: Array,
    sums: Array,
    kept_x: Array,
    kept_covariance: Array,
    kept_sums: Array,
) -> int:
    """Filter a stretch from an edge on, in place. Returns whether a covariance failed, or the cost exceeded ``most``.

    Parameters
    ----------
    linearize : (e,) of each observation, its edge type's (``native``)
    observations : (e, FIELDS); begins : (n + 1,) the first of them after each edge
    numbers, integers : the parts of all observations, end to end
    limits : (e, 2) the cost of one that does not fit, and the logarithm of the determinant of its root information
    vertices : (v, 3) all that is seen, after the pose, in the order of ``x`` and of the covariance
    motions, noises : (n, size) and (n, dof, dof) of each edge
    variances, shared : (n, dof) of errors that are added, and sigmas of one that is the same in all
    jump : the edge across which the robot was moved ``there``; -1: it was not
    without : what is left out; -1: nothing
    scale : by which variances are divided
    x, covariance, sums : the state
    kept_x, kept_covariance, kept_sums : (n + 1, ...) get the state before each edge and at the end; of length 0: not
    """
    code, dof = vertices[0, CODE], vertices[0, DOF]
    for k in range(first, len(motions)):
        if sums[COST] > most + _ROUNDING:
            return TOO_MUCH
        begin, end = begins[k], begins[k + 1]
        size = observations[begin, KEPT_COLUMNS] if begin < len(observations) else dof + 1
        if len(kept_x):
            _keep(k, x, covariance, size, sums, kept_x, kept_covariance, kept_sums)
        moves = _moved(x, code, dof, motions[k], shared[k], sums[SHARED], k == jump, there)
        _propagate(covariance, size, moves, noises[k], variances[k], scale)
        for e in range(begin, end):
            if observations[e, WHAT] != without and not _observe(
                linearize[e], observations[e], numbers, integers, limits[e], vertices, scale, x, covariance, sums
            ):
                return FAILED
    if len(kept_x):
        _keep(len(motions), x, covariance, dof + 1, sums, kept_x, kept_covariance, kept_sums)
    return FINE


@kernel
def _keep(
    k: int,
    x: Array,
    covariance: Array,
    size: int,
    sums: Array,
    kept_x: Array,
    kept_covariance: Array,
    kept_sums: Array,
) -> None:
    """Store the state, as far as anything of it is seen from here on."""
    for i in range(len(x)):
        kept_x[k, i] = x[i]
    for i in range(len(sums)):
        kept_sums[k, i] = sums[i]
    for i in range(size):
        for j in range(size):
            kept_covariance[k, i, j] = covariance[i, j]


@kernel
def _moved(
    x: Array, code: int, dof: int, motion: Array, shared: Array, error: float, is_jump: bool, there: Array
) -> Array:
    """Move the pose along an edge.

    Returns (dof, dof + 1) from errors of the pose before, and the shared one, to errors of the pose after.
    """
    own = motion.copy()
    is_shared = False
    for i in range(dof):
        is_shared |= shared[i] != 0.0
    if is_shared:
        retract_at(own, 0, code, dof, shared * error, 0)
    append_motion(x, code, own)
    if is_jump:
        for i in range(len(there)):
            x[i] = there[i]
    moves, turned = np.empty((dof, dof + 1)), adjoint_of_inverse(code, own)
    for i in range(dof):
        for j in range(dof):
            moves[i, j] = turned[i, j]
        moves[i, dof] = shared[i]
    return moves


@kernel
def _propagate(covariance: Array, size: int, moves: Array, noise: Array, variances: Array, scale: float) -> None:
    """Move the covariance along an edge."""
    dof = len(moves)
    rows = np.zeros((dof, size))
    for i in range(dof):
        for j in range(dof + 1):
            by = moves[i, j]
            for c in range(size):
                rows[i, c] += by * covariance[j, c]
    for i in range(dof):
        for c in range(dof, size):
            covariance[i, c] = covariance[c, i] = rows[i, c]
    for i in range(dof):
        for c in range(dof):
            total = noise[i, c]
            for j in range(dof + 1):
                total += rows[i, j] * moves[c, j]
            covariance[i, c] = total
        covariance[i, i] += variances[i] / scale


@jitable
def _observe(
    linearize: int,
    one: Index,
    numbers: Array,
    integers: Index,
    limits: Array,
    vertices: Index,
    scale: float,
    x: Array,
    covariance: Array,
    sums: Array,
) -> bool:
    """Add an observation. The state follows it if it fits. Returns whether the covariance is positive definite.

    Where it turns the pose far, it is linearised again at the state to which it leads (an iterated filter).
    """
    m, size, code, dof = one[RESIDUAL], one[KEPT_COLUMNS], vertices[0, CODE], vertices[0, DOF]
    at = integers[one[AT] : one[AT] + one[ENDS]].reshape(1, one[ENDS])
    columns = integers[one[COLUMNS] : one[COLUMNS] + one[WIDTH]]
    measured = numbers[one[MEASURED] : one[MEASURED] + one[NUMBERS]].reshape(1, one[NUMBERS])
    noise = numbers[one[NOISE] : one[NOISE] + m * m].reshape(m, m)
    point, step, tangent, times = x, np.zeros(size), np.eye(dof), 0
    gain, root, white = np.zeros((m, size)), np.zeros((m, m)), np.zeros(m)
    while True:
        residual, jacobian = call_native(linearize, point, at, measured)
        if times:
            _turn(residual, jacobian, columns, step, tangent)
        if not _set_gain(residual, jacobian, columns, covariance, noise, gain, root, white):
            return False
        times += 1
        turned = _set_step(gain, white, step, dof // 2 if dof == 6 else dof - 1, dof)
        if turned <= _LINEAR_RAD:
            break
        point, tangent = _stepped(x, step, vertices, one[KEPT]), right_jacobian_at(code, dof, step, 0)
        if times == _MOST_LINEARIZATIONS:
            break
    statistic = _square(white) / scale
    if statistic > limits[0]:
        sums[COST] += limits[0]
        sums[UNFIT] += 1.0
        return True
    point = _stepped(x, step, vertices, one[KEPT])
    for i in range(len(x)):
        x[i] = point[i]
    sums[SHARED] += step[dof]
    _subtract(covariance, gain)
    if times > 1 or turned > _LINEAR_RAD:
        _turn_pose(covariance, size, tangent)  # of the pose that it leads to
    spread = 2.0 * (_log_diagonal(root) + limits[1])
    sums[COST] += statistic + spread
    sums[SPREAD] += spread
    return True


@kernel
def _turn(residual: Array, jacobian: Array, columns: Index, step: Array, tangent: Array) -> None:
    """Make of a linearisation at a step one over the errors before it."""
    m, width, dof = jacobian.shape[1], jacobian.shape[2], len(tangent)
    before = np.zeros(width)
    for a in range(m):
        for i in range(width):
            before[i] = jacobian[0, a, i]
        for i in range(width):
            if columns[i] < dof:
                total = 0.0
                for j in range(width):
                    if columns[j] < dof:
                        total += before[j] * tangent[columns[j], columns[i]]
                jacobian[0, a, i] = total
        for i in range(width):
            residual[0, a] -= jacobian[0, a, i] * step[columns[i]]


@kernel
def _set_gain(
    residual: Array,
    jacobian: Array,
    columns: Index,
    covariance: Array,
    noise: Array,
    gain: Array,
    root: Array,
    white: Array,
) -> bool:
    """Set the whitened innovation and its covariance with all errors; returns whether its own has a root."""
    m, size = gain.shape
    for a in range(m):
        for c in range(size):
            gain[a, c] = 0.0
        for i in range(len(columns)):
            by = jacobian[0, a, i]
            if by != 0.0:
                for c in range(size):
                    gain[a, c] += by * covariance[columns[i], c]
    for b in range(m):
        for a in range(b, m):
            total = noise[a, b]
            for i in range(len(columns)):
                total += gain[a, columns[i]] * jacobian[0, b, i]
            for k in range(b):
                total -= root[a, k] * root[b, k]
            if a == b and not total > 0.0:
                return False
            root[a, b] = np.sqrt(total) if a == b else total / root[b, b]
    for a in range(m):
        white[a] = residual[0, a]
        for k in range(a):
            by = root[a, k]
            white[a] -= by * white[k]
            for c in range(size):
                gain[a, c] -= by * gain[k, c]
        by = 1.0 / root[a, a]
        white[a] *= by
        for c in range(size):
            gain[a, c] *= by
    return True


@kernel
def _set_step(gain: Array, white: Array, step: Array, first: int, end: int) -> float:
    """Set the step of errors; returns by how much it differs from the one before, in these numbers."""
    change, before = 0.0, np.zeros(end)
    for i in range(end):
        before[i] = step[i]
    for c in range(len(step)):
        step[c] = 0.0
    for a in range(len(white)):
        for c in range(len(step)):
            step[c] -= white[a] * gain[a, c]
    for i in range(first, end):
        change = max(change, abs(step[i] - before[i]))
    return change


@kernel
def _stepped(x: Array, step: Array, vertices: Index, kept: int) -> Array:
    """Return the stored numbers after a step of errors, of the pose and the vertices that are kept."""
    out, first = x.copy(), 0
    for v in range(kept):
        retract_at(out, vertices[v, STORED], vertices[v, CODE], vertices[v, DOF], step, first)
        first += vertices[v, DOF] + (1 if v == 0 else 0)  # the shared error is after the pose
    return out


@kernel
def _subtract(covariance: Array, gain: Array) -> None:
    """Subtract what an observation tells from the covariance."""
    m, size = gain.shape
    for i in range(size):
        for a in range(m):
            by = gain[a, i]
            for c in range(size):
                covariance[i, c] -= by * gain[a, c]


@kernel
def _turn_pose(covariance: Array, size: int, tangent: Array) -> None:
    """Multiply the errors of the pose by a matrix."""
    dof = len(tangent)
    rows = np.zeros((dof, size))
    for i in range(dof):
        for j in range(dof):
            for c in range(size):
                rows[i, c] += tangent[i, j] * covariance[j, c]
    for i in range(dof):
        for c in range(dof, size):
            covariance[i, c] = covariance[c, i] = rows[i, c]
    for i in range(dof):
        for c in range(dof):
            covariance[i, c] = 0.0
            for j in range(dof):
                covariance[i, c] += rows[i, j] * tangent[c, j]


@kernel
def _square(white: Array) -> float:
    """Return the sum of squares."""
    total = 0.0
    for a in range(len(white)):
        total += white[a] * white[a]
    return total


@kernel
def _log_diagonal(root: Array) -> float:
    """Return the logarithm of the product of the diagonal."""
    product = 1.0
    for a in range(len(root)):
        product *= root[a, a]
    return log(product)
