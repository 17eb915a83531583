"""Sensors: what can be seen from where, and with which noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from graph_slam_ros.graph.geometry import SPATIAL
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.slam import Sighting
from graph_slam_ros.typing import Array, Numbers

KINDS = ("position", "range_bearing", "bearing", "range")  # what a sensor may say, as in ``Sighting``


@dataclass(frozen=True, slots=True)
class RangeBearing:
    """A sensor of range and bearing in the plane, at the origin of base_link.

    Attributes
    ----------
    sigma_range_m, sigma_bearing_rad : standard deviations of its noise
    max_range_m : nothing is seen farther away
    field_of_view_rad : full angle around straight ahead
    """

    sigma_range_m: float
    sigma_bearing_rad: float
    max_range_m: float
    field_of_view_rad: float = 2.0 * np.pi

    def visible(self, T_world_base: Numbers, points: Array) -> NDArray[np.int64]:
        """Return which of the points (m, 2) in world are in range and in view."""
        x, y = se2.act(se2.inverse(T_world_base), tuple(points.T))
        near = np.hypot(x, y) <= self.max_range_m
        return np.flatnonzero(near & (np.abs(np.arctan2(y, x)) <= 0.5 * self.field_of_view_rad))

    def measure(self, rng: Generator, T_world_base: Numbers, points: Array, kind: str) -> tuple[Array, Array]:
        """The measurement of points (k, 2) in world: measured (k, m) and its covariance (k, m, m), as in ``Sighting``.

        A position's covariance is taken at what was measured: a driver knows no better.
        """
        x, y = se2.act(se2.inverse(T_world_base), tuple(points.T))
        polar = np.stack([np.hypot(x, y), np.arctan2(y, x)], axis=1)
        sigmas = np.array([self.sigma_range_m, self.sigma_bearing_rad])
        polar += sigmas * rng.standard_normal((len(points), 2))
        variances = np.diag(sigmas**2)
        if kind != "position":
            columns = {"range_bearing": [0, 1], "bearing": [1], "range": [0]}[kind]
            return polar[:, columns], np.tile(variances[np.ix_(columns, columns)], (len(points), 1, 1))
        distance, bearing = polar.T
        c, s = np.cos(bearing), np.sin(bearing)
        jacobian = np.empty((len(points), 2, 2))
        jacobian[:, 0, 0], jacobian[:, 0, 1] = c, -distance * s
        jacobian[:, 1, 0], jacobian[:, 1, 1] = s, distance * c
        covariance = jacobian @ variances @ np.swapaxes(jacobian, 1, 2)
        return np.stack([distance * c, distance * s], axis=1), covariance

    def observe(
        self, rng: Generator, T_world_base: Numbers, names: Sequence[str], points: Array, kind: str
    ) -> list[Sighting]:
        """Sightings of those of the points (m, 2) in world that are visible."""
        at = self.visible(T_world_base, points)
        return sightings([names[k] for k in at.tolist()], kind, *self.measure(rng, T_world_base, points[at], kind))


@dataclass(frozen=True, slots=True)
class TagCamera:
    """A sensor in space, looking along its x axis, that reads tags and sees points.

    Attributes
    ----------
    T_base_sensor : where it is
    sigmas : of a measured pose: three [m] along, three [rad] about the sensor's axes; the first three of a position
    sigma_range_m, sigma_bearing_rad : of a range; of azimuth and of elevation
    max_range_m : nothing is seen farther away
    field_of_view_rad : full angle of the cone in which it sees
    max_slant_rad : a tag is not read at a greater angle from its x axis, which points at the reader
    """

    T_base_sensor: Numbers
    sigmas: Numbers
    sigma_range_m: float
    sigma_bearing_rad: float
    max_range_m: float
    field_of_view_rad: float
    max_slant_rad: float

    def visible(self, T_world_base: Numbers, points: Array) -> NDArray[np.bool_]:
        """Return which of the points (m, 3) in world are in range and in view."""
        x, y, z = se3.act(se3.inverse(self._in_world(T_world_base)), tuple(points.T))
        distance = np.sqrt(x**2 + y**2 + z**2)
        return (distance <= self.max_range_m) & (x >= distance * np.cos(0.5 * self.field_of_view_rad))

    def observe(
        self, rng: Generator, T_world_base: Numbers, names: Sequence[str], tags: Array, kind: str
    ) -> list[Sighting]:
        """Sightings of those of the tags (m, 7) in world that are visible and not too slanted."""
        x, y, z = se3.act(se3.inverse(tuple(tags.T)), se3.position(self._in_world(T_world_base)))
        facing = x >= np.cos(self.max_slant_rad) * np.sqrt(x**2 + y**2 + z**2)
        at = np.flatnonzero(facing & self.visible(T_world_base, tags[:, :3]))
        seen = [names[k] for k in at.tolist()]
        if kind == "pose":
            return sightings(seen, kind, *self._poses(rng, T_world_base, tags[at]))
        return self._points(rng, T_world_base, seen, tags[at, :3], kind)

    def observe_points(
        self, rng: Generator, T_world_base: Numbers, names: Sequence[str], points: Array
    ) -> list[Sighting]:
        """Sightings of the positions of those of the points (m, 3) in world that are visible."""
        at = np.flatnonzero(self.visible(T_world_base, points))
        return self._points(rng, T_world_base, [names[k] for k in at.tolist()], points[at], "position")

    def _in_world(self, T_world_base: Numbers) -> Numbers:
        return se3.compose(T_world_base, self.T_base_sensor)

    def _poses(self, rng: Generator, T_world_base: Numbers, tags: Array) -> tuple[Array, Array]:
        """Poses (k, 7) in base_link and their covariances (k, 6, 6): moved and turned by the noise in sensor axes."""
        true = se3.between(self._in_world(T_world_base), tuple(tags.T))
        noise = (np.array(self.sigmas) * rng.standard_normal((len(tags), 6))).T
        position = np.add(se3.position(true), noise[:3])
        turned = so3.compose(so3.exp(tuple(noise[3:])), se3.rotation(true))
        measured = np.stack(se3.compose(self.T_base_sensor, (*position, *so3.normalize(turned))), axis=1)
        in_base = SPATIAL.in_parent_axes(self.T_base_sensor, np.diag(np.square(self.sigmas)))
        covariance = [SPATIAL.in_tangent(tuple(z), in_base) for z in measured.tolist()]
        return measured, np.reshape(covariance, (-1, 6, 6))

    def _points(
        self, rng: Generator, T_world_base: Numbers, names: Sequence[str], points: Array, kind: str
    ) -> list[Sighting]:
        x, y, z = se3.act(se3.inverse(self._in_world(T_world_base)), tuple(points.T))
        noise = rng.standard_normal((len(points), 3))
        if kind == "position":
            sigmas, turn = np.array(self.sigmas[:3]), SPATIAL.turn(self.T_base_sensor)
            covariance = turn @ np.diag(sigmas**2) @ turn.T
            in_sensor = np.stack([x, y, z]) + (sigmas * noise).T
            measured = np.stack(se3.act(self.T_base_sensor, tuple(in_sensor)), axis=1)
            return sightings(names, kind, measured, np.tile(covariance, (len(points), 1, 1)))
        sigmas = np.array([self.sigma_range_m, self.sigma_bearing_rad, self.sigma_bearing_rad])
        flat = np.hypot(x, y)
        polar = np.stack([np.hypot(flat, z), np.arctan2(y, x), np.arctan2(z, flat)], axis=1) + sigmas * noise
        columns = {"range_bearing": [0, 1, 2], "bearing": [1, 2], "range": [0]}[kind]
        covariance = np.tile(np.diag(sigmas[columns] ** 2), (len(points), 1, 1))
        return sightings(names, kind, polar[:, columns], covariance, self.T_base_sensor)


def sightings(
    names: Sequence[str], kind: str, measured: Array, covariance: Array, T_base_sensor: Numbers | None = None
) -> list[Sighting]:
    """Sightings from arrays, a row each: measured (k, m) and covariance (k, m, m)."""
    rows = zip(names, measured.tolist(), covariance, strict=True)
    return [Sighting(name, kind, tuple(z), tuple(c.ravel().tolist()), T_base_sensor) for name, z, c in rows]
