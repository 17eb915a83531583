"""Edges that compiled code linearises by the address of their function, and the same one table after the other."""

import dataclasses

import numba
import numpy as np
import pytest
from online import check_tree

from graph_slam_ros.graph import CAUCHY, HUBER, LANDMARK_POSITION, R2, RELATIVE_POSE, SE2, Gaussian, Graph, Loss
from graph_slam_ros.graph.records import LINEARIZE
from graph_slam_ros.solver import Settings, Solver

PLANAR, FLAT = Gaussian.from_sigmas(0.1, 0.1, 0.05), Gaussian.from_sigmas(0.2, 0.2)
STAGES = {"landmarks": [Loss(HUBER, 2.0), Loss(CAUCHY, 1.0)], ("odometry", "wheels"): [Loss(HUBER), Loss()]}


def in_python(edge):
    """The same edge type, whose linearisation is a Python function."""
    return dataclasses.replace(edge, linearize=lambda x, at, measured: edge.linearize(x, at, measured))


def drive(relative, sighting, *, poses=60, more=0.0):
    """A winding drive past landmarks, with two losses in stages and a sighting that is off by ``more``."""
    graph, noise, path, points = Graph(), np.random.default_rng(4), [], []
    solver = Solver(graph, Settings(losses=STAGES, at_once=True))
    for k in range(poses):
        new, edges = [graph.add_vertex(SE2, [k, np.sin(k), 0.1 * k])], []
        for back in {1, 7} if k > 7 and k % 8 == 1 else {1} if k else ():
            moved = noise.normal([back, 0.0, 0.1 * back], 0.1)
            edges.append(graph.add_edge(relative, [path[-back], new[0]], moved, PLANAR, "odometry", "wheels"))
        path.append(new[0])
        if k % 8 == 0:
            new.append(graph.add_vertex(R2, [k, 3.0]))
            points.append(new[-1])
        for point in points[-2:]:
            seen = noise.normal([0.0, 3.0], 0.3) + more * (k == poses - 1)
            edges.append(graph.add_edge(sighting, [path[-1], point], seen, FLAT, "landmarks"))
        solver.add(new, edges)
        if not k:
            solver.hold(0)
        solver.update()
        yield solver


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_edges_are_the_same_bytes_compiled_and_one_table_after_the_other():
    in_two_ways = drive(RELATIVE_POSE, LANDMARK_POSITION), drive(in_python(RELATIVE_POSE), in_python(LANDMARK_POSITION))
    for fast, slow in zip(*in_two_ways, strict=True):
        check_tree(fast)
        assert fast.values.tobytes() == slow.values.tobytes()
    compiled = [bool(table.pointers[LINEARIZE]) for one in (fast, slow) for table in one.graph.tables.values()]
    assert compiled == [True, True, False, False]
