"""Estimates that nobody reads wait; what is read is what it would be if all had been computed at once."""

import numpy as np
import pytest
from online import RANGE_WITH_BIAS, check_tree
from rows import each

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import R1, R2, RELATIVE_POSE, SE2, Gaussian, Graph
from graph_slam_ros.lie import se2
from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.solver.clique_tree.storage import DEFERRED_COUNT

PLANAR = Gaussian.from_sigmas(0.05, 0.05, 0.02)
LAP = 40
NEAR = 2e-3  # m, rad: the tolerance is 1e-3 standard deviations


class Laps:
    """A robot that drives round and round; every fifth pose sees the one a lap before."""

    def __init__(self, **settings):
        self.graph = Graph()
        self.solver = Solver(self.graph, Settings(**settings))
        self.noise = np.random.default_rng(1)
        self.poses = []

    def drive(self, poses, *, read=lambda solver, newest: None):
        for _ in range(poses):
            self._step()
            self.solver.update()
            read(self.solver, self.poses[-1])

    def _step(self):
        graph, k = self.graph, len(self.poses)
        motion = np.array([1.0, 0.0, 2 * np.pi / LAP]) + self.noise.normal(0, [0.05, 0.05, 0.02])
        at = se2.compose(tuple(self.solver.estimate([k - 1])[0].tolist()), tuple(motion.tolist())) if k else (0, 0, 0)
        self.poses.append(graph.add_vertex(SE2, at))
        edges = [graph.add_edge(RELATIVE_POSE, [k - 1, k], motion, PLANAR, "odometry")] if k else []
        if k >= LAP and k % 5 == 0:
            seen = self.noise.normal(0, [0.05, 0.05, 0.02])
            edges.append(graph.add_edge(RELATIVE_POSE, [k - LAP, k], seen, PLANAR, "closures"))
        self.solver.add([k], edges)
        if not k:
            self.solver.hold(0)


def waiting(solver):
    return int(solver._tree.state[DEFERRED_COUNT])


def test_an_update_with_a_closure_leaves_what_nobody_reads_waiting_and_reading_solves_it():
    laps = Laps()
    waited = 0
    for _ in range(40):
        laps.drive(5)
        check_tree(laps.solver)
        waited += waiting(laps.solver) > 0
    assert waited > 10
    read = laps.solver.estimate(laps.poses)
    assert waiting(laps.solver) == 0
    check_tree(laps.solver)
    at_once = Laps(at_once=True)
    at_once.drive(200)
    assert np.abs(read - at_once.solver.estimate(at_once.poses)).max() < NEAR
    optimum = laps.solver.evaluate().chi2_final
    assert laps.solver.optimize().chi2_final == pytest.approx(optimum, rel=1e-4)


@each("chosen", [lambda n: [n // 2], lambda n: [0, n // 3, n - 1], lambda n: range(0, n, 7)])
def test_some_vertices_are_read_as_all_are(chosen):
    one, all_of_them = Laps(), Laps()
    for laps in (one, all_of_them):
        laps.drive(171)  # an update after a closure
    assert waiting(one.solver) > 0
    ids = list(chosen(171))
    assert one.solver.estimate(ids) == pytest.approx(all_of_them.solver.estimate(range(171))[ids], abs=1e-12)
    check_tree(one.solver)


def test_at_once_nothing_waits_and_reading_decides_no_digit():
    silent, asked = Laps(at_once=True), Laps(at_once=True)
    silent.drive(200)
    asked.drive(200, read=lambda solver, newest: solver.estimate([newest // 2]) if newest % 3 else solver.values)
    assert waiting(silent.solver) == 0
    assert silent.solver.values.tobytes() == asked.solver.values.tobytes()


def test_what_waits_is_kept_by_an_update_that_fails():
    laps, read = Laps(), Laps()
    for one in (laps, read):
        one.drive(171)
    before = read.solver.values
    assert waiting(laps.solver) > 0
    for one in (laps, read):
        graph, solver = one.graph, one.solver
        new = [graph.add_vertex(R2, [1.0, 1.0]), graph.add_vertex(R1, [0.0])]
        solver.add(new, [graph.add_edge(RANGE_WITH_BIAS, [170, *new], [1.0], Gaussian.from_sigmas(0.1), "ranges")])
        with pytest.raises(SingularError):
            solver.update()
    assert np.array_equal(read.solver.values[: len(before)], before)
    assert np.abs(laps.solver.values[: len(before)] - before).max() < 1e-12


def test_a_vertex_that_waits_is_held_and_removed_where_it_would_be_read():
    held, read = Laps(), Laps()
    for one in (held, read):
        one.drive(171)
    there = read.solver.estimate([60])
    for one in (held, read):
        one.solver.hold(60)
        one.solver.update()
        check_tree(one.solver)
    assert held.solver.estimate([60]) == pytest.approx(there, abs=1e-12)
    assert held.solver.values == pytest.approx(read.solver.values, abs=NEAR)
