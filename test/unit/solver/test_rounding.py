"""Pivots and their rounding: the magnitudes that cancelled, against dense algebra, and how much is walked for them."""

import numpy as np
import pytest

from graph_slam_ros.graph import LANDMARK_POSITION, POSE_PRIOR, R2, RELATIVE_POSE, SE2, Gaussian, Graph
from graph_slam_ros.lie import se2
from graph_slam_ros.solver import Solver
from graph_slam_ros.solver.clique_tree.pools import compact
from graph_slam_ros.solver.clique_tree.rounding import KEPT, magnitude_of
from graph_slam_ros.solver.clique_tree.storage import (
    AFFECTED,
    CHECKED,
    CLIQUES,
    DOF,
    FRONT,
    FRONTALS,
    MAGNITUDES,
    MEMBERS,
    STEP,
    with_room,
)
from graph_slam_ros.solver.clique_tree.symbolic import mark

ANCHOR = Gaussian.from_sigmas(0.01, 0.01, 0.01)


class Drive:
    """Pose after pose, each updated; measurements are exact, so the estimate is the linearisation point."""

    def __init__(self, sigmas):
        self.graph, self.noise = Graph(), Gaussian.from_sigmas(*sigmas)
        self.solver, self.path = Solver(self.graph), {self.graph.add_vertex(SE2, (0.0, 0.0, 0.0)): (0.0, 0.0, 0.0)}
        self.solver.add([0], [self.graph.add_edge(POSE_PRIOR, [0], (0, 0, 0), ANCHOR, "anchor")])

    def relative(self, i, j):
        return self.graph.add_edge(
            RELATIVE_POSE, [i, j], se2.between(self.path[i], self.path[j]), self.noise, "odometry"
        )

    def on(self, step, *closures):
        before = max(self.path)
        pose = se2.compose(self.path[before], step)
        new = self.graph.add_vertex(SE2, pose)
        self.path[new] = pose
        self.solver.add([new], [self.relative(i, new) for i in (before, *closures)])
        self.solver.update()
        return new


def test_a_magnitude_is_that_of_dense_algebra_walked_or_kept():
    rng, drive = np.random.default_rng(3), Drive((0.05, 0.02, 0.01))
    point = drive.graph.add_vertex(R2, (3.0, 2.0))
    for k in range(120):
        closures = rng.choice([v for v in drive.path if 1 < v < max(drive.path) - 3], 1) if k % 9 == 8 else ()
        pose = drive.on((1.0, 0.1, 0.4 * rng.standard_normal()), *closures)
        if k % 5 == 0:
            seen = se2.act(se2.inverse(drive.path[pose]), (3.0, 2.0))
            noise = Gaussian.from_sigmas(0.3, 0.1)
            edge = drive.graph.add_edge(LANDMARK_POSITION, [pose, point], seen, noise, "landmarks")
            drive.solver.add([point] if k == 0 else [], [edge])
    drive.solver.update()
    t, h = drive.solver._tree, drive.solver.information_matrix()
    t = with_room(t, forms=len(t.fronts))
    cliques = mark(t, np.arange(drive.graph.vertex_count))
    frontals = [t.members[low : low + n] for low, n in t.clique[cliques][:, [MEMBERS, FRONTALS]].tolist()]
    of = [np.arange(t.vertex[v, STEP], t.vertex[v, STEP] + t.vertex[v, DOF]) for v in np.concatenate(frontals)]
    order, place = np.concatenate(of), 0
    h = h[np.ix_(order, order)]
    x = np.linalg.inv(np.linalg.cholesky(h)).T  # in column p what precedes the p-th unknown follows it
    expected = h.diagonal() @ (x / x.diagonal()) ** 2
    for c, mine in zip(cliques, frontals, strict=True):
        for row in range(int(t.vertex[mine, DOF].sum())):
            for _ in range(2):
                assert magnitude_of(t, c, row) == pytest.approx(expected[place], rel=1e-9)
            place += 1
    assert place == len(order)
    assert len(cliques) > 15
    assert (t.clique[cliques, MAGNITUDES] == KEPT).all()
    before = t.clique[cliques, FRONT].copy()
    compact(t)
    assert (t.clique[cliques, FRONT] != before).any()
    assert magnitude_of(t, c, row) == pytest.approx(expected[-1], rel=1e-9), "what is kept moves with its clique"


def test_an_update_of_a_long_open_drive_looks_at_what_changed_not_at_the_whole_tree():
    drive = Drive((0.005, 0.005, 0.02))
    rng = np.random.default_rng(0)
    for _ in range(1600):
        drive.on((1.0, 0.0, 0.02 * rng.standard_normal()))
    state = drive.solver._tree.state
    looked, again = state[CHECKED], state[AFFECTED]
    for _ in range(50):
        drive.on((1.0, 0.0, 0.02 * rng.standard_normal()))
    state = drive.solver._tree.state
    looked, again = state[CHECKED] - looked, state[AFFECTED] - again
    assert 50 <= looked <= 3 * again
    assert state[CLIQUES] > 150
