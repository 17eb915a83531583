"""Fixes at the poles, across the antimeridian, high, low and nowhere: where the map has them, or why it has not."""

import math

import numpy as np
import pytest
from messages import counted, gnss, heard, receiver
from reliability import tell, times
from rows import each

A_M, B_M = 6378137.0, 6356752.314245  # semi-axes of WGS 84


def earth(latitude_deg, longitude_deg, height_m):
    """Earth-centred position: by the parametric latitude of the ellipse, and the normal there."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    parametric = math.atan2(B_M * math.sin(latitude), A_M * math.cos(latitude))
    out = A_M * math.cos(parametric) + height_m * math.cos(latitude)
    up = B_M * math.sin(parametric) + height_m * math.sin(latitude)
    return np.array([out * math.cos(longitude), out * math.sin(longitude), up])


def local(here, datum):
    """East, north and up: along a step of the longitude, and of the height."""
    away, longitude = earth(*here) - earth(*datum), math.radians(datum[1])
    up = (earth(datum[0], datum[1], datum[2] + 1e6) - earth(*datum)) / 1e6
    east = np.array([-math.sin(longitude), math.cos(longitude), 0.0])  # at a pole, too
    return np.array([east @ away, np.cross(up, east) @ away, up @ away])


PLACES = {
    "anywhere": lambda rng: (rng.uniform(-90, 90), rng.uniform(-180, 180)),
    "antimeridian": lambda rng: (rng.uniform(-80, 80), 180.0 + rng.uniform(-0.1, 0.1)),
    "north pole": lambda rng: (90.0 - rng.choice([0.0, 1e-9, 1e-5, 0.01]), rng.uniform(-180, 180)),
    "south pole": lambda rng: (rng.choice([0.0, 1e-9, 1e-5, 0.01]) - 90.0, rng.uniform(-180, 180)),
    "equator": lambda rng: (rng.uniform(-0.01, 0.01), rng.uniform(-360, 360)),
}


@each("place", PLACES)
def test_A31_wherever_on_earth_the_map_has_fixes_where_they_are(place):
    rng, tried = np.random.default_rng(31), times(40, 4000)
    for _ in range(tried):
        datum = (*PLACES[place](rng), rng.uniform(-400, 9000))
        away = rng.choice([1e-6, 1e-3, 0.1])
        latitude = float(np.clip(datum[0] + rng.uniform(-away, away), -90, 90))
        near_pole = abs(datum[0]) > 89.9  # any longitude is near then
        longitude = datum[1] + rng.uniform(-180, 180) if near_pole else datum[1] + rng.uniform(-away, away)
        here = (latitude, longitude, datum[2] + rng.uniform(-50, 50))
        expected = local(here, datum)
        wound = longitude - 360.0 * round(longitude / 360.0) if rng.random() < 0.5 else longitude
        b = receiver(3)
        first = heard(b, "gps", gnss(*datum))
        m = heard(b, "gps", gnss(here[0], wound if abs(wound) <= 360.0 else wound % 360.0, here[2]))
        assert first.measured == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
        np.testing.assert_allclose(m.measured, expected, atol=1e-7 + 1e-12 * np.linalg.norm(expected))
        np.testing.assert_allclose(np.linalg.norm(m.measured), np.linalg.norm(earth(*here) - earth(*datum)), atol=1e-6)
    tell("extreme_fixes", tried=tried, failed=0)


NOWHERE = {
    "not_on_earth": [(90.001, 0.0, 0.0), (-91.0, 11.0, 0.0), (4.8e8, 1.1e8, 0.0), (48.0, 361.0, 0.0),
                     (48.0, 11.0, 1e8), (48.0, 11.0, -6.4e6), (48.0, 11.0, 1.7e308), (48.0, 11.0, -1.7e308)],
    "nonfinite": [(math.nan, 11.0, 0.0), (48.0, -math.inf, 0.0), (math.inf, math.nan, math.nan)],
    "no_position": [(0.0, 0.0, 0.0), (-0.0, 0.0, 1e4)],
    "far_from_datum": [(48.0, -169.0, 500.0), (-48.0, 11.0, 500.0), (90.0, 0.0, 500.0), (-90.0, 11.0, 0.0)],
}  # fmt: skip


@each("dimensions", [2, 3])
def test_A31_what_is_nowhere_is_refused_and_becomes_no_origin(dimensions):
    for reason, places in NOWHERE.items():
        for place in places:
            b = receiver(dimensions)
            if reason != "far_from_datum":
                assert heard(b, "gps", gnss(*place)) is None, place
            good = heard(b, "gps", gnss())
            assert (good.datum, good.measured) == ((48.0, 11.0, 500.0), (0.0,) * dimensions)
            assert heard(b, "gps", gnss(*place)) is None, place
            assert counted(b) == {"gps": {reason: 1 + (reason != "far_from_datum")}}
            tell("extreme_fixes", tried=1, failed=0)
    b = receiver(dimensions)
    assert heard(b, "gps", gnss(1.0, 1.0, 1.0, covariance=[math.inf] * 9)) is None
    assert heard(b, "gps", gnss()).datum == (48.0, 11.0, 500.0)
