"""Whatever the border lets through, in whatever order: nothing is raised, and what comes out is finite or unknown."""

import itertools

import numpy as np
import pytest
from reliability import times

from graph_slam_ros.lie import so3
from graph_slam_ros.measurements.types import InitialPose
from graph_slam_ros.slam import Closure, Config, Control, Fix, GraphSlam, Odometry, Sighting, Sightings

S = 1_000_000_000
LAST_NS = (2**31 - 100) * S
FARTHEST_M, MOST_M2, MOST_RAD2 = 1e9, 1e6, 1e3  # what the border lets through
ASSOCIATIONS = ("none", "id", "joint")


class Stranger:
    """Draws measurements of every kind: some of a robot in a world of a few landmarks, some of nothing at all."""

    def __init__(self, seed, dimensions, association):
        self.rng = np.random.default_rng([seed, dimensions, ASSOCIATIONS.index(association)])
        self.config = self.configuration(dimensions, association)
        self.space = self.config.space
        self.n, self.dof = dimensions, self.space.dof
        self.wildness = self.pick(0.0, 0.02, 0.5)
        self.stamp_ns, self.at = 5 * S, self.space.identity
        self.world = [self.pose(4.0) for _ in range(5)]

    def configuration(self, dimensions, association):
        values = {
            "world.dimensions": dimensions,
            "landmarks.association": association,
            "landmarks.added_sigma_m": self.pick(0.0, 0.05),
            "landmarks.unnamed_sigma_m": self.pick(0.0, 0.1),
            "landmarks.loss": self.pick("none", "huber", "cauchy", "huber_then_cauchy"),
            "keyframes.shared_noise": self.pick(0.0, 0.05, 1e9),
            "odometry.noise": self.pick("twist", "density"),
            "ordering.window_s": self.pick(0.0, 0.05),
            "ordering.late_s": self.pick(0.5, 10.0),
            "ordering.max_waiting": self.pick(2, 1000, 1000),
            "solve.every_keyframes": self.pick(1, 3),
            "solve.method": self.pick("gn", "lm", "dogleg"),
            "solve.max_iterations": 20,
        }
        if self.rng.random() < 0.3:  # as for satellites
            values |= {"anchor.sigma_m": 1000.0, "anchor.sigma_rad": 3.0}
        return Config.from_mapping(values)

    def pick(self, *values):
        return values[self.rng.integers(len(values))]

    def happens(self, probability):
        return self.rng.random() < probability

    def is_wild(self):
        return self.happens(self.wildness)

    def length(self):
        return float(self.pick(0.0, 1e-12, 1.0, 50.0, 1e4, FARTHEST_M) * self.pick(-1.0, 1.0, self.rng.random()))

    def pose(self, spread):
        return tuple(map(float, self.space.group.exp(tuple(self.rng.standard_normal(self.dof) * spread))))

    def any_pose(self):
        turn = self.rng.standard_normal(2 * self.n - 3) * self.pick(0.0, 1e-9, 1.0, 3.0)
        q = so3.exp(tuple(turn)) if self.n == 3 else np.clip(turn, -np.pi, np.pi)
        return (*(self.length() for _ in range(self.n)), *map(float, q))

    def covariance(self, lengths, angles):
        size, low = lengths + angles, self.pick(-6.0, -2.0, -30.0)
        most = np.log10([MOST_M2] * lengths + [MOST_RAD2] * angles)
        sigmas = 10.0 ** (0.5 * self.rng.uniform(low, most if self.is_wild() else -1.0))
        turn = np.linalg.qr(self.rng.standard_normal((size, size)))[0] if self.happens(0.5) else np.eye(size)
        correlated = (turn * 10.0 ** self.rng.uniform(-8.0, 0.0, size)) @ turn.T
        scale = sigmas / np.sqrt(np.diag(correlated))
        out = scale[:, None] * correlated * scale
        return tuple((0.5 * (out + out.T)).ravel().tolist())

    def pose_covariance(self):
        return self.covariance(self.n, self.dof - self.n)

    def odometry(self):
        if self.is_wild():
            self.at = self.any_pose()
            self.stamp_ns = min(self.stamp_ns + self.pick(0, 1, 100 * S, 10**9 * S), LAST_NS)
        else:
            step = tuple(self.rng.standard_normal(self.dof) * self.pick(0.0, 0.2))
            self.at = tuple(map(float, self.space.group.retract(self.at, step)))
            self.stamp_ns += int(self.rng.integers(S // 5))
        twist = self.pose_covariance() if self.happens(0.3) else None
        return Odometry(self.stamp_ns - self.late_ns(), self.at, twist, self.pick("odom", "odom", "odom", "wheels"))

    def late_ns(self):
        if self.is_wild():
            return int(self.rng.integers(-20 * S, 20 * S))
        return int(self.pick(0, 0, self.rng.integers(S // 20)))

    def sighting(self):
        kind = self.pick("position", "pose", "range_bearing", "bearing", "range")
        seen = self.any_pose() if self.is_wild() else self.space.group.between(self.at, self.pick(*self.world))
        p, sensor = np.array(seen[: self.n]), None
        reach, flat = float(np.linalg.norm(p)), float(np.hypot(p[0], p[1]))
        angles = (float(np.arctan2(p[1], p[0])), *((float(np.arctan2(p[2], flat)),) if self.n == 3 else ()))
        far = (float(np.clip(reach, 1e-300, FARTHEST_M)),)
        measured = {"position": seen[: self.n], "pose": seen, "range_bearing": (*far, *angles), "bearing": angles}
        if kind in ("position", "pose"):
            covariance = self.covariance(self.n, self.dof - self.n if kind == "pose" else 0)
        else:
            covariance = self.covariance(int("range" in kind), len(angles) if "bearing" in kind else 0)
            sensor = self.any_pose() if self.is_wild() else self.pick(None, self.pose(0.3))
        name = self.pick("", "", "a", "b", "unnamed1")
        return Sighting(name, kind, tuple(map(float, measured.get(kind, far))), covariance, sensor)

    def sightings(self):
        topic = self.pick("camera", "lidar")
        count = self.rng.integers(4)
        return Sightings(self.stamp_ns - self.late_ns(), topic, tuple(self.sighting() for _ in range(count)))

    def fix(self):
        kind = self.pick("pose", "position", "heading", "attitude")
        at = self.any_pose() if self.is_wild() else self.at
        measured = {
            "pose": at,
            "position": at[: self.n],
            "heading": (self.space.heading(at),),
            "attitude": at[self.n :] if self.n == 3 else (0.0, 0.0, 0.0, 1.0),
        }
        lengths = self.n if kind in ("pose", "position") else 0
        angles = {"pose": self.dof - self.n, "position": 0, "heading": 1, "attitude": 3}[kind]
        covariance = self.covariance(lengths, angles)
        if kind == "position" and self.happens(0.3):  # an axis is not known
            covariance = tuple(np.diag([1.0] * (self.n - 1) + [MOST_M2]).ravel().tolist())
        point = self.any_pose()[: self.n] if kind == "position" and self.is_wild() else ()
        return Fix(self.stamp_ns - self.late_ns(), "fixes", kind, tuple(map(float, measured[kind])), covariance, point)

    def closure(self):
        back_ns = int(self.rng.integers(-S, 10 * S))
        at = self.any_pose() if self.is_wild() else self.pose(0.5)
        return Closure(self.stamp_ns - self.late_ns(), self.stamp_ns - back_ns, "loops", at, self.pose_covariance())

    def event(self):
        event = self.pick("flush", "optimize", "end", "clear_closures", "time_jump", "set", "initial_pose")
        if event == "initial_pose":
            return InitialPose(self.any_pose() if self.is_wild() else self.pose(1.0), self.pose_covariance())
        if event == "time_jump" and self.happens(0.5):
            self.stamp_ns = 5 * S
        return Control(event, (("solve.every_keyframes", self.pick(1, 3)),) if event == "set" else ())

    def measurements(self, count):
        for _ in range(count):
            yield self.odometry()
            if self.happens(0.7):
                yield self.sightings()
            if self.happens(0.1):
                yield self.fix()
            if self.happens(0.1):
                yield self.closure()
            if self.happens(0.05):
                yield self.event()
        yield from (Control("end"), Control("optimize"))


def is_covariance(c):
    """Finite with variances above zero, or not known at all."""
    return np.isnan(c).all() or bool(np.isfinite(c).all() and (np.diag(c) > 0.0).all())


def check(view):
    assert np.isfinite(view.trajectory()).all()
    assert np.isfinite(view.T_map_odom).all()
    assert is_covariance(view.pose_covariance)
    assert all(map(is_covariance, view.keyframe_covariances()))
    assert all(map(is_covariance, view.landmark_covariances()))
    assert all(view.waiting.values())


def drive(seed, dimensions, association, count=60):
    stranger = Stranger(seed, dimensions, association)
    slam = GraphSlam(stranger.config)
    for k, m in enumerate(stranger.measurements(count)):
        slam.process(m)
        if k % 50 == 49:
            check(slam.view)
    check(slam.view)
    return slam


def written(slam):
    parts = (slam.view.trajectory(), slam.view.keyframe_covariances(), *slam.view.landmark_covariances())
    return [part.tobytes() for part in parts], slam.counters.as_dict(), slam.view.graph.edge_count


@pytest.mark.parametrize("dimensions, association", list(itertools.product((2, 3), ASSOCIATIONS)))
def test_whatever_is_measured_nothing_is_raised_and_nothing_infinite_comes_out(dimensions, association):
    count = times(20, 60)
    once = drive(0, dimensions, association, count)
    assert len(once.view.keyframes) > 1
    assert written(drive(0, dimensions, association, count)) == written(once)
    for seed in range(1, times(1, 20)):
        drive(seed, dimensions, association, count)
