"""Parameters of the pipeline: frames, odometry, keyframes, landmarks, outliers, the map, the solver."""

import math
from dataclasses import dataclass, fields

from graph_slam_ros.config.parameter import setting
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.graph import Loss
from graph_slam_ros.solver.settings import METHODS, Settings

LOSSES = ("none", "huber", "cauchy", "geman_mcclure", "dcs", "huber_then_cauchy", "huber_then_dcs")
_LEAST_LOSS_SCALE = 0.1
_WIDE = 2.3  # times as wide in the end: 4.6 standard deviations, the gate of three numbers
_LEAST_SIGMA = 1e-6  # of an anchor: nothing is certain
_SOLVER = Settings()  # its defaults are ours, but for when the solve at the end has converged


@dataclass(frozen=True, slots=True)
class WorldConfig:
    """The world: the plane or space."""

    dimensions: int = setting(
        2, "2: the robot moves in a plane, measurements are projected onto it; 3: it moves in space", low=2, high=3
    )


@dataclass(frozen=True, slots=True)
class FramesConfig:
    """Names of frames, REP-105."""

    map: str = setting("map", "frame of the corrected path")
    odom: str = setting("odom", "frame of the odometry")
    base: str = setting("base_link", "frame of the robot")

    def __post_init__(self) -> None:
        for key, other in (("map", "odom"), ("map", "base"), ("odom", "base")):
            if getattr(self, key) == getattr(self, other):
                raise ConfigError(
                    f"frames.{key}: {getattr(self, key)!r} is frames.{other}, too: each needs a name of its own; for "
                    "messages of odometry that name another frame, set frame of their input, e.g. odom.frame=odom"
                )


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
        "random walk along y of the base; small for wheels, larger where it slides",
        "m/sqrt(s)",
        low=1e-6,
        high=10.0,
    )
    vertical_density: float = setting(
        0.005, "random walk along z of the base; used in space only", "m/sqrt(s)", low=1e-6, high=10.0
    )
    rotation_density: float = setting(0.05, "random walk of the odometry heading", "rad/sqrt(s)", low=1e-6, high=10.0)
    tilt_density: float = setting(
        0.02, "random walk of odometry roll and pitch; used in space only", "rad/sqrt(s)", low=1e-6, high=10.0
    )
    turn_per_rad: float = setting(
        0.02, "odometry.noise: motion: variance of the heading for each radian turned", "rad^2/rad", high=10.0
    )
    turn_per_m: float = setting(
        0.002, "odometry.noise: motion: variance of the heading for each metre driven", "rad^2/m", high=10.0
    )
    turn_per_s: float = setting(
        2e-4, "odometry.noise: motion: variance of the heading a second", "rad^2/s", low=1e-12, high=10.0
    )
    way_per_m: float = setting(
        2e-3, "odometry.noise: motion: variance along x a metre; other axes as the densities", "m^2/m", high=10.0
    )
    way_per_s: float = setting(
        1e-4, "odometry.noise: motion: variance of the way for each second of motion", "m^2/s", low=1e-12, high=10.0
    )
    twist_correlation_s: float = setting(
        0.25, "correlation time of velocity errors: the noise of a step is covariance * dt * max(dt, this)", "s"
    )
    still_m_s: float = setting(
        1e-3, "below this speed and still_rad_s, in a step or over a second, the robot stands: no noise is added", "m/s"
    )
    still_rad_s: float = setting(
        1e-3, "below this turn rate and still_m_s, in a step or over a second, the robot stands: no noise", "rad/s"
    )
    still_m: float = setting(
        5e-3, "position jitter of a stationary robot: smaller motion adds no noise and no keyframe", "m"
    )
    still_rad: float = setting(
        0.01, "heading jitter of a stationary robot: a smaller turn adds no noise and no keyframe", "rad", high=math.pi
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
        "odometry that is silent for this long, in stamp time, is replaced by the next of inputs.names",
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
class GyroConfig:
    """A gyro as part of odometry: an input with use: gyro."""

    density: float = setting(
        1e-3, "random walk of the heading, where messages have no covariance", "rad/sqrt(s)", low=1e-7, high=1.0
    )
    turn_per_rad: float = setting(
        5e-5, "variance of the heading for each radian turned: errors of the gyro's scale", "rad^2/rad", high=1.0
    )
    bias_sigma: float = setting(
        0.02, "standard deviation of the gyro's bias before the robot has stood", "rad/s", high=1.0
    )
    timeout_s: float = setting(
        0.1, "longest gap between its messages that is bridged; in a longer one odometry is used alone", "s", low=1e-3
    )


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
        1.0, "a keyframe is added after the robot moved for this long, however slowly", "s", low=1e-3, live=True
    )
    shared_noise: float = setting(
        0.05, "a keyframe is added at an observation to whose variance motion adds more", "part of variance", live=True
    )
    min_interval_s: float = setting(
        0.1,
        "an observation sooner than this after a keyframe adds none, unless the motion would more than double its "
        "variance; 3.5 times this for what was seen since then already, within 0.15 m and 0.15 rad",
        "s",
        live=True,
    )


