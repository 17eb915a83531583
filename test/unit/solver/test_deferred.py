"""Estimates that nobody reads wait; what is read is what it would be if all had been computed at once."""

import numpy as np
import pytest
from online import RANGE_WITH_BIAS, check_tree

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import R1, R2, RELATIVE_POSE, SE2, Gaussian, Graph
from graph_slam_ros.lie import se2
from graph_slam_ros.solver import Settings, Solver

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


def test_what_nobody_reads_waits_and_what_is_read_is_what_it_would_be_at_once():
    laps, at_once = Laps(), Laps(at_once=True)
    for _ in range(40):
        laps.drive(5)
        check_tree(laps.solver)
    at_once.drive(200)
    read = laps.solver.estimate(laps.poses)
    check_tree(laps.solver)
    assert 0.0 < np.abs(read - at_once.solver.estimate(at_once.poses)).max() < NEAR
    optimum = laps.solver.evaluate().chi2_final
    assert laps.solver.optimize().chi2_final == pytest.approx(optimum, rel=1e-4)


def test_at_once_reading_decides_no_digit():
    silent, asked = Laps(at_once=True), Laps(at_once=True)
    silent.drive(200)
    asked.drive(200, read=lambda solver, newest: solver.estimate([newest // 2]) if newest % 3 else solver.values)
    assert silent.solver.values.tobytes() == asked.solver.values.tobytes()


def test_what_waits_is_read_kept_by_an_update_that_fails_and_held_where_it_would_be():
    waiting, read = Laps(), Laps()
    for laps in (waiting, read):
        laps.drive(171)  # an update after a closure
    every = read.solver.estimate(range(171))
    some = [0, 57, 85, 170]
    assert waiting.solver.estimate(some) == pytest.approx(every[some], abs=1e-12)
    for laps in (waiting, read):
        graph, solver = laps.graph, laps.solver
        new = [graph.add_vertex(R2, [1.0, 1.0]), graph.add_vertex(R1, [0.0])]
        edge = graph.add_edge(RANGE_WITH_BIAS, [170, *new], [1.0], Gaussian.from_sigmas(0.1), "ranges")
        solver.add(new, [edge])
        with pytest.raises(SingularError):
            solver.update()
        solver.set_weight(edge, 0.0)
        for vertex in new:
            solver.remove(vertex)
        solver.hold(60)
        solver.update()
        check_tree(solver)
    assert waiting.solver.estimate([60])[0] == pytest.approx(every[60], abs=1e-12)
    assert waiting.solver.estimate(range(171)) == pytest.approx(read.solver.estimate(range(171)), abs=NEAR)
