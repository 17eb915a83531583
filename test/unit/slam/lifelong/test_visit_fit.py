"""The fit of a visit to its place, as it is, with larger variances, or not at all; and the scale of variances."""

from dataclasses import replace

import numpy as np
import pytest

from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.slam.lifelong.constellation import Constellation
from graph_slam_ros.slam.lifelong.fit import VisitScale, fit_of
from graph_slam_ros.slam.lifelong.place import Place
from graph_slam_ros.slam.lifelong.visit import Visit

GATE, SIGMA_M = 0.9999, 0.1


@pytest.fixture(params=[PLANAR, SPATIAL], ids=["plane", "space"])
def space(request):
    return request.param


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
        return Visit(tuple(range(len(self.points))), seen, at, information, 0.0, 0)

    def fit(self, place, visit):
        return fit_of(self.space, place, visit, self.space.identity, GATE, {})


@pytest.mark.parametrize("noise", [1.0, 2.0])
def test_the_factor_is_that_of_the_errors(space, noise):
    visits, scale = Visits(space), VisitScale()
    place = Place.begun_by(visits.visit(noise))
    for _ in range(60):
        one = visits.visit(noise)
        fit = visits.fit(place, replace(one, information=one.information / scale.factor))
        scale.add(fit.as_is, GATE)
        place = fit.result.place
        place = replace(place, information=place.information / scale.change())
    assert scale.factor == pytest.approx(noise**2, rel=0.25)
    off = (place.seen.points - place.seen.points.mean(axis=0)) - (visits.points - visits.points.mean(axis=0))
    stated = np.sqrt(np.diag(np.linalg.pinv(place.information))).mean()
    assert np.sqrt((off**2).mean()) < 1.5 * stated


def test_errors_that_are_smaller_than_stated_do_not_make_it_surer(space):
    visits, scale = Visits(space), VisitScale()
    place = Place.begun_by(visits.visit(0.1))
    for _ in range(20):
        scale.add(visits.fit(place, visits.visit(0.1)).as_is, GATE)
    assert scale.change() == scale.factor == 1.0


def test_one_visit_alone_does_not_make_all_others_unsure(space):
    visits, scale = Visits(space), VisitScale()
    place = Place.begun_by(visits.visit(1.0))
    for noise in (20.0, *[1.0] * 30):
        scale.add(visits.fit(place, visits.visit(noise)).as_is, GATE)
    scale.change()
    assert scale.factor < 1.3


def test_a_visit_that_contradicts_its_place_has_larger_variances_or_no_say(space):
    visits = Visits(space)
    place = Place.begun_by(visits.visit(1.0))
    assert visits.fit(place, visits.visit(1.0)).wider == 1.0
    fit = visits.fit(place, visits.visit(3.0))
    assert fit.wider > 1.0
    assert fit.without is fit.anew is None
    assert fit.visit.information == pytest.approx(visits.visit(1.0).information / fit.wider)
    assert fit.result.statistic < fit.as_is.statistic
    assert visits.fit(place, visits.visit(30.0)).result is None
