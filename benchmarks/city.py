"""A city that a robot drives through without end, and knows by loop closures alone: its truth, and what it measures.

Streets of square blocks of 4 m, a keyframe each metre, and a closure each third keyframe: to any earlier one that is
within two metres, however long ago.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.slam import Closure, Config, Measurement, Odometry
from graph_slam_ros.tools.simulation.manhattan import STEP_M, stroll
from graph_slam_ros.tools.simulation.pose_graph import closure_pairs
from graph_slam_ros.typing import Numbers

SIGMA_M, SIGMA_RAD = 0.05, 0.01
_STEP_NS = 1_000_000_000
_BEGIN_NS = 5 * _STEP_NS


class City:
    """A drive through the streets.

    Attributes
    ----------
    where : true positions (n, 2) of the keyframes
    closures : pairs (earlier, later) of keyframes, by the later one
    """

    def __init__(self, seed: int, keyframes: int, space: Geometry = PLANAR, blocks: int = 20) -> None:
        self.space, self._rng = space, np.random.Generator(np.random.PCG64(seed))
        cells, ways = stroll(self._rng, keyframes - 1, blocks)
        self.where, self._ways = STEP_M * cells, np.concatenate([ways[:1], ways])
        self.closures = closure_pairs(self._rng, cells)
        self._sigmas = np.array(space.sigmas(SIGMA_M, SIGMA_RAD))

    def pose(self, keyframe: int) -> Numbers:
        """The true pose of a keyframe."""
        x, y = map(float, self.where[keyframe])
        yaw = 0.5 * np.pi * float(self._ways[keyframe])
        if self.space is SPATIAL:
            return x, y, 0.0, 0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2))
        return x, y, yaw

    def in_map(self, keyframe: int) -> Numbers:
        """The true pose of a keyframe in a map that begins at the first one."""
        return self._between(self.pose(0), self.pose(keyframe))

    def measurements(self) -> Iterator[list[Measurement]]:
        """Return what the robot measures at each keyframe; once."""
        at, covariance = self.space.identity, tuple(np.diag(self._sigmas**2).ravel().tolist())
        pairs, begin = self.closures, np.searchsorted(self.closures[:, 1], np.arange(len(self.where) + 1))
        for k in range(len(self.where)):
            if k:
                at = self.space.normalized(self.space.group.compose(at, self._seen(k - 1, k)))
            out: list[Measurement] = [Odometry(stamp(k), tuple(map(float, at)), source="odom")]
            for first in pairs[begin[k] : begin[k + 1], 0].tolist():
                out.append(Closure(stamp(k), stamp(first), "loops", self._seen(first, k), covariance))
            yield out

    def _seen(self, first: int, last: int) -> Numbers:
        """A relative pose, with noise."""
        group = self.space.group
        error = group.exp(tuple(self._sigmas * self._rng.standard_normal(self.space.dof)))
        return tuple(map(float, group.compose(self._between(self.pose(first), self.pose(last)), error)))

    def _between(self, first: Numbers, last: Numbers) -> Numbers:
        return tuple(map(float, self.space.group.between(first, last)))


def stamp(keyframe: int) -> int:
    """The stamp of a keyframe [ns]."""
    return _BEGIN_NS + keyframe * _STEP_NS


def config(space: Geometry, **values: Any) -> Config:
    """Parameters of a pipeline for the noise of a city; more by name, with ``_`` for the dot."""
    densities = dict.fromkeys(("translation_density", "lateral_density", "vertical_density"), SIGMA_M)
    densities |= dict.fromkeys(("rotation_density", "tilt_density"), SIGMA_RAD)
    known: dict[str, Any] = {f"odometry.{name}": sigma for name, sigma in densities.items()}
    known |= {"world.dimensions": space.dimensions, "odometry.noise": "density", "odometry.max_speed_m_s": 20.0}
    known |= {"odometry.timeout_s": 3.0, "keyframes.min_distance_m": 0.3}
    known |= {"inputs.names": "odom loops", "loops.use": "closure", "loops.topic": "/loops"}
    return Config.from_mapping(known | {name.replace("_", ".", 1): value for name, value in values.items()})
