"""Corrections of odometry and sightings: those that are configured, and the factors of odometry that are found.

``INPUT.offset_s`` is applied where messages are read.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.config.inputs import InputConfig
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import so3
from graph_slam_ros.measurements.types import Observation, Sighting, Sightings
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.typing import Array, Numbers

_LONGEST_LAG_S = 1.0  # a clock that is corrected by more is another clock, not a late one

Key = tuple[str, str]
"""Input, and the name of what is corrected."""
AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_FACTORS = ("distance", "turn")
_ODOMETRY = {"distance": "distance_factor", "turn": "turn_factor", "turn_bias": "turn_bias_rad_s"}


class Corrections:
    """The corrections that apply at present.

    Attributes
    ----------
    factors : of odometry's distance and turn
    """

    def __init__(self, config: Config) -> None:
        self._config, self._space = config, config.space
        self._inputs = {one.name: one for one in config.sources}
        lags = (-one.offset_s for one in config.sources)
        self.lag_ns = round(1e9 * max((lag for lag in lags if 0.0 < lag <= _LONGEST_LAG_S), default=0.0))
        self._of_sensor: dict[str, tuple[list[float], Numbers, float, float]] = {}  # by input
        self.found = {}

    @property
    def found(self) -> dict[Key, float]:
        """Factors of odometry that the association found, by which those that are configured are multiplied."""
        return self._found

    @found.setter
    def found(self, found: dict[Key, float]) -> None:
        self._found = found
        distance, turn = (self._factor(name) for name in _FACTORS)
        self.factors = distance, turn

    def _factor(self, name: str) -> float:
        found = next((value for (_, other), value in self.found.items() if other == name), 1.0)
        return float(getattr(self._config.odometry, _ODOMETRY[name])) * found

    def configured(self, key: Key) -> float:
        """Return the configured value of a parameter."""
        source, name = key
        if name in _ODOMETRY:
            return float(getattr(self._config.odometry, _ODOMETRY[name]))
        settings = self._inputs.get(source) or InputConfig(source)
        if name in AXES:
            return (settings.numbers("mount_correction", 6) or (0.0,) * 6)[AXES.index(name)]
        return float(
            {"clock": settings.offset_s, "range_factor": settings.range_factor}.get(name, settings.range_offset_m)
        )

    def total(self, source: str, name: str) -> float:
        """Return the configured value of a parameter of an input, with the factor that was found."""
        return self.configured((source, name)) * self.found.get((source, name), 1.0)

    def restore(self, totals: Mapping[Key, float]) -> None:
        """Continue with the values of another run, whatever is configured now."""
        self.found = {key: total / self.configured(key) for key, total in totals.items() if key[1] in _FACTORS}

    def totals(self) -> dict[Key, float]:
        """Return what was found with what is configured, as ``restore`` expects it."""
        return {key: self.total(*key) for key in self.found}

    def lines(self) -> dict[str, float]:
        """Return the configuration parameters that state what was found."""
        return {f"odometry.{_ODOMETRY[key[1]]}": float(f"{self.total(*key):.6g}") for key in self.found}

    # -- odometry ----------------------------------------------------------------------------------------------------

    def step(self, step: Step, seconds: float = 0.0) -> Step:
        """A step of odometry that lasts some seconds, corrected; where it leads to in its own frame stays.

        Without seconds its turn is without the configured bias.
        """
        return replace(step, T_last_base=self.motion(step.T_last_base, seconds))

    def with_bias(self, step: Step, seconds: float) -> Step:
        """A step whose factors are corrected, with the turn rate that is added."""
        return replace(step, T_last_base=self._corrected(step.T_last_base, 1.0, 1.0, seconds))

    def motion(self, motion: Numbers, seconds: float = 0.0) -> Numbers:
        """A motion by odometry, corrected; its numbers may be arrays."""
        return self._corrected(motion, *self.factors, seconds)

    def _corrected(self, motion: Numbers, distance: float, turn: float, seconds: float) -> Numbers:
        turned = self._config.odometry.turn_bias_rad_s * seconds
        if (distance, turn, turned) == (1.0, 1.0, 0.0):
            return motion
        if turned and motion == self._space.identity:  # it stands
            turned = 0.0
        out = scaled(self._space, motion, distance, turn, turned)
        return out if isinstance(out[0], np.ndarray) else tuple(map(float, out))

    @property
    def are_configured(self) -> bool:
        """Return whether the configuration corrects odometry."""
        c = self._config.odometry
        return (c.distance_factor, c.turn_factor, c.turn_bias_rad_s) != (1.0, 1.0, 0.0)

    def uncorrected(self, motion: Numbers) -> Numbers:
        """Undo the correction of a motion, except for its bias."""
        distance, turn = self.factors
        return scaled(self._space, motion, 1.0 / distance, 1.0 / turn)

    # -- sightings ---------------------------------------------------------------------------------------------------

    def observation(self, m: Observation) -> Observation:
        """Return an observation with its corrections."""
        if not isinstance(m, Sightings):
            return m
        mount, turned, scale, offset = self._sensor(m.topic)
        if not any(mount) and (scale, offset) == (1.0, 0.0):
            return m
        return replace(m, sightings=tuple(self._sighting(s, mount, turned, scale, offset) for s in m.sightings))

    def _sensor(self, source: str) -> tuple[list[float], Numbers, float, float]:
        """Return the correction of a sensor's mount and its turn, and the factor and offset of its ranges."""
        if source not in self._of_sensor:
            mount = [self.configured((source, axis)) for axis in AXES]
            ranges = self.configured((source, "range_factor")), self.configured((source, "range_offset"))
            self._of_sensor[source] = mount, self._turn(mount), *ranges
        return self._of_sensor[source]

    def _turn(self, mount: list[float]) -> Numbers:
        if self._space.dimensions == 2:
            return 0.0, 0.0, mount[5]
        return (0.0, 0.0, 0.0, *map(float, so3.exp((mount[3], mount[4], mount[5]))))

    def _sighting(self, s: Sighting, mount: list[float], turn: Numbers, scale: float, offset: float) -> Sighting:
        space = self._space
        T_base_sensor = s.T_base_sensor or space.identity
        if s.kind in ("position", "pose"):
            moved = moved_with_sensor(space, s.measured, T_base_sensor, turn, mount)
            covariance = s.covariance
            if s.kind == "position":
                rotation = space.turn(turn)
                covariance = tuple((rotation @ _square(covariance) @ rotation.T).ravel().tolist())
            return replace(s, measured=tuple(map(float, moved)), covariance=covariance)
        at = moved_with_sensor(space, T_base_sensor, T_base_sensor, turn, mount)
        measured = s.measured
        if s.kind in ("range", "range_bearing"):
            measured = (scale * measured[0] + offset, *measured[1:])
        return replace(s, measured=measured, T_base_sensor=tuple(map(float, at)))


