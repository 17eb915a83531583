"""A hall of 60 by 40 m that a robot drives through without end: its truth, and what it measures.

Aisles driven at random, a keyframe each 0.5 m, 40 landmarks that are seen within 8 m, every second one. They are
points, or tags whose orientation is seen, too.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from graph_slam_ros.graph.geometry import PLANAR, Geometry
from graph_slam_ros.slam import Config, Measurement, Odometry, Sighting, Sightings
from graph_slam_ros.typing import Array, Numbers

STEP_M, REACH_M, SEEN = 0.5, 8.0, 0.5
SIGMA_ALONG, SIGMA_TURN, SIGMA_RANGE, SIGMA_BEARING = 0.01, 0.005, 0.05, np.deg2rad(1.0)
SIGMA_ORIENTATION = 0.05  # of a tag [rad]
_X, _Y = np.array([6.0, 18.0, 30.0, 42.0, 54.0]), np.array([6.0, 20.0, 34.0])
STEP_S = 0.2
Seen = tuple[int, Array, Array]
"""A sighting: number of the landmark, its position or pose in the axes of the robot [m, rad], and the covariance."""


class Course:
    """The same drive, a keyframe at a time: only its positions are in memory.

    Attributes
    ----------
    where : true positions (n + 1, 2) of the keyframes and of the one after
    points : true positions of the landmarks; turns : their rotations, where they are tags
    poses, steps, sightings : true poses, odometry, and what each keyframe sees; of ``hall`` alone
    """

    poses: list[tuple[float, ...]]
    steps: list[tuple[float, ...]]
    sightings: list[list[Seen]]

    def __init__(self, seed: int, keyframes: int, space: Geometry = PLANAR, *, tags: bool = False) -> None:
        self.space, self._rng, n = space, np.random.default_rng(seed), space.dimensions
        self.where = _driven(self._rng, keyframes + 1)
        grid = np.array([(60 * (i + 0.5) / 8, 40 * (j + 0.5) / 5) for i in range(8) for j in range(5)])
        self.points = np.zeros((len(grid), n))
        self.points[:, :2] = grid + self._rng.uniform(-2.5, 2.5, grid.shape)
        self.points[:, 2:] = self._rng.uniform(0.0, 3.0, (len(grid), n - 2))
        angles = self._rng.uniform(-2.0, 2.0, (len(grid), space.dof - n)) if tags else np.empty((0, space.dof - n))
        self.turns = [space.group.exp((*[0.0] * n, *one))[n:] for one in angles.tolist()]

    def pose(self, keyframe: int) -> tuple[float, ...]:
        """The true pose of a keyframe: it looks at the next one."""
        (x, y), (dx, dy) = self.where[keyframe], self.where[keyframe + 1] - self.where[keyframe]
        return _pose(self.space, float(x), float(y), float(np.arctan2(dy, dx)))

    def keyframes(self) -> Iterator[tuple[tuple[float, ...], tuple[float, ...] | None, list[Seen]]]:
        """Return true pose, odometry since the keyframe before, and sightings of each; once."""
        rng, group, before = self._rng, self.space.group, None
        sigmas = np.array(_sigmas(self.space))
        for k in range(len(self.where) - 1):
            pose, step = self.pose(k), None
            if before is not None:
                error = group.exp(tuple(sigmas * rng.standard_normal(self.space.dof)))
                step = tuple(map(float, group.compose(group.between(before, pose), error)))
            local = np.stack(group.act(group.inverse(pose), tuple(self.points.T)), axis=-1)
            near = (np.hypot(*local.T[:2]) < REACH_M) & (rng.random(len(self.points)) < SEEN)
            seen = [self._seen(mark, pose, local[mark]) for mark in np.flatnonzero(near).tolist()]
            yield pose, step, seen
            before = pose

    def _seen(self, mark: int, pose: Numbers, there: Array) -> Seen:
        """Return a sighting: of a tag with its orientation."""
        position, covariance = seen_from(there, SIGMA_RANGE, SIGMA_BEARING, self._rng)
        if not self.turns:
            return mark, position, covariance
        space, group, n = self.space, self.space.group, self.space.dimensions
        seen = group.between(pose, (*self.points[mark].tolist(), *self.turns[mark]))
        error = (*[0.0] * n, *(SIGMA_ORIENTATION * self._rng.standard_normal(space.dof - n)).tolist())
        whole, turn = SIGMA_ORIENTATION**2 * np.eye(space.dof), space.turn(seen)
        whole[:n, :n] = turn.T @ covariance @ turn
        return mark, np.array((*position.tolist(), *group.compose(seen, group.exp(error))[n:])), whole


def hall(seed: int, keyframes: int, space: Geometry = PLANAR, *, tags: bool = False) -> Course:
    """Make a whole drive."""
    course = Course(seed, keyframes, space, tags=tags)
    course.poses, steps, course.sightings = map(list, zip(*course.keyframes(), strict=True))
    course.steps = steps[1:]
    return course


def _driven(rng: np.random.Generator, count: int) -> Array:
    """Positions each half metre, along aisles and 0.7 m to either side; no turn on the spot."""
    crossing, way = (0, 0), (0, 0)
    points = [np.array([_X[0], _Y[0]])]
    while len(points) < count:
        ways = [w for w in ((1, 0), (-1, 0), (0, 1), (0, -1)) if w != (-way[0], -way[1])]
        ways = [w for w in ways if 0 <= crossing[0] + w[0] < len(_X) and 0 <= crossing[1] + w[1] < len(_Y)]
        way = ways[rng.integers(len(ways))]
        crossing = crossing[0] + way[0], crossing[1] + way[1]
        goal = np.array([_X[crossing[0]], _Y[crossing[1]]]) + rng.uniform(-0.7, 0.7, 2)
        off = goal - points[-1]
        step = STEP_M * off / np.linalg.norm(off)
        points += [points[-1] + step * (k + 1) for k in range(int(np.linalg.norm(off) / STEP_M))]
    return np.array(points[:count])


def _sigmas(space: Geometry) -> list[float]:
    """Return the standard deviations of a step of odometry."""
    n = space.dimensions
    return [SIGMA_ALONG, *[SIGMA_TURN] * (n - 1), *[SIGMA_TURN] * (space.dof - n)]


def _pose(space: Geometry, x: float, y: float, yaw: float) -> tuple[float, ...]:
    if space.dimensions == 2:
        return x, y, yaw
    return x, y, 0.0, 0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2))


def seen_from(there: Array, along: float, bearing: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """A sighting of what is there: noise along the ray, and as much as the bearing has across it."""
    distance = float(np.linalg.norm(there))
    ray, across = there / distance, bearing * distance
    covariance = across**2 * np.eye(len(there)) + (along**2 - across**2) * np.outer(ray, ray)
    return there + np.linalg.cholesky(covariance) @ rng.standard_normal(len(there)), covariance


def config(space: Geometry, **values: Any) -> Config:
    """Parameters of a pipeline for the noise of a hall; more by name, with ``_`` for the dot."""
    per_root_s = STEP_S**-0.5
    densities = {
        "translation_density": SIGMA_ALONG,
        **dict.fromkeys(("lateral_density", "vertical_density", "rotation_density", "tilt_density"), SIGMA_TURN),
    }
    known = {f"odometry.{name}": sigma * per_root_s for name, sigma in densities.items()}
    known |= {"world.dimensions": space.dimensions, "odometry.noise": "density", "odometry.max_speed_m_s": 20.0}
    known |= {"odometry.timeout_s": 1.0, "keyframes.min_distance_m": 0.3, "landmarks.added_sigma_m": 0.0}
    return Config.from_mapping(known | {name.replace("_", ".", 1): value for name, value in values.items()})


def measurements(world: Course) -> Iterator[Measurement]:
    """What a robot measures in a hall: odometry and sightings at each keyframe, one keyframe each 0.2 s."""
    at = world.space.identity
    for k, seen in enumerate(world.sightings):
        if k:
            at = world.space.normalized(world.space.group.compose(at, world.steps[k - 1]))
        yield from measured(tuple(map(float, at)), round((k + 5) * STEP_S * 1e9), seen)


def measured(T_odom_base: Numbers, stamp_ns: int, seen: Sequence[tuple[int, Array, Array]]) -> Iterator[Measurement]:
    """What a robot measures at one keyframe."""
    yield Odometry(stamp_ns, T_odom_base, source="odom")
    if seen:
        kinds = {2: "position", 3: "pose"} if len(T_odom_base) == len(PLANAR.identity) else {3: "position", 6: "pose"}
        sightings = (
            Sighting(f"m{mark}", kinds[len(noise)], tuple(at.tolist()), tuple(noise.ravel().tolist()))
            for mark, at, noise in seen
        )
        yield Sightings(stamp_ns, "landmarks", tuple(sightings))


def without_ids(m: Sightings) -> Sightings:
    """Return the sightings without the ids of their landmarks."""
    return replace(m, sightings=tuple(replace(one, id="") for one in m.sightings))
