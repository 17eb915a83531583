"""A visit that is thinned says no more than its keyframes did: compared with exact marginalisation."""

import numpy as np
import pytest

from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.slam.lifelong.elimination import marginal_information
from graph_slam_ros.slam.lifelong.skeleton import Skeleton
from graph_slam_ros.slam.lifelong.surroundings import CHAIN, surroundings
from graph_slam_ros.slam.lifelong.thinned import Thinning
from graph_slam_ros.solver import Solver

BASES, POSES = 3, 6


class Visited:
    """Three old poses, a visit that closes loops to them, and the keyframe after it; what is measured has no error."""

    def __init__(self, space, seed, closures=4, into=True):
        self.space, self.rng, self.graph = space, np.random.default_rng(seed), Graph()
        group = space.group
        self.bases = [self.add(group.exp(tuple(self.rng.standard_normal(space.dof)))) for _ in range(BASES)]
        self.visit = [self.add(group.exp(tuple(self.rng.standard_normal(space.dof)))) for _ in range(POSES)]
        self.after = self.add(group.exp(tuple(self.rng.standard_normal(space.dof))))
        steps = [*([(self.bases[0], self.visit[0])] if into else []), *zip(self.visit, self.visit[1:], strict=False)]
        for ends in (*steps, (self.visit[-1], self.after)):
            self.edge(*ends, "odometry")
        others = [*self.bases, *self.visit]
        for _ in range(closures):
            k = int(self.rng.integers(1, POSES))
            self.edge(others[int(self.rng.integers(BASES + k))], self.visit[k], "closures")
        self.solver = Solver(self.graph)
        self.solver.add(range(self.graph.vertex_count), range(self.graph.edge_count))
        if into:
            self.solver.hold(self.bases[0])
            for base in self.bases[1:]:
                self.solver.add([], [self.edge(self.bases[0], base, "odometry")])
            self.solver.update()

    def add(self, pose):
        return self.graph.add_vertex(self.space.pose, pose)

    def edge(self, first, last, label):
        a, b = (tuple(self.graph.vertex(v).initial.tolist()) for v in (first, last))
        motion = self.space.group.between(a, b)
        root = np.diag(np.exp(self.rng.uniform(1.0, 4.0, self.space.dof)))
        return self.graph.add_edge(self.space.relative_pose, [first, last], motion, Gaussian(root), label, "loops")

    def thinned(self, kept=()):
        around = surroundings(self.space, self.solver, self.visit, self.after)
        assert not around.unfit
        keeps = set(kept)
        return around, Thinning(self.space, self.visit, self.after, around, keeps.__contains__, 2.0, 0.9999).run()

    def information(self, edges):
        """What some edges (type, ends, measured, root) say of the old poses and the keyframe after the visit."""
        graph, order = Graph(), [*self.visit, *self.bases, self.after]
        for vertex in order:
            graph.add_vertex(self.space.pose, self.graph.vertex(vertex).initial)
        for ends, measured, root in edges:
            graph.add_edge(
                self.space.relative_pose, [order.index(v) for v in ends], measured, Gaussian(root), "odometry"
            )
        solver = Solver(graph)
        solver.add(range(len(order)), range(graph.edge_count))
        solver.hold(order.index(self.bases[0]))
        dof, held = self.space.dof, order.index(self.bases[0])
        whole = solver.information_matrix()
        free = [v for v in order if order.index(v) != held]
        stays = [k for k, v in enumerate(free) if v not in self.visit]
        # Keyframes that are in no edge have no information: a little makes the elimination possible.
        whole = whole + 1e-9 * np.eye(len(whole))
        return marginal_information(whole, np.concatenate([np.arange(dof * k, dof * k + dof) for k in stays]))


@pytest.mark.parametrize("space", [PLANAR, SPATIAL], ids=["plane", "space"])
@pytest.mark.parametrize("seed", range(12))
def test_it_says_no_more_than_was_measured(space, seed):
    one = Visited(space, seed)
    kept = one.visit[2 : 2 + seed % 3]
    around, thin = one.thinned(kept)
    assert set(thin.centres) == set(one.visit)
    assert all(thin.centres[vertex][0] == vertex for vertex in kept)
    edges = [one.graph.edge(number) for number in around.all]
    before = [(edge.vertices, edge.measured, edge.sqrt_information) for edge in edges]
    after = [(edge.vertices, edge.measured, edge.root) for edge in thin.added]
    after += [(edge.vertices, edge.measured, edge.sqrt_information) for edge in edges if edge.id in thin.stay]
    # An edge of a composed closure has a part that is doubted and one that holds the path: both count.
    exact, approximate = one.information(before), one.information(after)
    root = np.linalg.inv(np.linalg.cholesky(exact))
    ratios = np.linalg.eigvalsh(root @ approximate @ root.T)
    assert ratios[-1] < 1.0 + 1e-6
    assert ratios[0] > 0.02


@pytest.mark.parametrize("space", [PLANAR, SPATIAL], ids=["plane", "space"])
def test_what_is_composed_measures_where_things_are(space):
    one = Visited(space, 3)
    _, thin = one.thinned()
    assert {edge.label for edge in thin.added} == {CHAIN, "closures"}
    for edge in thin.added:
        a, b = (tuple(one.graph.vertex(v).initial.tolist()) for v in edge.vertices)
        off = space.group.log(space.group.between(edge.measured, space.group.between(a, b)))
        assert np.abs(off).max() < 1e-9
    ends = {vertex for edge in thin.added for vertex in edge.vertices}
    assert ends <= {*one.bases, one.after}


@pytest.mark.parametrize("space", [PLANAR, SPATIAL], ids=["plane", "space"])
def test_a_visit_without_closures_is_one_edge_and_one_that_nothing_leads_to_none(space):
    one = Visited(space, 1, closures=0)
    around, thin = one.thinned()
    exact = one.information([(e.vertices, e.measured, e.sqrt_information) for e in map(one.graph.edge, around.all)])
    (edge,) = thin.added
    assert (edge.vertices, edge.label) == ((one.bases[0], one.after), CHAIN)
    assert one.information([(edge.vertices, edge.measured, edge.root)]) == pytest.approx(exact, rel=1e-6, abs=1e-5)
    loose = Visited(space, 1, closures=0, into=False)
    _, thin = loose.thinned()
    assert not thin.added
    assert {centre for centre, _ in thin.centres.values()} == {loose.after}


def test_keyframes_stay_apart_unless_they_look_another_way():
    skeleton, east, west = Skeleton(2.0), (3.9, -0.1, 0.1), (3.9, -0.1, 3.1)
    assert skeleton.adds(PLANAR, east)
    assert not skeleton.adds(PLANAR, (4.1, 1.0, -0.3))  # in the next cell, and near
    assert skeleton.adds(PLANAR, west)
    assert skeleton.adds(PLANAR, (6.0, -0.1, 0.1))
    saved = Skeleton(2.0)
    saved.restore(list(skeleton.rows()), 2)
    assert saved.positions == skeleton.positions
    assert len(saved) == 3
    saved.spread(5.0)
    assert len(saved) == 3
    assert not saved.adds(PLANAR, (1.0, -0.1, 0.1))
    space = Skeleton(2.0)
    assert space.adds(SPATIAL, (0.0, 0.0, 5.0, 0.0, 0.0, 0.0, 1.0))
    assert not space.adds(SPATIAL, (0.0, 0.0, 6.5, 0.0, 0.0, 0.0, 1.0))
    assert space.adds(SPATIAL, (0.0, 0.0, 5.0, 0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)))
