"""The search for the least cost of a measurement, against SciPy's."""

import numpy as np
import pytest
from rows import each
from scipy.optimize import least_squares

from graph_slam_ros.graph import BEARING, LANDMARK_POSITION, R2, RELATIVE_POSE, RELATIVE_POSE_3D, SE2, SE3
from graph_slam_ros.graph.native import native_or_plain
from graph_slam_ros.graph.retraction import code_of
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.solver.least_cost import least_cost

CASES = {
    "pose": (RELATIVE_POSE, (SE2, SE2)),
    "point": (LANDMARK_POSITION, (SE2, R2)),
    "bearing": (BEARING, (SE2, R2)),
    "space": (RELATIVE_POSE_3D, (SE3, SE3)),
}


def drawn(name, seed):
    """An edge with vertices that are badly known: stored numbers, where they begin, and what the search is given."""
    rng = np.random.default_rng(seed)
    edge, kinds = CASES[name]
    identities = {SE2: np.array(se2.IDENTITY), SE3: np.array(se3.IDENTITY), R2: np.zeros(2)}
    values = [k.retract(identities[k][None], 2.0 * rng.standard_normal((1, k.dof)))[0] for k in kinds]
    measured = rng.standard_normal(edge.measured_size)
    if edge.measured_size == 7:
        measured[3:] /= np.linalg.norm(measured[3:])
    size = sum(k.dof for k in kinds)
    sigmas = 0.7 * rng.standard_normal((size, size)) / np.sqrt(size)
    root = np.triu(rng.uniform(0.5, 20.0, (edge.residual_size, edge.residual_size)))
    at = np.cumsum([0, *(k.size for k in kinds[:-1])])[None]
    return edge, kinds, np.concatenate(values), at, measured[None], root, sigmas


def searched(edge, kinds, x, at, measured, root, sigmas, linearize=None, most=10_000):
    search, (by,) = native_or_plain(least_cost, [linearize or edge.linearize])
    codes, dofs = np.array([code_of(k) for k in kinds]), np.array([k.dof for k in kinds])
    return search(by, x, at, measured, root, sigmas, codes, dofs, most)


def costs(units, edge, kinds, x, at, measured, root, sigmas):
    """The whitened step and the whitened residual."""
    step, moved, begin = sigmas @ units, [], 0
    for k, first in zip(kinds, at[0], strict=True):
        moved.append(k.retract(x[None, first : first + k.size], step[None, begin : begin + k.dof])[0])
        begin += k.dof
    residual = edge.linearize(np.concatenate(moved), at, measured)[0][0]
    return np.concatenate((units, root @ residual))


@each("name", CASES)
def test_the_least_cost_is_that_of_scipy(name):
    for seed in range(8):
        case = drawn(name, seed)
        least = least_squares(costs, np.zeros(len(case[-1])), method="lm", xtol=1e-12, args=case)
        assert searched(*case) == pytest.approx(2.0 * least.cost, rel=1e-4), (name, seed)
