"""The least cost of a measurement over steps of its vertices, where it is too far from linear to be computed at once.

It is MINPACK's ``lmder`` (J. J. More, "The Levenberg-Marquardt algorithm: implementation and theory", 1978) on normal
equations: the steps themselves are part of the cost, so these are well conditioned.
"""

import numpy as np

from graph_slam_ros.graph.native import call_native
from graph_slam_ros.graph.retraction import retract_at, right_jacobian_at
from graph_slam_ros.lie.jit import jitable, kernel
from graph_slam_ros.typing import Array, Index

_CONVERGED = 1e-6  # of costs and steps: where they change less, a search has ended
_FIRST = 100.0  # length of the first step at most, in units of what a step changes
_TRIALS = 10  # of a damping


@kernel
def least_cost(
    linearize: int,
    x: Array,
    at: Index,
    measured: Array,
    root: Array,
    sigmas: Array,
    codes: Index,
    dofs: Index,
    most: int,
) -> float:
    """Return the minimum of ``|u|^2 + |R r(x [+] L u)|^2`` that is found from ``u = 0``.

    Parameters
    ----------
    linearize : the edge type's (``native``)
    x : stored numbers of the vertices, end to end; at : (1, k) where they begin; codes, dofs : (k,) of each
    measured : (1, p); root : (m, m) R; sigmas : (D, D) L
    most : evaluations, of which a derivative counts as D
    """
    size = len(sigmas)
    units, white, slope = np.zeros(size), np.zeros(len(root)), np.zeros((len(root), size))
    cost = _evaluated(linearize, x, at, measured, root, sigmas, codes, dofs, units, white, slope)
    normal, gradient, scale = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    tried, tried_white, tried_slope = np.zeros(size), np.zeros(len(root)), np.zeros((len(root), size))
    step, radius, damping, least, count = np.zeros(size), 0.0, 0.0, cost, 1
    while count < most and cost > 0.0 and np.isfinite(cost):
        _set_normal(units, white, slope, normal, gradient)
        count += size
        flat = 0.0
        for i in range(size):
            width = np.sqrt(normal[i, i])
            flat = max(flat, abs(gradient[i]) / (width * np.sqrt(cost)))
            scale[i] = max(scale[i], width)
        if flat <= _CONVERGED:
            break
        is_first, ratio = radius == 0.0, 0.0
        radius = _FIRST if is_first else radius
        while ratio < 1e-4 and count < most:
            damping = _damped(normal, gradient, scale, radius, damping, step)
            length, bent = _length(scale, step), _quadratic(normal, step) / cost
            radius = min(radius, length) if is_first else radius
            for i in range(size):
                tried[i] = units[i] + step[i]
            new = _evaluated(linearize, x, at, measured, root, sigmas, codes, dofs, tried, tried_white, tried_slope)
            count += 1
            least = min(least, new)
            actual = 1.0 - new / cost if new < 100.0 * cost else -1.0
            damped = damping * length * length / cost
            expected = bent + 2.0 * damped
            ratio = actual / expected if expected > 0.0 else 0.0
            radius, damping = _trusted(ratio, actual, -(bent + damped), radius, damping, length)
            if abs(actual) <= _CONVERGED and expected <= _CONVERGED and ratio <= 2.0:
                return least
            if ratio >= 1e-4:
                cost, units, tried = new, tried, units
                white, tried_white, slope, tried_slope = tried_white, white, tried_slope, slope
            if radius <= _CONVERGED * _length(scale, units):
                return least
    return least


@jitable
def _evaluated(
    linearize: int,
    x: Array,
    at: Index,
    measured: Array,
    root: Array,
    sigmas: Array,
    codes: Index,
    dofs: Index,
    units: Array,
    white: Array,
    slope: Array,
) -> float:
    """Return the cost at some units of a step; sets the whitened residual (m,) and its derivative (m, D)."""
    moved, step, first = x.copy(), np.zeros(len(units)), 0
    for i in range(len(units)):
        for j in range(len(units)):
            step[i] += sigmas[i, j] * units[j]
    for k in range(len(codes)):
        retract_at(moved, at[0, k], codes[k], dofs[k], step, first)
        first += dofs[k]
    residual, jacobian = call_native(linearize, moved, at, measured)
    return float(_whitened(residual, jacobian, root, sigmas, codes, dofs, units, step, white, slope))


@kernel
def _whitened(
    residual: Array,
    jacobian: Array,
    root: Array,
    sigmas: Array,
    codes: Index,
    dofs: Index,
    units: Array,
    step: Array,
    white: Array,
    slope: Array,
) -> float:
    """Whiten a residual and its derivative over the units, and return the cost."""
    m, size = slope.shape
    of_step, first = np.zeros((m, size)), 0
    for k in range(len(codes)):
        tangent = right_jacobian_at(codes[k], dofs[k], step, first)
        for a in range(m):
            for b in range(m):
                for i in range(dofs[k]):
                    by = root[a, b] * jacobian[0, b, first + i]
                    for j in range(dofs[k]):
                        of_step[a, first + j] += by * tangent[i, j]
        first += dofs[k]
    cost = 0.0
    for i in range(size):
        cost += units[i] * units[i]
    for a in range(m):
        white[a] = 0.0
        for b in range(m):
            white[a] += root[a, b] * residual[0, b]
        cost += white[a] * white[a]
        for j in range(size):
            slope[a, j] = 0.0
        for i in range(size):
            for j in range(size):
                slope[a, j] += of_step[a, i] * sigmas[i, j]
    return cost