@dataclass(frozen=True, slots=True)
class LandmarksConfig:
    """Landmark sightings."""

    id_from: str = setting("id", "field of a detection; none: ids are ignored", choices=("id", "class_id", "none"))
    sigma_m: float = setting(
        0.1, "position noise of an observation whose message has an all-zero (unknown) covariance", "m", low=1e-4
    )
    added_sigma_m: float = setting(
        0.05, "position noise added to every observation for what messages leave out: clocks, mounting, size", "m"
    )
    association: str = setting(
        "id",
        "data association: none: landmarks are not used; id: by identity; joint: observations without identity by "
        "several hypotheses, which later ones decide",
        choices=("none", "id", "joint"),
    )
    unnamed_sigma_m: float = setting(
        0.14, "position noise added to observations without identity: where on an object it is seen", "m"
    )
    density_per_m: float = setting(
        0.03, "landmarks expected per metre of each axis: with more, a sighting makes a new one sooner", "1/m", low=1e-4
    )
    surveyed: str = setting(
        "",
        "landmarks with known positions in the map: a header id,x,y,sigma or id,x,y,z,sigma, then a line for each;"
        " with columns for an orientation and other noise as in docs/inputs.md",
        "m, rad",
    )
    surveyed_file: str = setting("", "file with the lines of landmarks.surveyed, read at the start where that is empty")
    loss: str = setting(
        "huber_then_cauchy", "robust loss of landmark observations; A_then_B: A until it converges", choices=LOSSES
    )
    loss_scale: float = setting(
        3.0, "landmark residuals well below this keep their full weight", "sigma", low=_LEAST_LOSS_SCALE
    )


@dataclass(frozen=True, slots=True)
class AnchorConfig:
    """The prior on the first keyframe, which fixes the gauge: map begins where odom begins, or at a given pose.

    If its sigmas are 0, the first fix or surveyed landmark replaces it, and the map is moved there.
    """

    pose: str = setting(
        "", "first pose of the robot in the map: x y yaw, or x y z roll pitch yaw; empty: as odometry has it", "m, rad"
    )
    sigma_m: float = setting(
        0.0,
        "standard deviation of the first position; 0: 1 mm until a fix or surveyed landmark locates "
        "the map, then 1 km, or initialpose.sigma_m if anchor.pose is given",
        "m",
    )
    sigma_rad: float = setting(
        0.0,
        "standard deviation of the first heading; 0: 1 mrad until a fix or surveyed landmark locates "
        "the map, then 3 rad, or initialpose.sigma_rad if anchor.pose is given",
        "rad",
    )

    def __post_init__(self) -> None:
        for name, sigma in (("sigma_m", self.sigma_m), ("sigma_rad", self.sigma_rad)):
            if 0.0 < sigma < _LEAST_SIGMA:
                raise ConfigError(f"anchor.{name}: {sigma:g} is not 0 or in [{_LEAST_SIGMA:g}, 1e+09]")


