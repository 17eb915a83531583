"""The filter in which hypotheses on odometry are compared, on its own."""

from dataclasses import replace

import numpy as np
import pytest
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
    end = filtered._filtered(0, Errors(none, none))

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


LINKS, NOISE_FACTOR, SLIPPED = 6, 1.5, 2


def drive(edge_type, seed):
    """Links whose noise is so small that all is linear, and landmarks of which each is seen for a while.

    Returns the graph, the edges, what was seen by keyframe, the stored numbers and covariance of the prior.
    """
    rng, graph = np.random.default_rng(seed), Graph()
    noise = Gaussian.from_covariance(1e-8 * np.diag([1.0, 2.0, 0.5]))
    poses = [se2.IDENTITY]
    for _ in range(LINKS):
        poses.append(se2.compose(poses[-1], (1.0, 0.1, 0.3)))
    vertices = [graph.add_vertex(PLANAR.pose, pose) for pose in poses]
    points = rng.uniform(-3.0, 3.0, (4, 2))
    landmarks = [graph.add_vertex(PLANAR.point, point) for point in points]
    links, seen = [], {}
    for k in range(LINKS):
        measured = se2.retract((1.0, 0.1, 0.3), tuple(1e-4 * rng.standard_normal(3)))
        links.append(graph.add_edge(PLANAR.relative_pose, vertices[k : k + 2], measured, noise, "odometry"))
        for j in range(k // 2, min(4, k // 2 + 2)):
            at = np.array(se2.act(se2.inverse(poses[k + 1]), points[j])) + 1e-4 * rng.standard_normal(2)
            sharp = Gaussian.from_covariance(1e-8 * np.diag([1.0, 1.5]))
            edge = graph.add_edge(edge_type, (vertices[k + 1], landmarks[j]), at, sharp, "landmarks")
            seen.setdefault(vertices[k + 1], []).append((edge, landmarks[j]))
    root = 1e-4 * rng.standard_normal((11, 11)) / 3.0
    return graph, links, seen, (vertices, landmarks), root @ root.T + 1e-9 * np.eye(11)


def prior_of(graph, joint, landmarks):
    """A function of vertices, as the filter asks for it: the first pose, and landmarks in any order."""

    def prior(asked):
        columns = [0, 1, 2]
        for vertex in asked[1:]:
            first = 3 + 2 * landmarks.index(vertex)
            columns += [first, first + 1]
        values = np.concatenate([graph.initial.values[graph.vertex(vertex).stored] for vertex in asked])
        return values, joint[np.ix_(columns, columns)]

    return prior


def dense_cost(graph, links, seen, joint, ids, errors):
    """Minus twice the logarithm of the likelihood of all that was seen, by one covariance of all of it."""
    vertices, landmarks = ids
    sources = 11 + 3 * LINKS + 1 + 3 * LINKS  # the prior, odometry's noise, the shared error and the other errors
    covariance = np.zeros((sources, sources))
    covariance[:11, :11] = joint
    scale = NOISE_FACTOR**2
    covariance[11 + 3 * LINKS, 11 + 3 * LINKS] = 1.0 / scale
    pose, of_pose = np.array(se2.IDENTITY), np.zeros((3, sources))
    of_pose[:, :3] = np.eye(3)
    residuals, rows, noises = [], [], []
    for k, link in enumerate(links):
        one = graph.edge(link)
        own, other = slice(11 + 3 * k, 14 + 3 * k), slice(12 + 3 * (LINKS + k), 15 + 3 * (LINKS + k))
        covariance[own, own] = np.linalg.inv(one.sqrt_information.T @ one.sqrt_information)
        covariance[other, other] = np.diag(errors.variances[k]) / scale
        of_pose = se2.adjoint(se2.inverse(tuple(one.measured))) @ of_pose
        of_pose[:, own] = of_pose[:, other] = np.eye(3)
        of_pose[:, 11 + 3 * LINKS] += errors.shared[k]
        pose = np.array(se2.compose(tuple(pose), tuple(one.measured)))
        for edge, landmark in seen.get(vertices[k + 1], ()):
            sighting, first = graph.edge(edge), 3 + 2 * landmarks.index(landmark)
            x = np.concatenate((pose, graph.initial.values[graph.vertex(landmark).stored]))
            at = np.array([[0, 3]])
            residual, jacobian = PLANAR.sightings["position"].linearize(x, at, sighting.measured[None])
            row = jacobian[0][:, :3] @ of_pose
            row[:, first : first + 2] += jacobian[0][:, 3:]
            root = sighting.sqrt_information
            residuals.append(root @ residual[0])
            rows.append(root @ row)
            noises += [1.0, 1.0]
    all_rows, white = np.vstack(rows), np.concatenate(residuals)
    joint_of_all = all_rows @ covariance @ all_rows.T + np.diag(noises)
    return white @ np.linalg.solve(joint_of_all, white) / scale + np.linalg.slogdet(joint_of_all)[1]


def test_the_likelihood_is_that_of_one_covariance_of_all_that_was_seen():
    """With odometry's own noise, with more of it, and with an error that edges share."""
    none = np.zeros((LINKS, 3))
    is_part = (np.arange(LINKS) >= SLIPPED)[:, None]
    several = [
        Errors(none, none),
        Errors(1e-8 * np.array([4.0, 1.0, 3.0]) * is_part, none),
        Errors(1e-8 * np.array([4.0, 1.0, 3.0]) * is_part, 1e-4 * np.array([2.0, 0.5, 1.0]) * is_part),
    ]
    for seed in range(5):
        graph, links, seen, ids, joint = drive(PLANAR.sightings["position"], seed)
        stretch = Stretch(links, seen, np.ones(3), NOISE_FACTOR)
        filtered = OdometryFilter(PLANAR, graph, prior_of(graph, joint, ids[1]), stretch)
        for errors, first in zip(several, (LINKS, SLIPPED, SLIPPED), strict=True):
            expected = dense_cost(graph, links, seen, joint, ids, errors)
            assert -2.0 * filtered.log_likelihood(errors, first) == pytest.approx(expected, abs=2e-3)
        assert filtered._before(LINKS).unfit == 0


def test_an_edge_type_in_plain_python_gives_the_same_likelihood():
    """It is called from plain Python then, with the same formulas."""
    seen_from = PLANAR.sightings["position"]
    plain = replace(seen_from, linearize=lambda *given: seen_from.linearize(*given))
    found = []
    for edge_type in (seen_from, plain):
        graph, links, seen, ids, joint = drive(edge_type, 1)
        stretch = Stretch(links, seen, np.ones(3), NOISE_FACTOR)
        filtered = OdometryFilter(PLANAR, graph, prior_of(graph, joint, ids[1]), stretch)
        wide = np.full((LINKS, 3), 1e-8)
        found.append(
            [filtered.log_likelihood(Errors(wide, wide), k, what) for k, what in ((LINKS, None), (0, ids[1][1]))]
        )
    assert found[0] == pytest.approx(found[1], rel=1e-12)
