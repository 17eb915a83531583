"""The filter in which hypotheses on odometry are compared, on its own."""

import numpy as np
import pytest

from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.lie import se2
from graph_slam_ros.slam.doubt.evidence import Hypothesis, Stretch

LINKS, NOISE_FACTOR, SLIPPED = 6, 1.5, 2


def drive(seed):
    """Links of little noise, landmarks seen for a while: graph, edges, what is seen by keyframe, the stored prior."""
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
            edge = graph.add_edge(PLANAR.sightings["position"], (vertices[k + 1], landmarks[j]), at, sharp, "landmarks")
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


def dense_cost(graph, links, seen, joint, ids, variances):
    """Minus twice the logarithm of the likelihood of all that was seen, by one covariance of all of it."""
    vertices, landmarks = ids
    sources = 11 + 6 * LINKS  # the prior, odometry's noise, and the other errors
    covariance = np.zeros((sources, sources))
    covariance[:11, :11] = joint
    scale = NOISE_FACTOR**2
    pose, of_pose = np.array(se2.IDENTITY), np.zeros((3, sources))
    of_pose[:, :3] = np.eye(3)
    residuals, rows, noises = [], [], []
    for k, link in enumerate(links):
        one = graph.edge(link)
        own, other = slice(11 + 3 * k, 14 + 3 * k), slice(11 + 3 * (LINKS + k), 14 + 3 * (LINKS + k))
        covariance[own, own] = np.linalg.inv(one.sqrt_information.T @ one.sqrt_information)
        covariance[other, other] = np.diag(variances[k]) / scale
        of_pose = se2.adjoint(se2.inverse(tuple(one.measured))) @ of_pose
        of_pose[:, own] = of_pose[:, other] = np.eye(3)
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


def test_the_likelihood_ratio_is_that_of_one_covariance_of_all_that_was_seen():
    variances = 1e-8 * np.array([4.0, 1.0, 3.0]) * (np.arange(LINKS) >= SLIPPED)[:, None]
    for seed in range(3):
        graph, links, seen, ids, joint = drive(seed)
        prior = prior_of(graph, joint, ids[1])
        stretch = Stretch(PLANAR, graph, [graph.edge(link) for link in links], seen, prior, np.ones(3), NOISE_FACTOR)
        costs = [dense_cost(graph, links, seen, joint, ids, added) for added in (0.0 * variances, variances)]
        _, log_ratio = stretch.likeliest([Hypothesis(variances, kind="translation", first=SLIPPED)])
        assert 2.0 * log_ratio == pytest.approx(costs[0] - costs[1], abs=2e-3)