@kernel
def _set_normal(units: Array, white: Array, slope: Array, normal: Array, gradient: Array) -> None:
    """Set the normal matrix (D, D) and the gradient (D,) of half of the cost."""
    m, size = slope.shape
    for i in range(size):
        gradient[i] = units[i]
        for a in range(m):
            gradient[i] += slope[a, i] * white[a]
        for j in range(size):
            normal[i, j] = 1.0 if i == j else 0.0
            for a in range(m):
                normal[i, j] += slope[a, i] * slope[a, j]


@kernel
def _trusted(
    ratio: float, actual: float, sloping: float, radius: float, damping: float, length: float
) -> tuple[float, float]:
    """Return the next radius and damping, by the part of the expected change of the cost that a step has made.

    Parameters
    ----------
    actual : change of the cost, as a part of it, -1 where it rose a hundredfold; sloping : what its slope says
    length : of the step
    """
    if ratio <= 0.25:
        part = 0.5 if actual >= 0.0 else 0.5 * sloping / (sloping + 0.5 * actual)
        part = 0.1 if part < 0.1 or actual == -1.0 else part
        return part * min(radius, 10.0 * length), damping / part
    if damping == 0.0 or ratio >= 0.75:
        return 2.0 * length, 0.5 * damping
    return radius, damping


@kernel
def _damped(normal: Array, gradient: Array, scale: Array, radius: float, damping: float, step: Array) -> float:
    """Set the step that is at most a tenth longer than the radius, and return the damping that makes it so."""
    size = len(gradient)
    root, turned = np.zeros((size, size)), np.zeros(size)
    _factor(normal, scale, 0.0, root)
    _solve(root, gradient, step)
    length = _length(scale, step)
    beyond = length - radius
    if beyond <= 0.1 * radius:
        return 0.0
    steep = 0.0
    for i in range(size):
        turned[i] = scale[i] * scale[i] * step[i] / length
        steep += (gradient[i] / scale[i]) ** 2
    low, high = beyond / radius / _forward(root, turned), np.sqrt(steep) / radius
    damping = min(max(damping, low), high)
    if damping == 0.0:
        damping = np.sqrt(steep) / length
    for _ in range(_TRIALS):
        damping = max(damping, 1e-3 * high) if damping == 0.0 else damping
        _factor(normal, scale, damping, root)
        _solve(root, gradient, step)
        length, before = _length(scale, step), beyond
        beyond = length - radius
        if abs(beyond) <= 0.1 * radius or (low == 0.0 and beyond <= before and before < 0.0):
            break
        for i in range(size):
            turned[i] = scale[i] * scale[i] * step[i] / length
        change = beyond / radius / _forward(root, turned)
        if beyond > 0.0:
            low = max(low, damping)
        if beyond < 0.0:
            high = min(high, damping)
        damping = max(low, damping + change)
    return damping


@kernel
def _factor(normal: Array, scale: Array, damping: float, root: Array) -> None:
    """Set the lower Cholesky root of ``N + damping diag(scale)^2``."""
    for j in range(len(root)):
        for i in range(j, len(root)):
            s = normal[i, j]
            if i == j:
                s += damping * scale[i] * scale[i]
            for k in range(j):
                s -= root[i, k] * root[j, k]
            root[i, j] = np.sqrt(s) if i == j else s / root[j, j]


@kernel
def _solve(root: Array, gradient: Array, step: Array) -> None:
    """Set the step ``-(L L')^-1 g``."""
    size = len(step)
    for i in range(size):
        s = -gradient[i]
        for k in range(i):
            s -= root[i, k] * step[k]
        step[i] = s / root[i, i]
    for i in range(size - 1, -1, -1):
        s = step[i]
        for k in range(i + 1, size):
            s -= root[k, i] * step[k]
        step[i] = s / root[i, i]


@kernel
def _forward(root: Array, given: Array) -> float:
    """Return the square of ``L^-1 given``, which it overwrites."""
    square = 0.0
    for i in range(len(given)):
        for k in range(i):
            given[i] -= root[i, k] * given[k]
        given[i] /= root[i, i]
        square += given[i] * given[i]
    return square


@kernel
def _length(scale: Array, step: Array) -> float:
    """Return the length of a step in units of what it changes."""
    square = 0.0
    for i in range(len(step)):
        square += (scale[i] * step[i]) ** 2
    return float(np.sqrt(square))


@kernel
def _quadratic(normal: Array, step: Array) -> float:
    """Return ``p' N p``."""
    total = 0.0
    for i in range(len(step)):
        for j in range(len(step)):
            total += step[i] * normal[i, j] * step[j]
    return total
