"""Places instead of keyframes: a robot drives in one hall, with all keyframes kept and with old visits condensed.

``python -m benchmarks.lifelong``. A hall of 60 by 40 m, aisles driven at random, a keyframe each 0.5 m, 40 landmarks
that are seen within 8 m, every second one. The graph and its solver are used directly: no robust decisions. Errors are
in the frame of the landmarks; NEES is that of one degree of freedom, 1 is right.
"""

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

if not __package__:  # run as a script: what it imports is in the repository, not in its folder
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.geometry import PLANAR, Geometry
from graph_slam_ros.slam import Config, Measurement, Odometry, Sighting, Sightings
from graph_slam_ros.slam.lifelong.compaction import compact
from graph_slam_ros.slam.lifelong.condenser import Condenser, RemovedPose, poses_of
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Numbers

STEP_M, REACH_M, SEEN = 0.5, 8.0, 0.5
CELL_M, LONGEST = 10.0, 60
_COLUMNS = ("id", "vertices", "measured", "sqrt_information", "label", "source", "weight")
DEAD = 8  # edges in the tables for each that counts: then these are made anew
SIGMA_ALONG, SIGMA_TURN, SIGMA_RANGE, SIGMA_BEARING = 0.01, 0.005, 0.05, np.deg2rad(1.0)
_X, _Y = np.array([6.0, 18.0, 30.0, 42.0, 54.0]), np.array([6.0, 20.0, 34.0])


@dataclass(frozen=True, slots=True)
class Hall:
    """A drive: true poses, landmarks, odometry, and what each keyframe sees: landmark, position and its covariance."""

    space: Geometry
    poses: list[tuple[float, ...]]
    points: Array
    steps: list[tuple[float, ...]]
    sightings: list[list[tuple[int, Array, Array]]]

    @property
    def sigmas(self) -> list[float]:
        """Standard deviations of a step of odometry."""
        n = self.space.dimensions
        return [SIGMA_ALONG, *[SIGMA_TURN] * (n - 1), *[SIGMA_TURN] * (self.space.dof - n)]


def hall(seed: int, keyframes: int, space: Geometry = PLANAR, landmarks: int = 40) -> Hall:
    """Make a drive."""
    rng, n = np.random.default_rng(seed), space.dimensions
    where = _driven(rng, keyframes + 1)
    yaw = np.arctan2(*np.diff(where, axis=0).T[::-1])
    poses = [_pose(space, *at, turn) for at, turn in zip(where[:-1].tolist(), yaw.tolist(), strict=True)]
    grid = np.array([(60 * (i + 0.5) / 8, 40 * (j + 0.5) / 5) for i in range(8) for j in range(5)])[:landmarks]
    points = np.zeros((len(grid), n))
    points[:, :2] = grid + rng.uniform(-2.5, 2.5, grid.shape)
    points[:, 2:] = rng.uniform(0.0, 3.0, (len(grid), n - 2))
    world = Hall(space, poses, points, [], [])
    group = space.group
    for k, pose in enumerate(poses):
        if k:
            error = group.exp(tuple(np.array(world.sigmas) * rng.standard_normal(space.dof)))
            world.steps.append(tuple(map(float, group.compose(group.between(poses[k - 1], pose), error))))
        local = np.stack(group.act(group.inverse(pose), tuple(points.T)), axis=-1)
        near = (np.hypot(*local.T[:2]) < REACH_M) & (rng.random(len(points)) < SEEN)
        world.sightings.append([(int(m), *_seen(local[m], rng)) for m in np.flatnonzero(near)])
    return world


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


def _pose(space: Geometry, x: float, y: float, yaw: float) -> tuple[float, ...]:
    if space.dimensions == 2:
        return x, y, yaw
    return x, y, 0.0, 0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2))


