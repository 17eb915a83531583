"""A simulated recording with its truth: motion, what odometry says of it, measurements, and true loop closures."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from heapq import merge

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.slam import Closure, Odometry, Sighting, Sightings
from graph_slam_ros.tools.simulation.options import option, random
from graph_slam_ros.typing import Array, Index, Numbers

SIGMA_SPEED = option(0.05, "error of the measured speed", "m/s", 1e-6, 1)
SIGMA_SIDEWAYS = option(0.01, "speed of slipping sideways", "m/s", 1e-6, 1)
SIGMA_TURN = option(0.05, "error of the measured turning speed", "rad/s", 1e-6, 1)
CORRELATION_TIME = option(0.5, "how long such an error lasts (1/e)", "s", 0, 100)


@dataclass(frozen=True, slots=True)
class VelocityNoise:
    """Errors of measured velocity: an Ornstein-Uhlenbeck process in each component.

    Attributes
    ----------
    sigmas : standard deviations in tangent order: forward, sideways and turning speed in the plane, six in space
        [m/s, rad/s]
    correlation_time_s : how long an error lasts (1/e); 0: each tick draws its own, which holds for the tick
    """

    sigmas: tuple[float, ...]
    correlation_time_s: float = 0.0

    @property
    def covariance(self) -> Array:
        """(d, d) of one measured twist."""
        return np.diag(np.square(self.sigmas))

    def _memory(self, dt_s: float) -> float:
        return float(np.exp(-dt_s / self.correlation_time_s)) if self.correlation_time_s > 0.0 else 0.0

    def draw(self, rng: Generator, ticks: int, dt_s: float) -> Array:
        """Errors (ticks, d) of successive ticks, stationary from the first."""
        memory = self._memory(dt_s)
        errors = rng.standard_normal((ticks, len(self.sigmas)))
        fresh = np.sqrt(1.0 - memory**2)
        if memory:
            for k in range(1, ticks):
                errors[k] = memory * errors[k - 1] + fresh * errors[k]
        return errors * self.sigmas

    def per_tick(self, dt_s: float) -> Array:
        """Covariance (d, d) that a tick adds to the integral in the long run: sigma^2 dt^2 (1 + a) / (1 - a)."""
        memory = self._memory(dt_s)
        return self.covariance * (dt_s**2 * (1.0 + memory) / (1.0 - memory))


def space_of(pose: Sequence[float] | Array) -> Geometry:
    """Return the space of a pose by its number of values."""
    return PLANAR if len(pose) == PLANAR.pose.size else SPATIAL


def integrate(start: Numbers, steps: Array) -> Array:
    """Poses (n + 1, 3) or (n + 1, 7) from a start by n tangent steps: ``T[k + 1] = T[k] Exp(steps[k])``."""
    if space_of(start) is PLANAR:
        return _integrate_planar(start, steps)
    poses = [start]
    for step in steps.tolist():
        poses.append(se3.retract(poses[-1], tuple(step)))
    return np.array(poses)


def _integrate_planar(start: Numbers, steps: Array) -> Array:
    """Integrate in closed form, since headings add up; angles wrapped."""
    theta = start[2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    c, s = np.cos(theta[:-1]), np.sin(theta[:-1])
    dx, dy, _ = se2.exp(tuple(steps.T))
    x = start[0] + np.concatenate([[0.0], np.cumsum(c * dx - s * dy)])
    y = start[1] + np.concatenate([[0.0], np.cumsum(s * dx + c * dy)])
    return np.stack([x, y, se2.wrap(theta)], axis=1)


def moved_from(poses: Array, number: int, to: Sequence[float]) -> Array:
    """Poses of which those from a number on are moved together, so that the first of them lies there."""
    space, later = space_of(poses[0]), tuple(poses[number:].T)
    motion = space.group.compose(tuple(to), space.group.inverse(tuple(poses[number].tolist())))
    moved = space.group.retract(space.group.compose(motion, later), tuple(np.zeros((space.dof, len(poses) - number))))
    return np.concatenate([poses[:number], np.stack(moved, axis=1)])


def accumulated(steps: Array, per_tick: Array) -> Array:
    """Covariance (n + 1, d, d) of the poses that n steps lead to, each in its tangent space; the first is zero."""
    n, d = steps.shape
    group = se2 if d == 3 else se3
    out = np.zeros((n + 1, d, d))
    for k, step in enumerate(steps.tolist()):
        moved = tuple(float(number) for number in group.exp(tuple(step)))  # plain floats, for the kernels
        out[k + 1] = group.propagate(out[k], moved, group.noise_during(moved, per_tick))
    return out


Stamps = NDArray[np.int64]

START_NS = 1_700_000_000 * 10**9  # a plausible date: stamps near zero would hide faults of precision
LANDMARKS_TOPIC = "/landmarks"
CLOSURES_TOPIC = "/closures"


@dataclass(frozen=True, slots=True, eq=False)
class Gnss:
    """The measurements of a satellite receiver.

    Attributes
    ----------
    stamps_ns : (n,)
    geodetic : (n, 3) latitude [deg], longitude [deg] and height above the ellipsoid [m] of the antenna
    covariance : (3, 3) of each: the truth about the noise that was added, east, north and up [m^2]
    has_fix : (n,) where it does not, it says so
    antenna : in base_link [m]
    """

    stamps_ns: Stamps
    geodetic: Array
    covariance: Array
    has_fix: NDArray[np.bool_]
    antenna: Numbers


@dataclass(frozen=True, slots=True, eq=False)
class Imu:
    """The measurements of an inertial measurement unit.

    Attributes
    ----------
    stamps_ns : (n,)
    orientation : (n, 4) quaternions (x, y, z, w) of R_world_imu
    covariance : (3, 3) of each about the axes of world, without its drift [rad^2]
    rate, acceleration : (n, 3) in its own axes [rad/s, m/s^2]
    T_base_imu : where it is
    """

    stamps_ns: Stamps
    orientation: Array
    covariance: Array
    rate: Array
    acceleration: Array
    T_base_imu: Numbers


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A drive or flight: odometry and sightings as measured, poses and landmarks as they are.

    Poses have 3 numbers in the plane and 7 in space, velocities 3 and 6 (d), in tangent order.

    Attributes
    ----------
    stamps_ns : (n,) stamps of odometry and of the true poses
    T_odom_base : (n, 3) or (n, 7) dead-reckoned poses, from the origin [m, rad]
    twist : (n, d) measured velocity in base_link since the stamp before; the first is zero [m/s, rad/s]
    twist_covariance : (d, d) of each twist: the truth about the noise that was added
    odom_covariance : (n, d, d) of ``T_odom_base`` in its tangent space
    seen : in order of stamp, each at a stamp of odometry
    T_world_base : (n, 3) or (n, 7) true poses
    landmarks : true poses in world by id; of points the position alone
    closures : in order of their later stamp; both are stamps of odometry
    gnss, imu : None where the robot has none
    apriltag : whether tags are recorded as apriltag_ros publishes them
    """

    stamps_ns: Stamps
    T_odom_base: Array
    twist: Array
    twist_covariance: Array
    odom_covariance: Array
    seen: tuple[Sightings, ...]
    T_world_base: Array
    landmarks: dict[str, Numbers]
    closures: tuple[Closure, ...] = ()
    gnss: Gnss | None = None
    imu: Imu | None = None
    apriltag: bool = False


