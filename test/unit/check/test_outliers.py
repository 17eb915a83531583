"""Sightings far from their landmark: which of them have the id of another one, and which are merely wrong."""

import numpy as np
import pytest
from rows import each

from graph_slam_ros.check.outliers import check_outliers
from graph_slam_ros.check.sightings import SightingColumns
from graph_slam_ros.lie import se3
from graph_slam_ros.slam import Config

LANDMARKS, EACH, SIGMA_M = 25, 80, 0.05
CONFIG = Config.from_mapping({})


def seen(random, *, wrong=0.0, far=0.0, burst=1):
    """A grid of landmarks 3 m apart, each seen for a while; of some sightings the id is wrong, others are far away.

    Parameters
    ----------
    burst : so many sightings in a row are far away by the same
    """
    grid = 3.0 * np.stack(np.divmod(np.arange(LANDMARKS), 5), axis=1)
    name = np.repeat(np.arange(LANDMARKS), EACH)
    points = grid[name] + random.normal(0.0, SIGMA_M, (len(name), 2))
    is_wrong = random.random(len(name)) < wrong
    given = np.where(is_wrong, (name + random.integers(1, LANDMARKS, len(name))) % LANDMARKS, name)
    starts = np.flatnonzero(random.random(len(name)) < far / burst)
    for start in starts:
        length, angle = random.uniform(1.0, 6.0), random.uniform(-np.pi, np.pi)
        points[start : start + burst] += length * np.array([np.cos(angle), np.sin(angle)])
    columns = SightingColumns(
        "detections",
        "/landmarks",
        10**12 + 10**8 * np.arange(len(name)),
        np.arange(len(name)),
        tuple(map(str, range(LANDMARKS))),
        given,
        np.column_stack((points, np.zeros(len(name)))),
        np.full(len(name), np.nan),
        np.full(len(name), np.nan),
        np.full(len(name), SIGMA_M),
        "base_link",
        se3.IDENTITY,
    )
    return columns, is_wrong.mean()


def found(columns, others=()):
    inside = np.ones(len(columns.name), dtype=bool)
    return {one.code: one for one in check_outliers(columns, columns.points, inside, CONFIG, others)}


@each("wrong", [0.01, 0.03, 0.1])
def test_the_share_of_wrong_ids_is_reported_even_among_other_outliers(wrong):
    columns, share = seen(np.random.default_rng(1), wrong=wrong, far=0.03)
    one = found(columns)["ids_wrong"]
    assert one.value == pytest.approx(share, rel=0.2)
    assert one.severity == ("warning" if wrong > 0.05 else "note")


@each("how", [{}, {"far": 0.05}, {"far": 0.1, "burst": 10}])
def test_outliers_of_which_some_fit_another_landmark_by_chance_are_no_wrong_ids(how):
    for seed in range(50):
        assert "ids_wrong" not in found(seen(np.random.default_rng(seed), **how)[0])


def test_most_sightings_far_from_their_landmark_are_outliers():
    assert list(found(seen(np.random.default_rng(1), far=0.2)[0])) == ["outliers"]


def test_an_identity_of_two_places_is_not_said_twice():
    columns, _ = seen(np.random.default_rng(1))
    columns.name[columns.name == 7] = np.where(np.arange(EACH) % 12, 7, 13)
    assert "ids_wrong" in found(columns)
    assert found(columns, {"13"}) == {}
