"""Checks of plausibility: distances beyond a sensor's reach are refused, and steep directions get regular axes."""

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from graph_slam_ros.config.inputs import InputConfig
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.types import Closure, Observation, Sighting, Sightings
from graph_slam_ros.slam.frontend import motion_compensation

_MOST_M = 1e5  # of an input without a limit: farther than from any sensor to its horizon
_STEEP = 0.2  # cosine of an elevation: at 78.5 degrees and above the azimuth is turned away from the pole


class MaxDistance:
    """Gate for the largest distance [m] of each input.

    A bearing has no distance. A fix has one only from the map's origin, which may be anywhere.
    """

    reason = "beyond_max_distance"

    def __init__(self, space: Geometry, inputs: Iterable[InputConfig]) -> None:
        self._space = space
        self._limit_m = {one.name: one.max_distance_m for one in inputs if one.max_distance_m > 0.0}

    def admit(self, m: Observation) -> Observation | None:
        """Return the part of an observation within the limit, or None."""
        match m:
            case Sightings():
                within = tuple(s for s in m.sightings if self._is_within(m.topic, self._distance(s)))
                if len(within) == len(m.sightings):
                    return m
                return replace(m, sightings=within) if within else None
            case Closure():
                return m if self._is_within(m.topic, math.hypot(*m.T_from_base[: self._space.dimensions])) else None
            case _:
                return m

    def _distance(self, s: Sighting) -> float | None:
        """Return the distance from the sensor; of a position or pose, from the base."""
        if s.kind in ("position", "pose"):
            return math.hypot(*s.measured[: self._space.dimensions])
        return None if s.kind == "bearing" else abs(s.measured[0])

    def _is_within(self, topic: str, distance_m: float | None) -> bool:
        return distance_m is None or distance_m <= self._limit_m.get(topic, _MOST_M)


def off_the_pole(space: Geometry, s: Sighting) -> Sighting:
    """Return the same sighting; a steep direction in space is expressed in a sensor frame that looks along it.

    At the zenith and the nadir azimuth is undefined and its derivative infinite. So the sensor's frame is rotated until
    its x axis points along the measured direction: azimuth and elevation are both 0. The sigma across the direction is
    that of the elevation, or ``sigma_azimuth cos(elevation)`` if that is larger.
    """
    if space.dimensions == 2 or s.kind not in ("bearing", "range_bearing"):
        return s
    azimuth, elevation = s.measured[-2:]
    if math.cos(elevation) >= _STEEP:
        return s
    half_a, half_e = 0.5 * azimuth, -0.5 * elevation
    ca, sa, ce, se = math.cos(half_a), math.sin(half_a), math.cos(half_e), math.sin(half_e)
    turn = (-sa * se, ca * se, sa * ce, ca * ce)  # about z by the azimuth, then about y by minus the elevation
    sensor = space.group.compose(s.T_base_sensor or space.identity, (0.0, 0.0, 0.0, *turn))
    scale = np.ones(len(s.measured))
    scale[-2] = abs(math.cos(elevation))
    covariance = scale[:, None] * motion_compensation.as_matrix(s.covariance) * scale
    covariance[-2, -2] = max(covariance[-2, -2], covariance[-1, -1])
    measured = (*s.measured[:-2], 0.0, 0.0)
    return replace(s, measured=measured, covariance=tuple(covariance.ravel().tolist()), T_base_sensor=sensor)
