"""The filter in which hypotheses on odometry are compared, on its own."""

import numpy as np
from scipy.optimize import least_squares

from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.lie import se2
from graph_slam_ros.slam.robust.odometry_filter import Errors, OdometryFilter, Stretch

STEP, LANDMARK = (2.0, 0.0, 0.2), (15.0, 4.0)
ODOMETRY = np.diag([0.2, 0.05, 0.35]) ** 2
PRIOR = np.diag([0.05, 0.05, 0.02, 0.1, 0.1]) ** 2  # of the first pose and the landmark
SIGMA_M = 0.2


def test_a_turn_beyond_what_is_linear_ends_where_least_squares_has_it():
    """Odometry turned half a radian too little, 1.4 sigma: linear at its heading, a landmark would not fit."""
    graph = Graph()
    first, last = graph.add_vertex(PLANAR.pose, se2.IDENTITY), graph.add_vertex(PLANAR.pose, STEP)
    landmark = graph.add_vertex(PLANAR.point, LANDMARK)
    seen = np.array(se2.act(se2.inverse((2.0, 0.0, 0.7)), LANDMARK))
    link = graph.add_edge(PLANAR.relative_pose, (first, last), STEP, Gaussian.from_covariance(ODOMETRY), "odometry")
    noise = Gaussian.from_covariance(SIGMA_M**2 * np.eye(2))
    edge = graph.add_edge(PLANAR.sightings["position"], (last, landmark), seen, noise, "landmarks")
    stretch = Stretch([link], {last: [(edge, landmark)]}, np.ones(3), 1.0)
    filtered = OdometryFilter(PLANAR, graph, lambda _: (np.array([*se2.IDENTITY, *LANDMARK]), PRIOR), stretch)
    none = np.zeros((1, 3))
    end = filtered._filtered(filtered._start, 0, Errors(none, none), filtered.size)

    root = np.linalg.cholesky(np.linalg.inv(se2.propagate(PRIOR[:3, :3].copy(), STEP, ODOMETRY))).T

    def costs(numbers):
        pose, point = se2.retract(STEP, tuple(numbers[:3])), np.array(LANDMARK) + numbers[3:]
        residual = (np.array(se2.act(se2.inverse(pose), tuple(point))) - seen) / SIGMA_M
        return np.concatenate((root @ numbers[:3], numbers[3:] / 0.1, residual))

    least = least_squares(costs, np.zeros(5))
    assert end.unfit == 0
    assert least.cost < 2.0
    assert np.abs(end.x[:3] - se2.retract(STEP, tuple(least.x[:3]))).max() < 2e-3
    covariance = np.linalg.inv(least.jac.T @ least.jac)[:3, :3]
    tangent = se2.right_jacobian(tuple(least.x[:3]))
    assert np.abs(end.covariance[:3, :3] - tangent @ covariance @ tangent.T).max() < 0.05 * covariance.max()
