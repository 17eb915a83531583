"""Sightings of a landmark that contradict those before and after it: found by odometry, at the rate of the gate."""

import numpy as np
import pytest

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph import (
    GROUPS,
    POINT_SEEN_FROM,
    R2,
    R3,
    RELATIVE_POSE,
    RELATIVE_POSE_3D,
    SE2,
    SE3,
    Gaussian,
    Graph,
)
from graph_slam_ros.slam.robust.pairwise_consistency import contradicting_sightings

SPACES = {SE2: (R2, RELATIVE_POSE), SE3: (R3, RELATIVE_POSE_3D)}
APART = 4  # keyframes between the two sightings of a landmark


class World:
    """A path by odometry with noise, and landmarks that are each seen a few times from it."""

    def __init__(self, kind, count, rng, *, times=2, added=None):
        point, relative = SPACES[kind]
        self.graph, group = Graph(), GROUPS[kind]
        step_sigmas, seen_sigmas = rng.uniform(0.01, 0.03, kind.dof), rng.uniform(0.02, 0.05, point.dof)
        step_noise = Gaussian.from_sigmas(*step_sigmas)
        seen_noise = Gaussian.from_sigmas(*seen_sigmas)
        odometry = true = (0.0, 0.0, 0.0) if kind is SE2 else (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        poses, truth, edges = [self.graph.add_vertex(kind, odometry)], [true], []
        for _ in range(count):
            step = tuple(group.exp(tuple(rng.uniform(-0.5, 0.5, kind.dof))))
            error = tuple(step_sigmas * rng.standard_normal(kind.dof))
            measured = group.compose(step, group.exp(error))
            true, odometry = group.compose(true, step), group.compose(odometry, measured)
            poses.append(self.graph.add_vertex(kind, odometry))
            truth.append(true)
            edges.append((poses[-2:], measured))
        for ends, measured in edges:
            self.graph.add_edge(relative, ends, measured, step_noise, "odometry")
        self.sightings = []
        for first in range(0, count - times * APART, 2):
            place = rng.uniform(-5.0, 5.0, point.dof)
            landmark = self.graph.add_vertex(point, place)
            for k in range(times):
                at = first + k * APART
                off = seen_sigmas * rng.standard_normal(point.dof)
                off = off + (added(first, k) if added else 0.0)
                seen = np.array(group.act(group.inverse(truth[at]), tuple(place))) + off
                edge = self.graph.add_edge(POINT_SEEN_FROM[kind], [poses[at], landmark], seen, seen_noise, "landmarks")
                self.sightings.append(edge)

    def contradicting(self, probability):
        dof = 2 if SE2 in self.graph.kinds else 3
        ids = np.array(self.sightings)
        limits = np.full(len(ids), quantile(probability, dof))
        return contradicting_sightings(self.graph, self.graph.initial.values, ids, limits)


@pytest.mark.parametrize("kind", [SE2, SE3], ids=["plane", "space"])
def test_two_true_sightings_disagree_as_often_as_the_gate_says(kind):
    world = World(kind, 3000, np.random.default_rng(7))
    share = len(world.contradicting(0.9)) / len(world.sightings)
    assert share == pytest.approx(0.1, abs=0.025)  # 2000 pairs, both of each: 0.7 % is a standard deviation


@pytest.mark.parametrize("kind", [SE2, SE3], ids=["plane", "space"])
def test_a_wrong_sighting_between_true_ones_is_found_and_they_are_not(kind):
    def wrong(first, k):
        return 3.0 if k == 2 and first % 10 == 0 else 0.0

    world = World(kind, 400, np.random.default_rng(8), times=5, added=wrong)
    expected = [edge for n, edge in enumerate(world.sightings) if n % 5 == 2 and n // 5 * 2 % 10 == 0]
    assert world.contradicting(0.99999).tolist() == expected
