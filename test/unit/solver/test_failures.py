"""What fails, for whatever reason, leaves the estimate as it was; then all goes on as if it had not been tried."""

from itertools import product

import numpy as np
import pytest
from normal_equations import Reference, all_values
from online import BATCH, EXACT, check_tree
from rows import each

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import DIFFERENCE, POINT_PRIOR, R1, EdgeType, Gaussian, Graph, edge_from_residual
from graph_slam_ros.solver import Settings, Solver

UNIT = Gaussian.from_sigmas(1.0)


class Sensor:
    """A difference between numbers whose residual raises at the calls it is told to."""

    def __init__(self):
        self.raises, self.left = None, 0
        self.edge = edge_from_residual("sensor", ((R1,), (R1,)), 1, 1, self.residual, lambda values, z: [[-1.0, 1.0]])

    def residual(self, values, z):
        if self.raises is not None:
            self.left -= 1
            if self.left < 0:
                error, self.raises = self.raises, None
                raise error
        return values[1] - values[0] - z

    def arm(self, error, after=0):
        self.raises, self.left = error, after


def numbers(count, sensor, **chosen):
    """A chain of numbers 1 apart, updated; its first is known to be 0."""
    graph = Graph()
    solver = Solver(graph, Settings(**chosen))
    for k in range(count):
        v = graph.add_vertex(R1, [float(k)])
        first = (POINT_PRIOR[R1], [v], [0.0]) if k == 0 else (sensor.edge, [v - 1, v], [1.0])
        solver.add([v], [graph.add_edge(*first, UNIT, "all")])
        solver.update()
    return solver


ERRORS = [ValueError("no table"), GraphSlamError("no table"), KeyboardInterrupt()]
WAYS = {
    "update": lambda solver: solver.update(),
    "optimize": lambda solver: solver.optimize(Settings(**BATCH)),
    "lm": lambda solver: solver.optimize(Settings("lm", **BATCH)),
    "marginal": lambda solver: solver.marginal([0]),
    "joint": lambda solver: solver.joint_marginal([0, 5]),
}


@each(
    "way, after, what, error",
    [
        (*row, ERRORS[k % 3])
        for k, row in enumerate(product(WAYS, (0, 3, 12), ("edge", "edge and vertex", "two unlinked vertices")))
    ],
)
def test_an_exception_of_a_residual_leaves_the_estimate_and_is_recovered_from(way, error, after, what):
    sensor = Sensor()
    solver = numbers(6, sensor, **EXACT)
    graph = solver.graph
    news = [] if what == "edge" else [graph.add_vertex(R1, [9.0]) for _ in range(2 if "two" in what else 1)]
    ends = [5, 6] if news else [0, 5]
    edges = [graph.add_edge(sensor.edge, ends, [3.0], UNIT, "all") for _ in range(4)]
    edges += [graph.add_edge(sensor.edge, [5, 7], [3.0], UNIT, "all")] if "two" in what else []
    solver.add(news, edges)
    before = all_values(solver)
    sensor.arm(error, after)
    try:
        WAYS[way](solver)
    except type(error) as raised:
        assert raised is error
        assert np.array_equal(all_values(solver), before)
    sensor.raises = None  # where it was not called so often
    for again in WAYS.values():
        again(solver)
        check_tree(solver)
        reference = Reference(graph, range(graph.vertex_count), range(graph.edge_count))
        assert reference.apart(all_values(solver), reference.optimum(all_values(solver))) < 1e-9
    assert solver.marginal([3])[0] == pytest.approx(reference.covariance(all_values(solver), 3), rel=1e-9)


def _cliff(x, at, measured):
    """``r = 2 x - z``, which is nowhere finite beyond 2."""
    here = x[at[:, 0]]
    return np.where(here > 2.0, np.inf, 2.0 * here)[:, None] - measured, np.full((len(at), 1, 1), 2.0)


def test_a_step_to_where_a_cost_is_not_finite_is_not_taken():
    graph, cliff = Graph(), EdgeType("cliff", ((R1,),), 1, 1, _cliff)
    graph.add_vertices(R1, [1.0, 1.0])
    solver = Solver(graph, Settings(relinearize_every=1))
    known = graph.add_edge(POINT_PRIOR[R1], [0], [1.0], UNIT, "all")
    solver.add([0, 1], [known, graph.add_edge(DIFFERENCE[R1], [0, 1], [0.0], UNIT, "all")])
    solver.update()
    bad = graph.add_edge(cliff, [1], [6.0], Gaussian.from_sigmas(0.1), "all")
    solver.add([], [bad])
    for _ in range(3):
        with pytest.raises(GraphSlamError, match=f"edge {bad} .*not finite"):
            solver.update()
        assert solver.estimate([0, 1]).ravel().tolist() == [1.0, 1.0]
    solver.set_weight(bad, 0.0)
    solver.update()
    assert solver.estimate([0, 1]).ravel().tolist() == [1.0, 1.0]
    check_tree(solver)


@each("start", [0.0, 0.3])
def test_a_removed_vertex_may_be_placed_anew(start):
    solver = numbers(2, Sensor())
    solver.graph.add_edge(POINT_PRIOR[R1], [1], [1.04], UNIT, "all")
    solver.add([], [2])
    solver.update()  # a step too small to be linearised anew
    for edge in (1, 2):
        solver.set_weight(edge, 0.0)
    solver.remove(1)
    solver.update()
    solver.place(1, [start])
    assert solver.estimate([1]) == start
    solver.add([1], [])
    solver.set_weight(1, 1.0)
    solver.update()
    assert solver.estimate([1])[0, 0] == pytest.approx(1.0, abs=1e-9)


@each("method", ["gn", "lm", "dogleg"])
def test_a_batch_does_not_count_or_move_what_was_removed(method):
    solver = numbers(3, Sensor())
    edge = solver.graph.add_edge(POINT_PRIOR[R1], [2], [2.06], UNIT, "all")
    solver.add([], [edge])
    solver.update()
    where = solver.estimate([2])
    assert where != 2.0
    for e in (2, edge):
        solver.set_weight(e, 0.0)
    solver.remove(2)
    report = solver.optimize(Settings(method, step_tolerance=1e-3, cost_tolerance=0.0))
    assert all(iteration.step < 0.03 for iteration in report.iterations)
    assert (report.method, report.converged) == (method, True)
    assert np.array_equal(solver.estimate([2]), where)


def test_an_edge_without_a_weight_may_come_without_its_vertex():
    """As a pipeline hands over what it has taken back before anybody saw it."""
    sensor = Sensor()
    solver = numbers(3, sensor, **EXACT)
    graph = solver.graph
    lost = graph.add_vertex(R1, [9.0])
    seen = [graph.add_edge(sensor.edge, [k, lost], [1.0], UNIT, "all") for k in (1, 2)]
    solver.add([lost], seen[:1])
    for edge in seen:
        solver.set_weight(edge, 0.0)
    solver.remove(lost)
    solver.add([], seen[1:])
    solver.joint_marginal([0, 2])
    solver.update()
    check_tree(solver)
    with pytest.raises(GraphSlamError, match=f"needs vertex {lost}"):
        solver.set_weight(seen[1], 1.0)
    solver.add([lost], [])
    solver.set_weight(seen[1], 1.0)
    solver.update()
    assert solver.estimate([lost])[0, 0] == pytest.approx(3.0, abs=1e-9)