def scaled(space: Geometry, motion: Numbers, distance: Any, turn: float, turned: Any = 0.0) -> Numbers:
    """A motion with its distance and turn multiplied, and turned by an angle besides. Numbers may be arrays."""
    n = space.dimensions
    tangent = [x * (distance if k < n else turn) for k, x in enumerate(space.group.log(motion))]
    tangent[-1] = tangent[-1] + turned
    out: Numbers = space.group.exp(tuple(tangent))
    return out


def moved_with_sensor(
    space: Geometry, pose: Numbers, sensor: Numbers, turn: Numbers, shift: Sequence[float] | Array
) -> Numbers:
    """Return a pose or a point in the base frame after its sensor was turned about its origin, and moved.

    Numbers may be arrays. ``sensor`` begins with the sensor's position, ``turn`` is a pose without one.
    """
    n = space.dimensions
    around = (*(pose[k] - sensor[k] for k in range(n)), *pose[n:])
    turned = space.group.act(turn, around) if len(around) == n else space.group.compose(turn, around)
    return (*(turned[k] + sensor[k] + shift[k] for k in range(n)), *turned[n:])


def _square(flat: Numbers) -> Array:
    size = math.isqrt(len(flat))
    return np.array(flat).reshape(size, size)


def read_totals(record: Sequence[Any]) -> dict[Key, float]:
    """Read values by input and name from plain lists. Raises ValueError if one is not finite."""
    totals = {(str(source), str(name)): float(value) for source, name, value in record}
    if not all(map(math.isfinite, totals.values())):
        raise ValueError(f"a calibration is not finite: {record}")
    return totals