@dataclass(frozen=True, slots=True)
class MapConfig:
    """Mapping, or localization in a fixed map; and a map whose size follows its area."""

    localize: bool = setting(
        False, "true: the map stays fixed and the robot is located in it; false: it grows and is corrected", live=True
    )
    condense: bool = setting(
        True,
        "true: what was driven long ago is condensed to one measurement of each place, so that memory and time follow "
        "the area and not the distance driven; false: every keyframe is kept, as it always is with closures",
    )
    window_keyframes: int = setting(
        2000,
        "with condense: so many of the newest keyframes are kept as they were measured, and can be doubted one by one",
        "keyframes",
        low=40,
        high=10_000_000,
    )
    cell_m: float = setting(20.0, "with condense: width of a place", "m", low=1.0, high=1000.0)


@dataclass(frozen=True, slots=True)
class OrderingConfig:
    """The window in which messages are put in order of stamp."""

    window_s: float = setting(
        0.05, "a message may arrive this much later than newer odometry, in stamp time, and is still sorted", "s"
    )
    late_s: float = setting(
        10.0, "observations, fixes and closures up to this much older than odometry are used at their own stamp", "s"
    )
    max_waiting: int = setting(
        1000, "most messages that are held for their turn, or for odometry", "messages", low=1, high=1_000_000
    )


@dataclass(frozen=True, slots=True)
class SolveConfig:
    """The solver: limited work at each keyframe, and everything at the end."""

    every_keyframes: int = setting(
        1, "the estimate is updated after this many keyframes", "keyframes", low=1, high=1_000_000, live=True
    )
    method: str = setting(
        _SOLVER.method,
        "method of the solve at the end: gn (Gauss-Newton, damped only where it fails to converge), "
        "lm (Levenberg-Marquardt) or dogleg",
        choices=METHODS,
        live=True,
    )
    max_iterations: int = setting(
        _SOLVER.max_iterations, "most iterations of the solve at the end, for each loss", low=1, high=10_000, live=True
    )


@dataclass(frozen=True, slots=True)
class RobustConfig:
    """Outlier rejection of closures, sightings and fixes."""

    decide: bool = setting(
        True, "true: unlikely measurements are held back and outliers removed; false: only the robust loss protects"
    )
    gate: float = setting(
        0.9999,
        "a measurement is held back if chi2 of its innovation is outside",
        "probability",
        low=0.5,
        high=1.0 - 1e-12,
    )
    noise_factor: float = setting(
        2.0, "the gate allows for noise so many times that stated, or that residuals show if less", "times", low=1.0
    )
    noise_scale: str = setting(
        "estimated",
        "noise of all inputs: estimated: as messages and parameters state it, times factors from the residuals, for "
        "each input and class of edges, from 50 keyframes on; configured: without factors",
        choices=("configured", "estimated"),
    )
    loss: str = setting(
        "dcs", "robust loss of closures and fixes; geman_mcclure and dcs give outliers no weight", choices=LOSSES[:5]
    )
    loss_scale: float = setting(
        2.0, "residuals of closures and fixes well below this keep their full weight", "sigma", low=_LEAST_LOSS_SCALE
    )
    second_look_after: int = setting(
        10,
        "a search for better hypotheses starts in the background when so many more measurements are "
        "rejected than at the last, and half as many again; 0: only at the end or on request",
        "edges",
        low=0,
        high=1_000_000,
    )
    apply_after_keyframes: int = setting(
        20,
        "the result of such a search is adopted this many keyframes after it started",
        "keyframes",
        low=1,
        high=1_000_000,
    )


def landmark_stages(name: str, scale: float) -> list[Loss]:
    """The loss of landmarks: for ``huber_then_cauchy``, Huber's loss until convergence, then Cauchy's."""
    return [Loss.named(one, scale) for one in name.split("_then_")]


def narrow_then_wide(name: str, scale: float) -> list[Loss]:
    """The loss of closures and fixes: narrow first, so that outliers do not bend the map; then wide.

    A measurement that the gate accepts then has its full weight: without outliers the optimum is that of least squares.
    """
    first, *_, last = 2 * name.split("_then_")
    return [Loss.named(first, scale), Loss.named(last, _WIDE * scale)]
