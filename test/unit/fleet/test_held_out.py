"""The held-out likelihood against dense linear algebra, and where it is best."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from graph_slam_ros.graph import R2, Gaussian, Graph
from graph_slam_ros.graph.edges import DIFFERENCE, POINT_PRIOR
from graph_slam_ros.solver import Solver
from graph_slam_ros.tools.fleet.held_out import STRETCH_NS, predict

STEP, SEEN = 0.1, 0.05  # true noise of a step and of a sighting
LANDMARKS = np.array([[0.0, 2.0], [4.0, -1.0], [8.0, 2.0]])


class Walk:
    """A walk of positions among three landmarks: a linear problem with Gaussian noise."""

    def __init__(self, poses, seed, step=STEP, seen=SEEN):
        rng, d = np.random.default_rng(seed), DIFFERENCE[R2]
        true = np.cumsum(np.tile([0.2, 0.0], (poses, 1)), axis=0)
        self.graph = graph = Graph()
        at, marks = graph.add_vertices(R2, true), graph.add_vertices(R2, LANDMARKS)
        self.rows = []  # of the whole: columns, measured, sigma, stretch or -1
        self._add(POINT_PRIOR[R2], (at[0],), true[0], 1e-3, "prior")
        for a, b in pairwise(at):
            moved = true[b] - true[a] + STEP * rng.standard_normal(2)
            self._add(d, (a, b), moved, step, "odometry")
        edges, stamps = [], []
        for k, pose in enumerate(at.tolist()):
            for mark in marks.tolist():
                z = LANDMARKS[mark - marks[0]] - true[pose] + SEEN * rng.standard_normal(2)
                stamps.append(k * 10**9)
                edges.append(self._add(d, (pose, mark), z, seen, "landmarks", stamps[-1] // STRETCH_NS))
        self.edges, self.stamps = np.array(edges), np.array(stamps)
        self.solver = Solver(graph)
        self.solver.add(range(graph.vertex_count), range(graph.edge_count))
        self.solver.optimize()

    def _add(self, kind, ends, measured, sigma, label, stretch=-1):
        self.rows.append((ends, measured, sigma, stretch))
        return self.graph.add_edge(kind, ends, measured, Gaussian.from_sigmas(sigma, sigma), label)

    def nats(self, outliers=0.0):
        return predict(self.graph, self.solver, self.edges, self.stamps, outliers)

    def dense(self, halves):
        """The same by conditioning one large Gaussian: that of everything measured, from a wide prior."""
        n, total = 2 * self.graph.vertex_count, 0.0
        for out in (0, 1):
            kept = [r for r in self.rows if r[3] < 0 or halves(r[3]) != out]
            a, z, noise = self._stacked(kept, n)
            information = a.T @ (a / noise[:, None])
            mean, cov = np.linalg.solve(information, a.T @ (z / noise)), np.linalg.inv(information)
            b, y, own = self._stacked([r for r in self.rows if r[3] >= 0 and halves(r[3]) == out], n)
            total -= multivariate_normal.logpdf(y, b @ mean, b @ cov @ b.T + np.diag(own))
        return total

    @staticmethod
    def _stacked(rows, n):
        a, z, noise = np.zeros((2 * len(rows), n)), np.zeros(2 * len(rows)), np.zeros(2 * len(rows))
        for k, (ends, measured, sigma, _) in enumerate(rows):
            for sign, end in zip((1.0,) if len(ends) == 1 else (-1.0, 1.0), ends, strict=True):
                a[2 * k : 2 * k + 2, 2 * end : 2 * end + 2] = sign * np.eye(2)
            z[2 * k : 2 * k + 2], noise[2 * k : 2 * k + 2] = measured, sigma**2
        return a, z, noise


def test_it_is_the_density_of_what_is_left_out_given_the_rest():
    from graph_slam_ros.tools.fleet.held_out import _half

    walk = Walk(40, seed=1)
    found = walk.nats()
    assert found.sightings == 120
    assert found.nats == pytest.approx(walk.dense(_half), rel=1e-6)


@pytest.mark.parametrize("which", ["step", "seen"])
def test_the_true_noise_predicts_best(which):
    factors = (0.33, 0.7, 1.0, 1.5, 3.0)
    true = {"step": STEP, "seen": SEEN}
    found = [Walk(150, seed=2, **{which: factor * true[which]}).nats(0.01).nats for factor in factors]
    assert int(np.argmin(found)) == 2, found
    assert found[0] > found[2] + 10.0, "a factor of three is many nats away"
    assert found[4] > found[2] + 10.0


def test_what_is_refused_counts_as_an_outlier_whatever_it_says():
    walk = Walk(40, seed=3)
    before = walk.nats(0.01)
    edge = int(walk.edges[7])
    walk.graph.set_weights(np.array([edge]), 0.0)
    walk.solver.rebuild()
    walk.solver.optimize()
    after = walk.nats(0.01)
    assert after.sightings == before.sightings
    assert 8.0 < after.nats - before.nats < 16.0


def test_a_landmark_that_is_seen_once_only_predicts_nothing():
    walk = Walk(40, seed=4)
    before = walk.nats(0.01)
    lone = walk.graph.add_vertex(R2, (5.0, 5.0))
    edge = walk.graph.add_edge(DIFFERENCE[R2], (3, lone), (4.2, 5.0), Gaussian.from_sigmas(SEEN, SEEN), "landmarks")
    walk.solver.add([lone], [edge])
    walk.solver.optimize()
    walk.edges, walk.stamps = np.append(walk.edges, edge), np.append(walk.stamps, 3 * 10**9)
    after = walk.nats(0.01)
    assert (after.sightings, after.nats) == pytest.approx((before.sightings, before.nats), rel=1e-6)