def measurements(recording: Recording) -> Iterator[Odometry | Sightings | Closure]:
    """Yield the input of ``GraphSlam.process`` in order of stamp; at one stamp odometry comes first.

    Measurements of a satellite receiver or an IMU are not among it: converters make fixes of them, from a bag.
    """
    covariance = tuple(recording.twist_covariance.ravel().tolist())
    poses = zip(recording.stamps_ns.tolist(), recording.T_odom_base.tolist(), strict=True)
    odometry = (Odometry(stamp_ns, tuple(pose), covariance) for stamp_ns, pose in poses)
    streams: tuple[Iterable[Odometry | Sightings | Closure], ...] = (odometry, recording.seen, recording.closures)
    yield from merge(*streams, key=lambda one: one.stamp_ns)


Observe = Callable[[Numbers], list[Sighting]]
"""From the true pose, what is seen."""


def drive(
    rng: Generator,
    start: Numbers,
    twists: Array,
    dt_ns: int,
    noise: VelocityNoise,
    observe: Observe,
    observe_every: int,
    landmarks: Mapping[str, Numbers],
) -> Recording:
    """Drive and record.

    Parameters
    ----------
    start : true pose at the first stamp; odometry begins at the origin
    twists : (n, 3) or (n, 6) true velocities in base_link, each for one tick [m/s, rad/s]
    observe_every : ticks from one look to the next, the first after the first tick
    landmarks : true poses or points by id
    """
    dt_s = dt_ns * 1e-9
    measured = twists + noise.draw(rng, len(twists), dt_s)
    truth = integrate(start, twists * dt_s)
    stamps_ns = START_NS + dt_ns * np.arange(len(truth), dtype=np.int64)
    seen = []
    for k in range(observe_every, len(truth), observe_every):
        sightings = observe(tuple(truth[k].tolist()))
        if sightings:
            seen.append(Sightings(int(stamps_ns[k]), LANDMARKS_TOPIC, tuple(sightings)))
    return Recording(
        stamps_ns=stamps_ns,
        T_odom_base=integrate(space_of(start).identity, measured * dt_s),
        twist=np.concatenate([np.zeros((1, twists.shape[1])), measured]),
        twist_covariance=noise.covariance,
        odom_covariance=accumulated(measured * dt_s, noise.per_tick(dt_s)),
        seen=tuple(seen),
        T_world_base=truth,
        landmarks=dict(landmarks),
    )


