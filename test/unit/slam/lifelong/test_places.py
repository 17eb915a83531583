"""Visits to a place condensed to one Gaussian, compared with everything solved at once; and how a visit fits."""

import numpy as np
import pytest

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.slam.lifelong.constellation import Constellation
from graph_slam_ros.slam.lifelong.place import Place, fit_of, fused
from graph_slam_ros.slam.lifelong.visit import visit_of
from graph_slam_ros.solver import Settings, Solver

POSES, SIGMA_ODOMETRY, SIGMA_SIGHTING = 5, 0.02, 0.05
GATE, SIGMA_M = 0.9999, 0.1
STILL = Settings(step_tolerance=1e-11, cost_tolerance=0.0)


@pytest.fixture(params=[PLANAR, SPATIAL], ids=["plane", "space"])
def space(request):
    return request.param


@pytest.fixture(params=[0, 2], ids=["points", "both"])
def tags(request):
    """The number of the six landmarks, the last ones, that are poses."""
    return request.param


class World:
    """Landmarks, and visits that see some of them: in one graph, where the visits are joined by landmarks alone."""

    def __init__(self, space, noise, seed=0, landmarks=6, tags=0):
        self.space, self.noise, self.rng = space, noise, np.random.default_rng(seed)
        self.points = 4.0 * self.rng.standard_normal((landmarks, space.dimensions))
        self.graph = Graph()
        angles = self.rng.standard_normal((tags, space.dof - space.dimensions))
        centres = self.points[landmarks - tags :]
        turns = [space.group.exp((*[0.0] * space.dimensions, *one))[space.dimensions :] for one in angles]
        self.tags = [(*at, *turn) for at, turn in zip(centres, turns, strict=True)]
        self.marks = self.graph.add_vertices(space.point, self.points[: landmarks - tags]).tolist()
        self.marks += [self.graph.add_vertex(space.pose, tag) for tag in self.tags]
        self.poses, self.edges = [], []

    def visit(self, sees, moved=None):
        """Add a visit from another direction; returns its number."""
        space, group, rng = self.space, self.space.group, self.rng
        pose = group.exp(tuple(rng.standard_normal(space.dof)))
        step = group.exp((0.5, *[0.05] * (space.dof - 2), 0.3))
        sigmas = space.sigmas(SIGMA_ODOMETRY, SIGMA_ODOMETRY)
        poses, edges = [], []
        for k in range(POSES):
            poses.append(self.graph.add_vertex(space.pose, np.array(pose)))
            if k:
                error = tuple(self.noise * np.array(sigmas) * rng.standard_normal(space.dof))
                measured = group.compose(step, group.exp(error))
                noise = Gaussian.from_sigmas(*sigmas)
                edges.append(self.graph.add_edge(space.relative_pose, poses[-2:], measured, noise, "odometry"))
            for m in sees:
                sigma = SIGMA_SIGHTING * (1 + 0.1 * m)
                there = self.points[m] + (moved[1] if moved and moved[0] == m else 0.0)
                if (number := m - len(self.points) + len(self.tags)) >= 0:
                    edges.append(self._tag(pose, poses[-1], m, (*there, *self.tags[number][len(there) :]), sigma))
                    continue
                seen = np.array(group.act(group.inverse(pose), tuple(there)))
                seen = seen + self.noise * sigma * rng.standard_normal(len(seen))
                noise, edge_type = Gaussian.from_sigmas(*[sigma] * len(seen)), space.sightings["position"]
                vertices = [poses[-1], self.marks[m]]
                edges.append(self.graph.add_edge(edge_type, vertices, edge_type.whole([seen])[0], noise, "landmarks"))
            pose = group.compose(pose, step)
        self.poses.append(poses)
        self.edges.append(edges)
        return len(self.poses) - 1

    def _tag(self, pose, vertex, m, tag, sigma):
        """Add what was measured of a landmark that is a pose."""
        space, group = self.space, self.space.group
        error = tuple(self.noise * sigma * self.rng.standard_normal(space.dof))
        seen = group.compose(group.between(pose, tag), group.exp(error))
        noise = Gaussian.from_sigmas(*[sigma] * space.dof)
        return self.graph.add_edge(space.relative_pose, [vertex, self.marks[m]], seen, noise, "landmarks")

    def estimate(self, ids):
        graph = self.graph
        return np.array([graph.vertex(int(v)).initial for v in ids])

    def base(self, number):
        return self.poses[number][POSES // 2]

    def condensed(self, number):
        edges = dict.fromkeys(self.edges[number], 1.0)
        return visit_of(self.space, self.graph, self.estimate, self.poses[number], self.base(number), edges)[0]

    def place(self, *numbers):
        """The place of some visits in this order; the statistics of all but the first."""
        place, told = self.condensed(numbers[0]), []
        for number in numbers[1:]:
            one, other = self.estimate([self.base(numbers[0]), self.base(number)])
            guess = self.space.group.between(tuple(one), tuple(other))
            done = fused(self.space, place, self.condensed(number), guess)
            place = done.place
            told.append((done.statistic, done.degrees))
        return place, told

    def batch(self, *numbers):
        """Positions of the landmarks in the axes of the first base, and their information, of all edges at once."""
        graph, space, group, first = self.graph.copy(), self.space, self.space.group, self.base(numbers[0])
        solver = Solver(graph, STILL)
        poses = [v for n in numbers for v in self.poses[n]]
        edges = [edge for n in numbers for edge in self.edges[n]]
        marks = sorted({v for edge in edges for v in graph.edge(edge).vertices} - set(poses))
        solver.add(sorted([*poses, *marks]), edges)
        solver.hold(first)
        solver.optimize()
        covariance, base = np.linalg.inv(solver.information_matrix()), tuple(self.estimate([first])[0])
        kept = sorted({*poses, *marks} - {first})
        begins = np.cumsum([0, *(graph.kind_of(v).dof for v in kept)])
        points, turns, places, rotations = [], [], [], []
        for mark in marks:
            value, begin = tuple(solver.estimate([mark])[0]), begins[kept.index(mark)]
            at = np.eye(space.dimensions)
            if len(value) == space.pose.size:
                seen = group.between(base, value)
                points.append(seen[: space.dimensions])
                turns.append(seen[space.dimensions :])
                at = space.turn(seen)
                rotations.append(np.eye(len(covariance))[begin + space.dimensions : begin + space.dof])
            else:
                points.append(group.act(group.inverse(base), value))
                at = space.turn(base).T
            rows = np.zeros((space.dimensions, len(covariance)))
            rows[:, begin : begin + space.dimensions] = at
            places.append(rows)
        step = np.concatenate([*places, *rotations])
        seen = Constellation(np.array(points), np.array(turns).reshape(-1, space.pose.size - space.dimensions))
        return seen, np.linalg.inv(step @ covariance @ step.T)


def test_two_visits_are_what_all_their_edges_say_at_once(space, tags):
    world = World(space, noise=1e-6, tags=tags)
    world.visit(range(5))
    world.visit(range(1, 6))
    place, _ = world.place(0, 1)
    seen, information = world.batch(0, 1)
    assert place.members == tuple(world.marks)
    assert len(place.seen.turns) == tags
    assert place.seen.minus(space, seen) == pytest.approx(0.0, abs=1e-9)
    assert place.information == pytest.approx(information, rel=1e-5, abs=1e-5 * np.abs(information).max())
    if tags:  # one landmark that is a pose lays a visit on a place
        world = World(space, noise=1e-6, tags=1)
        world.visit((0, 1, 5))
        world.visit((5, 2, 3))
        place, ((_, degrees),) = world.place(0, 1)
        seen, information = world.batch(0, 1)
        assert degrees == 0 and place.members == tuple(world.marks[m] for m in (0, 1, 2, 3, 5))
        assert place.seen.minus(space, seen) == pytest.approx(0.0, abs=1e-8)
        assert place.information == pytest.approx(information, rel=1e-4, abs=1e-5 * np.abs(information).max())


def test_right_visits_pass_the_gate_and_a_landmark_that_moved_does_not(space, tags):
    statistics = np.zeros(2)
    for seed in range(24):
        world = World(space, noise=1.0, seed=seed, tags=tags)
        statistics += world.place(world.visit(range(6)), world.visit(range(6)))[1][0]
    assert quantile(1e-4, int(statistics[1])) < statistics[0] < quantile(1 - 1e-4, int(statistics[1]))
    wrong = world.visit(range(6), moved=(2, 0.5))
    ((statistic, degrees),) = world.place(0, wrong)[1]
    assert statistic > quantile(0.9999, degrees)
    place, visit = world.place(0)[0], world.condensed(wrong)
    guess = space.group.between(*(tuple(world.estimate([world.base(n)])[0]) for n in (0, wrong)))
    left = {mark: fused(space, place, visit.without(mark), guess).statistic for mark in visit.members}
    assert min(left, key=left.get) == world.marks[2]
    assert left[world.marks[2]] < quantile(0.9999, degrees - world.graph.kind_of(world.marks[2]).dof)


def test_a_landmark_that_a_visit_alone_puts_at_infinity_is_left_out():
    """Its bearings diverge, by errors; the whole map has it at 20 m."""
    world = World(PLANAR, noise=0.0)
    first = world.visit(range(3))
    poses = [np.array(world.graph.vertex(one).initial) for one in world.poses[first]]
    middle = np.mean([pose[:2] for pose in poses], axis=0)
    left = np.array([-np.sin(poses[2][2]), np.cos(poses[2][2])])
    far = world.graph.add_vertex(PLANAR.point, middle - 20.0 * left)
    for vertex, pose in zip(world.poses[first], poses, strict=True):
        x, y = pose[:2] - (middle + 8.0 * left)  # as from a point behind the robot
        measured, noise = [float(np.arctan2(y, x) - pose[2]), 0.0, 0.0, 0.0], Gaussian.from_sigmas(0.05)
        edge = world.graph.add_edge(PLANAR.sightings["bearing"], [vertex, far], measured, noise, "landmarks")
        world.edges[first].append(edge)
    assert world.condensed(first).members == tuple(world.marks[:3])


class Visits:
    """Visits that see all of eight landmarks, from the same pose."""

    def __init__(self, space, seed=0):
        self.space, self.rng = space, np.random.default_rng(seed)
        self.points = 5.0 * self.rng.standard_normal((8, space.dimensions))
        self.no_turns = np.empty((0, space.pose.size - space.dimensions))

    def visit(self, noise):
        """One with so many times the errors that it states."""
        errors = noise * SIGMA_M * self.rng.standard_normal(self.points.shape)
        information = np.eye(self.points.size) / SIGMA_M**2
        seen, at = (Constellation(one, self.no_turns) for one in (self.points + errors, self.points))
        return Place(tuple(range(len(self.points))), seen, at, information)

    def fit(self, place, visit, strikes=None):
        return fit_of(self.space, place, visit, self.space.identity, GATE, strikes or {})


def test_a_visit_that_contradicts_its_place_has_larger_variances_or_no_say(space):
    visits = Visits(space)
    place = visits.visit(1.0)
    assert visits.fit(place, visits.visit(1.0)).wider == 1.0
    fit = visits.fit(place, visits.visit(3.0))
    assert fit.wider > 1.0
    assert fit.without is fit.anew is None
    assert fit.result.statistic < fit.as_is.statistic
    assert visits.fit(place, visits.visit(30.0)).result is None


def test_a_landmark_that_contradicts_a_place_is_left_out_once_and_then_known_anew(space):
    visits = Visits(space)
    place = visits.visit(1.0)
    visits.points[2] += 1.5
    fit = visits.fit(place, visits.visit(1.0))
    assert (fit.without, fit.anew, fit.wider) == (2, None, 1.0)
    assert fit.as_is.statistic > quantile(GATE, fit.as_is.degrees) > fit.result.statistic
    again = visits.fit(fit.result.place, visits.visit(1.0), {2: 1})
    assert (again.without, again.anew) == (None, 2)
    assert again.result.statistic < quantile(GATE, again.result.degrees)
