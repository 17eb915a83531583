"""The search for the least cost of a measurement, against SciPy's with differences for derivatives."""

import numpy as np
import pytest
from rows import each
from scipy.optimize import least_squares

from graph_slam_ros import graph as g
from graph_slam_ros.graph import R2, SE2, SE3
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.solver.least_cost import least_cost

CASES = {
    "pose": (g.RELATIVE_POSE, (SE2, SE2)),
    "point": (g.LANDMARK_POSITION, (SE2, R2)),
    "bearing": (g.BEARING, (SE2, R2)),
    "space": (g.RELATIVE_POSE_3D, (SE3, SE3)),
}


def drawn(name, seed):
    """A graph of one edge whose vertices are badly known, and their root covariance."""
    rng = np.random.default_rng(seed)
    edge, kinds = CASES[name]
    identities = {SE2: np.array(se2.IDENTITY), SE3: np.array(se3.IDENTITY), R2: np.zeros(2)}
    graph = g.Graph()
    for kind in kinds:
        value = kind.retract(identities[kind][None], 2.0 * rng.standard_normal((1, kind.dof)))[0]
        graph.add_vertex(kind, value)
    measured = rng.standard_normal(edge.measured_size)
    if edge.measured_size == 7:
        measured[3:] /= np.linalg.norm(measured[3:])
    size = sum(kind.dof for kind in kinds)
    root_covariance = 0.7 * rng.standard_normal((size, size)) / np.sqrt(size)
    variances, axes = np.linalg.eigh(root_covariance @ root_covariance.T)
    root = np.triu(rng.uniform(0.5, 20.0, (edge.residual_size, edge.residual_size)))
    graph.add_edge(edge, range(len(kinds)), measured, g.Gaussian(root), "one")
    return graph, axes * np.sqrt(variances)


def costs(units, graph, sigmas):
    """The whitened step and the whitened residual."""
    step, moved, begin, edge = sigmas @ units, [], 0, graph.edge(0)
    for vertex in map(graph.vertex, edge.vertices):
        dof = vertex.kind.dof
        moved.append(vertex.kind.retract(vertex.initial[None], step[None, begin : begin + dof])[0])
        begin += dof
    residual = edge.type.linearize(np.concatenate(moved), graph.begins(None), edge.measured[None])[0][0]
    return np.concatenate((units, edge.sqrt_information @ residual))


@each("name", CASES)
def test_the_least_cost_is_that_of_scipy(name):
    for seed in range(8):
        graph, sigmas = drawn(name, seed)
        least = least_squares(costs, np.zeros(len(sigmas)), method="lm", xtol=1e-12, args=(graph, sigmas))
        found = least_cost(graph, graph.initial.values, graph.edge(0), sigmas @ sigmas.T)
        assert found == pytest.approx(2.0 * least.cost, rel=1e-4), (name, seed)
