"""A drive among landmarks whose odometry and sensor are not quite what they are configured to be."""

from dataclasses import dataclass

import numpy as np

from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Config, Control, GraphSlam, MapView, Odometry, Sighting, Sightings

SECOND_NS = 10**9
START_NS = 10**12


@dataclass(frozen=True)
class Faults:
    """What is wrong: factors by which odometry is to be multiplied, and what is to be added to stamps and mount."""

    distance: float = 1.0
    turn: float = 1.0
    clock_s: float = 0.0
    yaw: float = 0.0
    range_factor: float = 1.0
    range_offset: float = 0.0
    wrong_ids: float = 0.0


@dataclass(frozen=True)
class Truth:
    """Stamps (n,) and true poses (n, 3)."""

    stamps_ns: np.ndarray
    poses: np.ndarray

    def at(self, stamp_ns: int) -> tuple[float, ...]:
        """The pose between two of them."""
        k = int(np.clip(np.searchsorted(self.stamps_ns, stamp_ns, side="right") - 1, 0, len(self.stamps_ns) - 2))
        a, b = (tuple(one.tolist()) for one in self.poses[k : k + 2])
        part = float((stamp_ns - self.stamps_ns[k]) / (self.stamps_ns[k + 1] - self.stamps_ns[k]))
        return se2.interpolate(a, b, part)


def imperfect_drive(faults: Faults, **how) -> list[Odometry | Sightings]:
    """Measurements of a robot that winds its way among twelve landmarks, as of ``imperfect_drive_and_truth``."""
    return imperfect_drive_and_truth(faults, **how)[0]


def imperfect_drive_and_truth(
    faults: Faults, *, seed: int = 0, seconds: float = 90.0, kind: str = "range_bearing", turns: float = 0.8
) -> tuple[list[Odometry | Sightings], Truth]:
    """Measurements of a robot that winds its way among twelve landmarks, and where it was.

    ``kind``: range_bearing, position, range or bearing; ``turns`` the amplitude of the turn rate [rad/s].
    """
    random = np.random.default_rng(seed)
    landmarks = 6.0 * random.uniform(-1.0, 1.0, (12, 2)) + (1.0, 2.0)
    step_s, pose, odom = 0.05, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    out: list[Odometry | Sightings] = []
    poses, stamps_ns = [], []
    for k in range(round(seconds / step_s)):
        t = k * step_s
        v, w = 0.5 + 0.2 * np.sin(0.7 * t), turns * np.sin(0.45 * t) + 0.25 * turns
        true = np.array([v, 0.0, w]) * step_s
        noise = np.array([0.01, 0.002, 0.01]) * np.sqrt(step_s) * random.standard_normal(3)
        told = (true + noise) / (faults.distance, 1.0, faults.turn)
        pose, odom = se2.compose(pose, se2.exp(tuple(true))), se2.compose(odom, se2.exp(tuple(told)))
        poses.append(pose)
        stamp_ns = START_NS + round((k + 1) * step_s * SECOND_NS)
        stamps_ns.append(stamp_ns)
        out.append(Odometry(stamp_ns, tuple(map(float, odom))))
        if k % 4 == 3:
            seen = tuple(_sighting(n, landmarks, pose, faults, kind, random) for n in range(len(landmarks)))
            stamp_ns -= round(faults.clock_s * SECOND_NS)
            if stamp_ns > START_NS + SECOND_NS:
                out.append(Sightings(stamp_ns, "detections", tuple(s for s in seen if s is not None)))
    return sorted(out, key=lambda m: m.stamp_ns), Truth(np.array(stamps_ns), np.array(poses))


def _sighting(
    n: int, landmarks: np.ndarray, pose: tuple[float, ...], faults: Faults, kind: str, random: np.random.Generator
) -> Sighting | None:
    x, y = se2.act(se2.inverse(pose), tuple(landmarks[n]))
    far, bearing = np.hypot(x, y), np.arctan2(y, x)
    if far > 5.0:
        return None
    name = str(n)
    if random.random() < faults.wrong_ids:
        name = str(random.integers(len(landmarks)))
    far = (far - faults.range_offset) / faults.range_factor + 0.03 * random.standard_normal()
    bearing = bearing - faults.yaw + 0.01 * random.standard_normal()
    if kind == "range":
        return Sighting(name, "range", (float(far),), (0.03**2,))
    if kind == "bearing":
        return Sighting(name, kind, (float(bearing),), (0.01**2,))
    if kind == "range_bearing":
        return Sighting(name, kind, (float(far), float(bearing)), (0.03**2, 0.0, 0.0, 0.01**2))
    turn = np.array([[np.cos(bearing), -np.sin(bearing)], [np.sin(bearing), np.cos(bearing)]])
    covariance = turn @ np.diag([0.03**2, (0.01 * far) ** 2]) @ turn.T
    measured = far * np.cos(bearing), far * np.sin(bearing)
    return Sighting(name, "position", tuple(map(float, measured)), tuple(covariance.ravel().tolist()))


def driven(measurements: list[Odometry | Sightings], settings: dict[str, object] | None = None) -> GraphSlam:
    """The pipeline after a drive."""
    quiet = {"odometry.translation_density": 0.01, "odometry.lateral_density": 0.002, "landmarks.added_sigma_m": 0.0}
    slam = GraphSlam(Config.from_mapping({**quiet, "odometry.rotation_density": 0.01, **(settings or {})}))
    for one in (*measurements, Control("end"), Control("optimize")):
        slam.process(one)
    return slam


def error_m(view: MapView, truth: Truth) -> float:
    """RMSE of the keyframes, moved onto the truth as well as a rigid motion can."""
    poses, true = view.trajectory()[:, :2], np.array([truth.at(int(s))[:2] for s in view.keyframes.stamps_ns])
    a, b = poses - poses.mean(axis=0), true - true.mean(axis=0)
    angle = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    moved = np.stack(se2.act((0.0, 0.0, float(angle)), tuple(a.T)), axis=-1)
    return float(np.sqrt(np.mean(np.sum((moved - b) ** 2, axis=1))))
