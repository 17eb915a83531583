"""The typical length of a motion, by which positions count where steps are linearised anew."""

from itertools import pairwise

import numpy as np
import pytest

from graph_slam_ros.graph import RELATIVE_POSE, RELATIVE_POSE_3D, SE2, SE3, Gaussian, Graph
from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.solver.relinearization import MotionLength


def chain(lengths, dimensions=2):
    """Poses in a row, at the motions that are measured between them."""
    graph, nowhere = Graph(), (0.0, 0.0) if dimensions == 2 else (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    kind, edge = (SE2, RELATIVE_POSE) if dimensions == 2 else (SE3, RELATIVE_POSE_3D)
    vertices = [graph.add_vertex(kind, (at, *nowhere)) for at in np.cumsum([0.0, *lengths])]
    for ends, length in zip(pairwise(vertices), lengths, strict=True):
        graph.add_edge(edge, ends, (length, *nowhere), Gaussian(np.eye(sum(edge.dofs) // 2)), "odometry")
    return graph


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize(("length", "mm"), [(0.1, 1000), (1.2, 1000), (4.2, 4000), (1e9, 2**20 * 1000)])
def test_it_is_the_median_to_a_factor_of_the_root_of_two_and_a_metre_at_least(dimensions, length, mm):
    assert MotionLength().typical_mm(chain([length] * 5, dimensions)) == mm


def test_false_closures_of_any_length_do_not_change_it_and_what_comes_later_counts():
    graph, motions = chain([4.2] * 9 + [1e8] * 4), MotionLength()
    assert motions.typical_mm(graph) == 4000
    for k in range(40):
        graph.add_edge(RELATIVE_POSE, (0, 1), (1.0, 0.0, 0.0), Gaussian(np.eye(3)), f"closures {k % 2}")
    assert motions.typical_mm(graph) == MotionLength().typical_mm(graph) == 1000


def test_sightings_of_tags_are_no_motions():
    graph, motions = chain([0.5] * 4, dimensions=3), MotionLength()
    for k in range(20):
        tag = graph.add_vertex(SE3, (5.0, float(k), 0.0, 0.0, 0.0, 0.0, 1.0))
        seen = (5.0, float(k), 0.0, 0.0, 0.0, 0.0, 1.0)
        graph.add_edge(RELATIVE_POSE_3D, (0, tag), seen, Gaussian(np.eye(6)), "landmarks")
    assert motions.typical_mm(graph) == 1000


def test_without_motions_it_is_a_metre():
    assert MotionLength().typical_mm(Graph()) == 1000


@pytest.mark.parametrize(("length", "again"), [(1.0, True), (10.0, False)])
def test_a_step_of_a_tenth_of_a_metre_is_linearised_anew_among_short_motions_only(length, again):
    graph = chain([length] * 4)
    solver = Solver(graph, Settings(relinearize_every=1, relinearize_error=1e9))
    solver.add(range(5), range(4))
    solver.hold(0)
    solver.update()
    for ends, measured in (((3, 4), length + 0.3), ((0, 1), length)):
        solver.add([], [graph.add_edge(RELATIVE_POSE, ends, (measured, 0.0, 0.0), Gaussian(np.eye(3)), "odometry")])
        change = solver.update()
    assert change.linearized == (3 if again else 1), "both edges of the pose that has moved by 0.15 m, and the new one"
    assert solver.estimate([4])[0] == pytest.approx((4.0 * length + 0.15, 0.0, 0.0))