PLACE_M = 0.5  # between the places that closures join, along the way
REACH_M = 2.0  # from one end of a closure to the other at most
GAP_NS = 10 * 10**9  # and at least so much later
SIGMA_M, SIGMA_RAD = 0.05, 0.01
_STREAM = 0


def places(poses: Array) -> Index:
    """Numbers of the first pose, and of each pose (n, 3) or (n, 7) after a given distance from the one before."""
    steps = np.linalg.norm(np.diff(poses[:, : space_of(poses[0]).dimensions], axis=0), axis=1)
    count = np.floor(np.concatenate([[0.0], np.cumsum(steps)]) / PLACE_M)
    return np.flatnonzero(np.diff(count, prepend=-1.0) > 0.0)


def with_closures(recording: Recording, count: int, seed: int) -> Recording:
    """Add a number of true closures to a recording, evenly among the revisited places.

    Raises
    ------
    GraphSlamError
        It did not come back so often.
    """
    rng = random(seed, _STREAM)
    space, at = space_of(recording.T_world_base[0]), places(recording.T_world_base)
    n, truth, stamps_ns = space.dimensions, recording.T_world_base[at], recording.stamps_ns[at]
    back: list[tuple[int, Index]] = []
    for later, stamp_ns in enumerate(stamps_ns.tolist()):
        before = int(np.searchsorted(stamps_ns, stamp_ns - GAP_NS, side="right"))
        away = np.linalg.norm(truth[:before, :n] - truth[later, :n], axis=1)
        if (near := np.flatnonzero(away <= REACH_M)).size:
            back.append((later, near))
    if len(back) < count:
        raise GraphSlamError(f"{count} closures: the robot came back to {len(back)} places only")
    sigmas = np.concatenate([np.full(n, SIGMA_M), np.full(space.dof - n, SIGMA_RAD)])
    covariance = tuple(np.diag(np.square(sigmas)).ravel().tolist())
    found = []
    for pick in np.sort(rng.permutation(len(back))[:count]).tolist():
        later, near = back[pick]
        earlier = int(near[rng.integers(len(near))])
        true = space.group.between(tuple(truth[earlier].tolist()), tuple(truth[later].tolist()))
        noise = tuple((sigmas * rng.standard_normal(space.dof)).tolist())
        measured = tuple(float(number) for number in space.group.retract(true, noise))
        found.append(Closure(int(stamps_ns[later]), int(stamps_ns[earlier]), CLOSURES_TOPIC, measured, covariance))
    return replace(recording, closures=tuple(found))
