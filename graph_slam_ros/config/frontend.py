"""Parameters of the front end: odometry, keyframes, the order of messages."""

import math
from dataclasses import dataclass, fields

from graph_slam_ros.config.parameter import setting


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """Noise of the motion between keyframes."""

    noise: str = setting(
        "twist",
        "noise of odometry: twist: from each message's twist covariance; where it has none as motion, or by the "
        "densities where one of them is set; density: always the densities; motion: it grows with what was turned and "
        "driven (turn_per_rad, turn_per_m, turn_per_s, way_per_m, way_per_s)",
        choices=("twist", "density", "motion"),
    )
    translation_density: float = setting(
        0.02, "random walk of the odometry position along x of the base", "m/sqrt(s)", low=1e-6, high=10.0
    )
    lateral_density: float = setting(
        0.005,
        "random walk of the odometry position along y of the base; small for wheels, larger for "
        "robots that slide or hover",
        "m/sqrt(s)",
        low=1e-6,
        high=10.0,
    )
    vertical_density: float = setting(
        0.005,
        "random walk of the odometry position along z of the base; used in space only",
        "m/sqrt(s)",
        low=1e-6,
        high=10.0,
    )
    rotation_density: float = setting(0.05, "random walk of the odometry heading", "rad/sqrt(s)", low=1e-6, high=10.0)
    tilt_density: float = setting(
        0.02, "random walk of odometry roll and pitch; used in space only", "rad/sqrt(s)", low=1e-6, high=10.0
    )
    turn_per_rad: float = setting(
        0.02, "odometry.noise: motion: variance of the heading for each radian turned", "rad^2/rad", low=0.0, high=10.0
    )
    turn_per_m: float = setting(
        0.002, "odometry.noise: motion: variance of the heading for each metre driven", "rad^2/m", low=0.0, high=10.0
    )
    turn_per_s: float = setting(
        2e-4,
        "odometry.noise: motion: variance of the heading for each second of motion",
        "rad^2/s",
        low=1e-12,
        high=10.0,
    )
    way_per_m: float = setting(
        2e-3,
        "odometry.noise: motion: variance of the position along x for each metre driven; other axes are to it as the "
        "densities are",
        "m^2/m",
        low=0.0,
        high=10.0,
    )
    way_per_s: float = setting(
        1e-4, "odometry.noise: motion: variance of the way for each second of motion", "m^2/s", low=1e-12, high=10.0
    )
    twist_correlation_s: float = setting(
        0.25,
        "correlation time of velocity errors: the noise of a step is covariance * dt * max(dt, this)",
        "s",
        low=0.0,
    )
    still_m_s: float = setting(
        1e-3,
        "below this speed and odometry.still_rad_s, in a step or over a second, the robot counts as "
        "stationary: no noise is added",
        "m/s",
        low=0.0,
    )
    still_rad_s: float = setting(
        1e-3,
        "below this turn rate and odometry.still_m_s, in a step or over a second, the robot counts as"
        " stationary: no noise is added",
        "rad/s",
        low=0.0,
    )
    still_m: float = setting(
        5e-3, "position jitter of a stationary robot: smaller motion adds no noise and no keyframe", "m", low=0.0
    )
    still_rad: float = setting(
        0.01,
        "heading jitter of a stationary robot: a smaller turn adds no noise and no keyframe",
        "rad",
        low=0.0,
        high=math.pi,
    )
    distance_factor: float = setting(
        1.0, "factor by which the motion of odometry is multiplied", "times", low=0.01, high=100.0
    )
    turn_factor: float = setting(
        1.0, "factor by which the turns of odometry are multiplied", "times", low=0.01, high=100.0
    )
    turn_bias_rad_s: float = setting(
        0.0, "turn rate added to odometry while the robot moves", "rad/s", low=-10.0, high=10.0
    )
    timeout_s: float = setting(
        0.5,
        "an odometry input without messages for this long, in stamp time, is replaced by the next of inputs.names",
        "s",
        low=1e-3,
    )
    max_speed_m_s: float = setting(
        50.0, "odometry that moves faster than this has jumped: a new segment of the path begins", "m/s", low=1e-3
    )
    doubt: bool = setting(
        True, "true: where several landmarks contradict odometry over some seconds, it counts for less while it slips"
    )

    @property
    def slides(self) -> tuple[float, float]:
        """The noise sideways and upwards, relative to that ahead."""
        return self.lateral_density / self.translation_density, self.vertical_density / self.translation_density

    @property
    def has_densities(self) -> bool:
        """Return whether a density differs from its default."""
        return any(getattr(self, one.name) != one.default for one in fields(self) if one.name.endswith("_density"))


@dataclass(frozen=True, slots=True)
class KeyframesConfig:
    """The choice of keyframes."""

    min_distance_m: float = setting(
        0.25, "a keyframe is added after the robot moved this far", "m", low=1e-3, live=True
    )
    min_angle_rad: float = setting(
        0.25, "a keyframe is added after the robot turned by this much", "rad", low=1e-3, high=math.pi, live=True
    )
    max_interval_s: float = setting(
        1.0,
        "a keyframe is added after the robot moved for this long, however slowly",
        "s",
        low=1e-3,
        live=True,
    )
    shared_noise: float = setting(
        0.05,
        "a keyframe is added at an observation if the motion since the last keyframe would add more "
        "than this part to its variance",
        "part of variance",
        low=0.0,
        live=True,
    )
    min_interval_s: float = setting(
        0.1,
        "an observation sooner than this after a keyframe adds none, unless the motion would more "
        "than double its variance; 3.5 times this for what was seen since then already, within 0.15 m and 0.15 rad",
        "s",
        low=0.0,
        live=True,
    )


@dataclass(frozen=True, slots=True)
class OrderingConfig:
    """The window in which messages are put in order of stamp."""

    window_s: float = setting(
        0.05,
        "a message may arrive this much later than newer odometry, in stamp time, and is still sorted by stamp",
        "s",
        low=0.0,
    )
    late_s: float = setting(
        10.0,
        "observations, fixes and closures up to this much older than odometry are used at their own stamp",
        "s",
        low=0.0,
    )
    max_waiting: int = setting(
        1000,
        "most messages that are held until it is their turn, or until odometry reaches them",
        "messages",
        low=1,
        high=1_000_000,
    )
