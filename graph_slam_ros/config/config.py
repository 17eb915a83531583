"""The one tree of parameters: every default (but the solver's own), unit, meaning and bound is here and nowhere else.

YAML files, command-line settings and ROS parameters are all read through ``Config.from_mapping``; unknown names, wrong
types and values out of range are refused with the name of the culprit.
"""

import dataclasses
import difflib
import inspect
import itertools
import math
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from graph_slam_ros.config.inputs import DEFAULT_INPUTS, InputConfig, default_input
from graph_slam_ros.config.node import (
    USUAL_INPUTS,
    HealthConfig,
    InitialPoseConfig,
    InputsConfig,
    JournalConfig,
    NodeConfig,
    OutputConfig,
    TfConfig,
    TimeConfig,
)
from graph_slam_ros.config.parameter import Parameter, numbers, section_parameters, setting
from graph_slam_ros.config.robust import LOSSES, RobustConfig
from graph_slam_ros.config.survey import Surveyed, surveyed
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.graph import Loss
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.lie import se3
from graph_slam_ros.solver import METHODS, Settings
from graph_slam_ros.typing import Numbers

_LEAST_SIGMA = 1e-6  # of an anchor: nothing is certain


@dataclass(frozen=True, slots=True)
class FramesConfig:
    """Names of frames, REP-105."""

    map: str = setting("map", "frame of the corrected path")
    odom: str = setting("odom", "frame of the odometry")
    base: str = setting("base_link", "frame of the robot")


