"""The way over which landmarks are seen: one of a hundred that comes back does not join a drive."""

import numpy as np
import pytest
from rows import each

from graph_slam_ros.check.contradictions import seen_over
from graph_slam_ros.check.sightings import SightingColumns

NS = 1_000_000_000


@each("ids, back, few, reach_m", [(120, 0, 2, 2.0), (120, 2, 2, 2.0), (120, 3, 2, 100.0), (20, 1, 0, 100.0)])
def test_a_few_ids_that_come_back_are_left_out_of_many(ids, back, few, reach_m):
    """Each id is seen for two metres; some of the first are seen again after a hundred."""
    begins = np.linspace(0.0, 300.0, ids)
    name = np.concatenate([np.repeat(np.arange(ids), 3), np.arange(back)])
    at_s = np.concatenate([(begins[:, None] + [0.0, 1.0, 2.0]).ravel(), begins[:back] + 100.0])
    nowhere = np.full(len(name), np.nan)
    columns = (np.round(at_s * NS).astype(np.int64), np.arange(len(name)), tuple(map(str, range(ids))), name)
    places = np.zeros((len(name), 3)), nowhere, nowhere, nowhere
    s = SightingColumns("tags", "/tags", *columns, *places, "base_link", (0.0,) * 6 + (1.0,))
    seconds = np.linspace(0.0, 400.0, 401)
    found = seen_over(s, np.arange(len(name)), 0, seconds, seconds)  # at 1 m/s
    assert found == (pytest.approx(reach_m), few, back > 0)
