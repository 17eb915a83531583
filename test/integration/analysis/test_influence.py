"""The influence of an edge to first order is that of solving without it, or with it."""

import numpy as np
import pytest
from faulty import faulty_run

from graph_slam_ros.analysis.influence import InfluenceModel
from graph_slam_ros.analysis.what_if import SavedGraph

NEAR, TRIED = 0.2, 100


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    return SavedGraph(faulty_run(tmp_path_factory.mktemp("faulty"))[1], [])


def exact(saved, edge, *, let_in=False):
    """The step of the last keyframe, in its tangent space, by solving again."""
    last = saved.keyframes[-1:]
    solver = saved.solve([], [edge]) if let_in else saved.solve([edge])
    before, after = (tuple(one.estimate(last)[0]) for one in (saved.solver, solver))
    return np.array(saved.space.group.local(after, before))


def compare(saved, found, *, let_in=False):
    """How many of some edges go in the right direction, and are as far as solving again says to a fifth."""
    right = near = tried = 0
    for k in np.linspace(0, len(found.edges) - 1, min(TRIED, len(found.edges))).astype(int):
        if not found.is_alone[k]:
            step = exact(saved, int(found.edges[k]), let_in=let_in)
            tried += 1
            right += bool(found.step[k] @ step > 0.0)
            length = np.linalg.norm(step[:2])
            near += bool(abs(np.linalg.norm(found.step[k, :2]) - length) <= NEAR * length)
    return right / tried, near / tried


def test_without_an_edge_95_of_100_are_within_a_fifth_of_solving_again(saved):
    """With the loss of all others: without the curvature of these, 80 are."""
    judged = [e.edge for e in saved.entries if e.is_in and e.verdict]
    right, near = compare(saved, saved.influence_model.without(judged))
    assert right >= 0.95
    assert near >= 0.95


def test_with_an_edge_that_is_out_so_it_is_where_a_step_says_anything(saved):
    """A false closure that is far off moves all so far that other edges lose their weight: nothing is said."""
    found = saved.influence_model.with_them([e.edge for e in saved.entries if not e.is_in])
    known = np.isfinite(found.end_m)
    assert (known == (found.cost < 300.0)).all()
    assert known.any()
    assert not known.all()
    for k in np.flatnonzero(known).tolist():
        step = exact(saved, int(found.edges[k]), let_in=True)
        assert found.step[k] @ step > 0.0
        length = np.linalg.norm(step)  # of millimetres the loss of the edge itself makes a third
        assert np.linalg.norm(found.step[k]) == pytest.approx(length, rel=0.2, abs=0.002)


def test_covariances_of_all_edges_at_once_are_those_of_each(saved):
    solver, last = saved.solver, saved.keyframes[-1]
    known = solver.cross_covariances()
    for label in ("odometry", "landmarks", "closures"):
        edges = [e for e in saved.entries if e.is_in and e.label == label][::7]
        ends = np.array([e.vertices for e in edges])
        among, of_last = solver.edge_marginals(ends), known.with_vertex(last, ends)
        for k, e in enumerate(edges):
            assert among[k] == pytest.approx(solver.joint_marginal(e.vertices), rel=1e-6, abs=1e-12)
            if last not in e.vertices:
                joint = solver.joint_marginal([last, *e.vertices])
                assert of_last[k] == pytest.approx(joint[:3, 3:], rel=1e-6, abs=1e-12)


def test_in_a_map_that_is_held_an_edge_moves_nothing(saved):
    solver = saved.solve()
    for vertex in solver.vertices.tolist():
        solver.hold(vertex)
    judged = [e.edge for e in saved.entries if e.is_in and e.verdict]
    found = InfluenceModel(saved.graph, solver, saved.keyframes[-1]).without(judged)
    assert not found.step.any()
    assert not found.end_m.any()
    solver = saved.solve()
    solver.hold(saved.keyframes[0])
    edge = saved.entries[1]
    assert saved.keyframes[0] in edge.vertices
    (at_once,) = solver.edge_marginals(np.array([edge.vertices]))
    assert at_once == pytest.approx(solver.joint_marginal(edge.vertices), abs=1e-12)