@dataclass(frozen=True, slots=True)
class WorldConfig:
    """The world: a plane or space."""

    dimensions: int = setting(
        2, "2: the robot moves in a plane, measurements are projected onto it; 3: it moves in space", low=2, high=3
    )


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """Noise of the motion between keyframes."""

    noise: str = setting(
        "twist",
        "noise of odometry: twist: from each message's twist covariance, or the densities where it "
        "has none; density: always the densities",
        choices=("twist", "density"),
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
    timeout_s: float = setting(
        0.5,
        "an odometry input without messages for this long, in stamp time, is replaced by the next of inputs.names",
        "s",
        low=1e-3,
    )
    max_speed_m_s: float = setting(
        50.0, "odometry that moves faster than this has jumped: a new segment of the path begins", "m/s", low=1e-3
    )
    jump_sigma_m: float = setting(
        10.0, "standard deviation of the position change across a jump of odometry", "m", low=1e-3
    )
    jump_sigma_rad: float = setting(
        3.0, "standard deviation of the rotation across a jump of odometry", "rad", low=1e-3
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
        "than double its variance",
        "s",
        low=0.0,
        live=True,
    )


@dataclass(frozen=True, slots=True)
class LandmarksConfig:
    """Landmark sightings."""

    id_from: str = setting("id", "field of a detection that is the landmark's identity", choices=("id", "class_id"))
    sigma_m: float = setting(
        0.1, "position noise of an observation whose message has an all-zero (unknown) covariance", "m", low=1e-4
    )
    added_sigma_m: float = setting(
        0.05,
        "position noise added to every observation for errors that messages leave out: clocks, mounting, size",
        "m",
        low=0.0,
    )
    max_per_message: int = setting(
        1000, "most landmarks used of one message; the nearest are used, the others counted", "landmarks", low=1
    )
    orientation_known_below_rad: float = setting(
        0.5, "a landmark is a full pose if the standard deviation of its heading is below this", "rad", low=0.0
    )
    association: str = setting(
        "id",
        "data association: none: landmarks are not used; id: by identity; nearest: observations "
        "without identity one by one; joint: all of a message together",
        choices=("none", "id", "nearest", "joint"),
    )
    gate_same: float = setting(
        0.999,
        "an observation without identity may belong to a landmark within this probability of the chi2 test",
        "probability",
        low=0.5,
        high=1.0,
    )
    gate_other: float = setting(
        0.99999,
        "an observation outside this probability of every landmark begins a new one; between "
        "gate_same and this it is discarded",
        "probability",
        low=0.5,
        high=1.0,
    )
    close_m: float = setting(
        0.5,
        "landmarks closer together than this are not told apart: an observation that may be of either gets more noise",
        "m",
        low=0.0,
    )
    unnamed_sigma_m: float = setting(
        0.1, "position noise added to observations without identity: they may be of a neighbouring object", "m", low=0.0
    )
    density_per_m: float = setting(
        0.03,
        "prior density of landmarks per metre along each axis: an observation must fit a known "
        "landmark better than a new one",
        "1/m",
        low=1e-4,
    )
    ambiguity_chi2: float = setting(
        6.0, "an association is used only if every alternative fits worse by this much", "chi2", low=0.0
    )
    confirm_sightings: int = setting(5, "observations that confirm a new landmark without identity", "sightings", low=1)
    confirm_s: float = setting(
        2.0, "time over which a new landmark without identity must be observed before it is confirmed", "s", low=0.0
    )
    follow_s: float = setting(
        10.0,
        "an observation is compared with landmarks observed within this time; older ones are matched later, by merging",
        "s",
        low=0.0,
    )
    give_up_s: float = setting(
        60.0, "a landmark that is not confirmed is removed when it was not observed for this long", "s", low=0.0
    )
    review_every_keyframes: int = setting(
        10,
        "landmarks without identity are merged, split, confirmed and removed after every so many keyframes",
        "keyframes",
        low=1,
    )
    determined_below: float = setting(
        0.2,
        "a landmark from ranges or bearings enters the map when its standard deviation is below this "
        "part of its distance",
        "m/m",
        low=1e-3,
        high=10.0,
    )
    mirror_chi2: float = setting(
        12.0,
        "a landmark from ranges or bearings enters the map when every other position, e.g. the mirror"
        " image, fits worse by this much",
        "chi2",
        low=0.0,
    )
    surveyed: str = setting(
        "",
        "landmarks with known positions in the map: a header id,x,y,sigma or id,x,y,z,sigma, then a line for each",
        "m",
    )
    surveyed_file: str = setting("", "file with the lines of landmarks.surveyed, read at the start where that is empty")
    range_offset_sigma_m: float = setting(
        0.0,
        "standard deviation of an offset that all ranges of a topic share and that is estimated; 0: no offset",
        "m",
        low=0.0,
    )
    loss: str = setting(
        "huber_then_cauchy",
        "robust loss of landmark observations; huber_then_cauchy converges with Huber first, then with Cauchy",
        choices=(*LOSSES, "huber_then_cauchy", "huber_then_dcs"),
    )
    loss_scale: float = setting(
        3.0, "landmark residuals well below this many standard deviations keep their full weight", "sigma", low=0.1
    )


@dataclass(frozen=True, slots=True)
class AnchorConfig:
    """The prior on the first keyframe, which fixes the gauge: map begins where odom begins, or where it is said to.

    While its sigmas are 0, it gives way to the first fix or surveyed landmark: the map is laid onto that.
    """

    pose: str = setting(
        "",
        "first pose of the robot in the map: x y yaw, or in space x y z roll pitch yaw; empty: as odometry has it",
        "m, rad",
    )
    sigma_m: float = setting(
        0.0,
        "standard deviation of the first position; 0: 1 mm until a fix or surveyed landmark locates "
        "the map, then 1 km, or initialpose.sigma_m if anchor.pose is given",
        "m",
        low=0.0,
    )
    sigma_rad: float = setting(
        0.0,
        "standard deviation of the first heading; 0: 1 mrad until a fix or surveyed landmark locates "
        "the map, then 3 rad, or initialpose.sigma_rad if anchor.pose is given",
        "rad",
        low=0.0,
    )

    def __post_init__(self) -> None:
        for name, sigma in (("sigma_m", self.sigma_m), ("sigma_rad", self.sigma_rad)):
            if 0.0 < sigma < _LEAST_SIGMA:
                raise ConfigError(f"anchor.{name}: {sigma:g} is not 0 or in [{_LEAST_SIGMA:g}, 1e+09]")


@dataclass(frozen=True, slots=True)
class MapConfig:
    """Mapping, or localization in a map that is held."""

    localize: bool = setting(
        False,
        "true: the map stays fixed and the robot is located in it; false: the map grows and is corrected",
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


_SOLVER = Settings()  # its defaults are ours, but for when the solve at the end has converged


@dataclass(frozen=True, slots=True)
class SolveConfig:
    """The solver: a little at each keyframe, and everything at the end."""

    every_keyframes: int = setting(
        1, "the estimate is updated after this many keyframes", "keyframes", low=1, high=1_000_000, live=True
    )
    relinearize_above: float = setting(
        _SOLVER.relinearize_above,
        "a pose or landmark is linearised again when it has moved by more than this since",
        "m, rad",
        low=0.0,
        live=True,
    )
    relinearize_error: float = setting(
        _SOLVER.relinearize_error,
        "a pose or landmark is linearised again when its squared motion exceeds this part of the "
        "standard deviation of its strongest measurement",
        "sigma",
        low=0.0,
        live=True,
    )
    relinearize_every: int = setting(
        _SOLVER.relinearize_every,
        "relinearisation is checked at every so many updates (at each update for ten times the threshold)",
        "updates",
        low=1,
        high=1_000_000,
        live=True,
    )
    tolerance: float = setting(
        _SOLVER.tolerance,
        "changes of a pose or landmark up to this are not propagated through the graph",
        "m, rad",
        low=0.0,
        live=True,
    )
    tolerance_sigmas: float = setting(
        _SOLVER.tolerance_sigmas,
        "changes up to so many standard deviations of a pose or landmark given its neighbours are not propagated",
        "sigma",
        low=0.0,
        live=True,
    )
    method: str = setting(
        _SOLVER.method,
        "method of the solve at the end: gn (Gauss-Newton, damped only where it fails to converge), "
        "lm (Levenberg-Marquardt) or dogleg",
        choices=METHODS,
        live=True,
    )
    max_iterations: int = setting(
        _SOLVER.max_iterations,
        "most iterations of the solve at the end, for each stage of the losses",
        "",
        low=1,
        high=10_000,
        live=True,
    )
    step_tolerance: float = setting(
        1e-5, "the solve at the end has converged when no step is larger than this", "m, rad", low=0.0, live=True
    )
    cost_tolerance: float = setting(
        1e-9,
        "the solve at the end has converged when the cost changes by a smaller fraction than this",
        "",
        low=0.0,
        live=True,
    )


@dataclass(frozen=True, slots=True)
class Config:
    """All parameters, in sections. An object never changes; ``changed`` makes another.

    ``Config()`` has the defaults. ``Config.from_mapping({"keyframes.min_distance_m": 0.5})`` takes nested or dotted
    names; ``config.keyframes.min_distance_m`` reads one. An input has a section of its own name, see ``inputs.names``.
    """

    world: WorldConfig = WorldConfig()
    frames: FramesConfig = FramesConfig()
    odometry: OdometryConfig = OdometryConfig()
    keyframes: KeyframesConfig = KeyframesConfig()
    landmarks: LandmarksConfig = LandmarksConfig()
    anchor: AnchorConfig = AnchorConfig()
    map: MapConfig = MapConfig()
    ordering: OrderingConfig = OrderingConfig()
    solve: SolveConfig = SolveConfig()
    robust: RobustConfig = RobustConfig()
    initialpose: InitialPoseConfig = InitialPoseConfig()
    tf: TfConfig = TfConfig()
    inputs: InputsConfig = InputsConfig()
    output: OutputConfig = OutputConfig()
    journal: JournalConfig = JournalConfig()
    time: TimeConfig = TimeConfig()
    health: HealthConfig = HealthConfig()
    node: NodeConfig = NodeConfig()
    sources: tuple[InputConfig, ...] = DEFAULT_INPUTS

    def __repr__(self) -> str:
        """The parameters that are not at their default, as ``from_mapping`` takes them."""
        given = dict(flatten(self.as_mapping()))
        usual = {p.name: p.default for p in parameters(one.name for one in self.sources)}
        changed = [f"{name}={value!r}" for name, value in given.items() if value != usual[name]]
        return f"Config({', '.join(changed)})"

    def __post_init__(self) -> None:
        _ = self.start_pose, self.load_pose, self.survey  # what they are made of is refused here, not later

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> "Config":
        """Read nested or dotted names and their values; what is not named keeps its default.

        Raises
        ------
        ConfigError
            Unknown name (the nearest known one is suggested), wrong type, or a value out of range.
        """
        given = dict(flatten(values))
        names = _input_names(given.get("inputs.names", InputsConfig().names))
        known = {p.name: p for p in parameters(names)}
        sections: dict[str, dict[str, Any]] = {}
        for name, value in given.items():
            if name not in known:
                near = difflib.get_close_matches(name, known, 1, 0.0)
                raise ConfigError(f"unknown parameter {name!r}; did you mean {near[0]!r}?{_unlisted(name, names)}")
            section, key = name.split(".")
            sections.setdefault(section, {})[key] = known[name].check(value)
        trees = {name: type(default)(**sections.get(name, {})) for name, default in _sections()}
        inputs = (dataclasses.replace(default_input(name), **sections.get(name, {})) for name in names)
        return cls(**trees, sources=tuple(inputs))

    def changed(self, values: Mapping[str, Any]) -> "Config":
        """The configuration with other values of some parameters, by dotted name; all of them or none.

        Raises
        ------
        ConfigError
            As for ``from_mapping``.
        """
        return Config.from_mapping(dict(flatten(self.as_mapping())) | dict(values))

    def as_mapping(self) -> dict[str, dict[str, Any]]:
        """Nested plain values, every parameter named."""
        out = dataclasses.asdict(self)
        for section in out.pop("sources"):
            out[section.pop("name")] = section
        return out

    @property
    def space(self) -> Geometry:
        """The plane or space."""
        return PLANAR if self.world.dimensions == 2 else SPATIAL

    @property
    def start_pose(self) -> Numbers | None:
        """``T_map_base`` of the first keyframe; None where odometry says it."""
        return self._pose("anchor.pose", self.anchor.pose)

    @property
    def load_pose(self) -> Numbers | None:
        """``T_map_base`` of the robot when a map is loaded; None where it is unknown."""
        return self._pose("output.load_pose", self.output.load_pose)

    def _pose(self, name: str, text: str) -> Numbers | None:
        counts = (3,) if self.world.dimensions == 2 else (3, 6)
        given = numbers(name, text, *counts)
        if not given or self.world.dimensions == 2:
            return given or None
        return se3.from_xyz_rpy(given if len(given) == 6 else (*given[:2], 0.0, 0.0, 0.0, given[2]))

    @property
    def survey(self) -> dict[str, Surveyed]:
        """Landmarks whose place is known, by identity."""
        try:
            return surveyed(self.landmarks.surveyed, self.world.dimensions)
        except ConfigError as error:
            raise ConfigError(f"landmarks.surveyed: {error}") from None

    def solver_settings(self) -> Settings:
        """The settings of the solver, online and at the end."""
        scale = self.landmarks.loss_scale
        stages = [Loss.named(name, scale) for name in self.landmarks.loss.split("_then_")]
        s = self.solve
        return Settings(
            s.method,
            s.max_iterations,
            s.step_tolerance,
            s.cost_tolerance,
            {"landmarks": stages, **dict.fromkeys(("fixes", "closures", "initialpose"), self.robust.stages)},
            relinearize_above=s.relinearize_above,
            relinearize_error=s.relinearize_error,
            relinearize_every=s.relinearize_every,
            tolerance=s.tolerance,
            tolerance_sigmas=s.tolerance_sigmas,
        )


def _sections() -> Iterator[tuple[str, Any]]:
    """Name and defaults of each section but those of inputs."""
    for section in dataclasses.fields(Config):
        if section.name != "sources":
            yield section.name, section.default


def _input_names(text: Any) -> list[str]:
    """Names that are separated by spaces. Raises ConfigError for what cannot be the name of a section of its own."""
    if not isinstance(text, str):
        raise ConfigError(f"inputs.names: {text!r} is not a text of names")
    names, used = text.split(), {name for name, _ in _sections()} | {"tf_static"}
    for name in names:
        if not re.fullmatch(r"[a-zA-Z]\w*", name, re.ASCII):
            raise ConfigError(f"inputs.names: {name!r} is not a name (letters, digits, _)")
        if name in used:
            raise ConfigError(f"inputs.names: {name!r} is reserved or given twice")
        used.add(name)
    return names


def _unlisted(name: str, names: list[str]) -> str:
    """A hint where a parameter looks like one of an input."""
    section, _, key = name.partition(".")
    if section in names or section in dict(_sections()) or key not in InputConfig.__slots__:
        return ""
    return f" {section!r} is not in inputs.names ({' '.join(names)})"


def parameters(names: Iterable[str] = USUAL_INPUTS) -> Iterator[Parameter]:
    """Every parameter, in the order of the tree, named ``section.key``, with a section for each named input."""
    for name, defaults in _sections():
        yield from section_parameters(name, defaults)
    for name in names:
        yield from section_parameters(name, default_input(name))


def notes() -> dict[str, str]:
    """Meaning, unit and choices of every parameter by name, as a parameter file says them."""
    out = {}
    for p in parameters():
        unit = f" [{p.unit}]" if p.unit else ""
        choices = f"; one of {', '.join(p.choices)}" if p.choices else ""
        out[p.name] = p.meaning + unit + choices
    return out


def flatten(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of nested mappings."""
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from flatten(value, f"{name}.")
        else:
            yield name, value


def _described() -> str:
    """The docstring of ``Config`` with every parameter by section: name, default, unit and meaning, folded."""
    meanings = notes()
    sections = dict(_sections()) | {name: default_input(name) for name in USUAL_INPUTS}
    lines = ["    Parameters with their defaults:"]
    for section, own in itertools.groupby(parameters(), lambda p: p.name.partition(".")[0]):
        meaning, _, _ = (inspect.getdoc(sections[section]) or "").partition("\n")
        lines += ["", f"    {section}: {meaning}", ""]
        for p in own:
            lines.append(f"      {p.name} = {p.default!r}")
            lines += textwrap.wrap(meanings[p.name], 100, initial_indent=" " * 10, subsequent_indent=" " * 10)
    return f"{Config.__doc__}\n" + "\n".join(lines) + "\n"


Config.__doc__ = _described()
_sections_by_name = inspect.Parameter("sections", inspect.Parameter.VAR_KEYWORD)  # with all defaults it is a screenful
Config.__signature__ = inspect.Signature([_sections_by_name])  # type: ignore[attr-defined]
Config.__init__.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
    [inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY), _sections_by_name]
)