def _seen(there: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return a sighting: noise along the ray, and as much as the bearing has across it."""
    distance = float(np.linalg.norm(there))
    ray = there / distance
    along, across = SIGMA_RANGE, SIGMA_BEARING * distance
    covariance = across**2 * np.eye(len(there)) + (along**2 - across**2) * np.outer(ray, ray)
    return there + np.linalg.cholesky(covariance) @ rng.standard_normal(len(there)), covariance


STEP_S = 0.2


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


def measurements(world: Hall) -> Iterator[Measurement]:
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
        sightings = (
            Sighting(f"m{mark}", "position", tuple(at.tolist()), tuple(noise.ravel().tolist()))
            for mark, at, noise in seen
        )
        yield Sightings(stamp_ns, "landmarks", tuple(sightings))


@dataclass(slots=True)
class Robot:
    """A robot that maps a hall, a keyframe at a time; ``window`` keyframes stay as they are, all of them where it is 0.

    Attributes
    ----------
    vertices : of the keyframes that are in the problem; marks : of the landmarks
    removed : the other keyframes: their number, that of their base, and the pose between them
    first : the oldest keyframe that was not condensed; ends : how often a visit ended how
    statistics, degrees : of the visits that were added to a place, together
    """

    world: Hall
    window: int = 0
    vertices: dict[int, int] = field(default_factory=dict)
    removed: list[RemovedPose] = field(default_factory=list)
    marks: dict[int, int] = field(default_factory=dict)
    first: int = 1
    ends: dict[str, int] = field(default_factory=dict)
    statistics: float = 0.0
    degrees: int = 0
    update_s: list[float] = field(default_factory=list)
    condense_s: list[float] = field(default_factory=list)
    solver: Solver = field(init=False)
    condenser: Condenser = field(init=False)

    def __post_init__(self) -> None:
        self.solver = Solver(Graph())
        self.condenser = Condenser(self.world.space, self.solver)

    def drive(self, keyframe: int) -> None:
        """Add a keyframe, solve, and condense a visit if one has left the window."""
        world, space, graph = self.world, self.world.space, self.graph
        new, edges = [], []
        if not keyframe:
            pose = world.poses[0]
        else:
            (before,) = self.solver.estimate([self.vertices[keyframe - 1]]).tolist()
            pose = tuple(map(float, space.group.compose(tuple(before), world.steps[keyframe - 1])))
        vertex = graph.add_vertex(space.pose, space.normalized(pose))
        new.append(vertex)
        if not keyframe:
            noise = Gaussian.from_sigmas(*[1e-3] * space.dof)
            edges.append(graph.add_edge(space.pose_prior, [vertex], pose, noise, "priors"))
        else:
            noise, ends = Gaussian.from_sigmas(*world.sigmas), [self.vertices[keyframe - 1], vertex]
            edges.append(graph.add_edge(space.relative_pose, ends, world.steps[keyframe - 1], noise, "odometry"))
        for mark, seen, covariance in world.sightings[keyframe]:
            if mark not in self.marks:
                self.marks[mark] = graph.add_vertex(space.point, np.array(space.group.act(pose, tuple(seen))))
                new.append(self.marks[mark])
            noise, ends = Gaussian.from_covariance(covariance), [vertex, self.marks[mark]]
            edges.append(graph.add_edge(space.sightings["position"], ends, seen, noise, "landmarks"))
        self.vertices[keyframe] = vertex
        self.solver.add(new, edges)
        self._update()
        if self.window and keyframe >= self.first + self.window:
            self._condense(keyframe)

    def _update(self) -> None:
        began = time.thread_time()
        self.solver.update()
        self.update_s.append(time.thread_time() - began)

    def _condense(self, newest: int) -> None:
        began, first = time.thread_time(), self.first
        at = self.solver.estimate([self.vertices[k] for k in range(first, min(first + LONGEST, newest))])
        cells = list(map(tuple, np.floor(at[:, : self.world.space.dimensions] / CELL_M).tolist()))
        length = next((k for k, cell in enumerate(cells) if cell != cells[0]), len(cells))
        end = first + length
        if end + self.window > newest:
            return
        ahead = {self.marks[one[0]] for seen in self.world.sightings[end : newest + 1] for one in seen}
        done = self.condenser.condense(
            [self.vertices[k] for k in range(first, end)], self.vertices[end], cells[0], ahead
        )
        self.condense_s.append(time.thread_time() - began)
        self.ends[done.how] = self.ends.get(done.how, 0) + 1
        self.statistics, self.degrees = self.statistics + done.statistic, self.degrees + done.degrees
        if done.how != "waits":
            self.first = end
        number = {vertex: k for k, vertex in self.vertices.items()}
        self.removed += [RemovedPose(number[one.vertex], number[one.base], one.T_base_vertex) for one in done.removed]
        for one in done.removed:
            del self.vertices[number[one.vertex]]
        if done.how not in ("waits", "kept"):
            self._update()
        if self.graph.edge_count > DEAD * len(self.solver.edges):
            self.compact()

    def compact(self) -> None:
        """Make graph and solver anew without what was removed."""
        new = compact(self.solver)
        self.condenser.renumber(new)
        self.vertices = {k: int(new.vertices[vertex]) for k, vertex in self.vertices.items()}
        self.marks = {mark: int(new.vertices[vertex]) for mark, vertex in self.marks.items()}
        self._update()

    @property
    def graph(self) -> Graph:
        """The present graph."""
        return self.solver.graph

    def landmarks(self) -> tuple[Array, Array]:
        """Estimated and true positions of the landmarks."""
        marks = sorted(self.marks)
        return self.solver.estimate([self.marks[mark] for mark in marks]), self.world.points[marks]

    def path(self) -> Array:
        """Estimated positions of all keyframes, those that were removed included."""
        n, kept = self.world.space.dimensions, list(self.vertices)
        at = map(tuple, self.solver.estimate([self.vertices[k] for k in kept]).tolist())
        poses = poses_of(self.world.space, self.removed, dict(zip(kept, at, strict=True)))
        return np.array([poses[k][:n] for k in sorted(poses)])

    def megabytes(self) -> float:
        """Memory of the tables of the graph and of the arrays of its solver."""
        tables = [getattr(table, name) for table in self.graph.tables.values() for name in _COLUMNS]
        columns = [self.graph.kind, self.graph.offset, self.graph.initial, *tables]
        return 1e-6 * (sum(len(c) * c.values[:1].nbytes for c in columns) + sum(a.nbytes for a in self.solver._tree))

    def newest(self) -> tuple[float, float, float]:
        """Return the error of the newest pose [m], its NEES, and that of the landmarks."""
        space, k, n = self.world.space, max(self.vertices), self.world.space.dimensions
        (pose,) = self.solver.estimate([self.vertices[k]])
        there, true = self.landmarks()
        turn, shift = fitted(there, true)
        error = float(np.linalg.norm(turn @ pose[:n] + shift - np.array(self.world.poses[k][:n])))
        (covariance,) = self.solver.marginal([self.vertices[k]])
        off = np.array(space.group.log(space.group.between(tuple(pose), self.world.poses[k])))
        joint = self.solver.joint_marginal([self.marks[mark] for mark in sorted(self.marks)])
        of_marks = (there - true).ravel()
        nees = float(off @ np.linalg.solve(covariance, off)) / len(off)
        return error, nees, float(of_marks @ np.linalg.solve(joint, of_marks)) / len(of_marks)


def fitted(estimated: Array, true: Array) -> tuple[Array, Array]:
    """Return the rotation and shift that lay the one on the other best."""
    middle, centre = estimated.mean(axis=0), true.mean(axis=0)
    u, _, vt = np.linalg.svd((estimated - middle).T @ (true - centre))
    flip = np.diag([*[1.0] * (len(middle) - 1), np.sign(np.linalg.det(vt.T @ u.T))])
    turn = vt.T @ flip @ u.T
    return turn, centre - turn @ middle


def rms(estimated: Array, true: Array) -> float:
    """Return the root mean square of what is left after one was laid on the other [m]."""
    turn, shift = fitted(estimated, true)
    return float(np.sqrt((((estimated @ turn.T + shift) - true) ** 2).sum(axis=1).mean()))


def driven(world: Hall, window: int, every: int = 40, warm: int = 640, tell: int = 0) -> tuple[Robot, dict[str, float]]:
    """Drive through a hall; returns the robot and its figures."""
    robot, looks = Robot(world, window), []
    for k in range(len(world.poses)):
        robot.drive(k)
        if k >= warm and k % every == 0:
            looks.append(robot.newest())
        if tell and k and k % tell == 0:
            recent = 1e3 * np.array(robot.update_s[-tell:])
            size = f"{len(robot.solver.vertices)} vertices, {len(robot.solver.edges)} edges, {robot.megabytes():.2f} MB"
            times = f"median {np.median(recent):.2f}, p99 {np.quantile(recent, 0.99):.1f}, worst {recent.max():.0f} ms"
            print(f"{k}: {size}, {times}", flush=True)
    error, nees, of_marks = np.array(looks).T
    recent = 1e3 * np.array(robot.update_s[len(robot.update_s) // 2 :])
    n = world.space.dimensions
    return robot, {
        "vertices": len(robot.solver.vertices),
        "edges": len(robot.solver.edges),
        "newest_m": float(np.sqrt((error**2).mean())),
        "path_m": rms(robot.path(), np.array([pose[:n] for pose in world.poses])),
        "landmarks_m": rms(*robot.landmarks()),
        "nees_newest": float(nees.mean()),
        "nees_landmarks": float(of_marks.mean()),
        "gate": robot.statistics / robot.degrees if robot.degrees else float("nan"),
        "median_ms": float(np.median(recent)),
        "p99_ms": float(np.quantile(recent, 0.99)),
        "cpu_ms": 1e3 * (sum(robot.update_s) + sum(robot.condense_s)) / len(world.poses),
    }


def main(arguments: list[str] | None = None) -> None:
    """Print a row for each seed, with all keyframes and with a window."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, default=1600)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--windows", type=int, nargs="+", default=[0, 60], help="keyframes; 0 keeps all")
    parser.add_argument("--tell", type=int, default=0, help="print sizes and times each so many keyframes")
    given = parser.parse_args(arguments)
    for seed in range(given.seeds):
        for window in given.windows:
            robot, figures = driven(hall(seed, given.keyframes), window, tell=given.tell)
            words = " ".join(f"{name}={value:.4g}" for name, value in figures.items())
            print(f"seed={seed} window={window} {words} {robot.ends}", flush=True)


if __name__ == "__main__":
    main()
