"""``Config``, the one tree of parameters: defaults (but the solver's own), units, meanings, bounds are in this folder.

YAML files, command-line settings and ROS parameters are all read through ``Config.from_mapping``; unknown names, wrong
types and values out of range are refused with the name of the culprit.
"""

import dataclasses
import inspect
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graph_slam_ros.config import node as outside
from graph_slam_ros.config import pipeline
from graph_slam_ros.config.inputs import DEFAULT_INPUTS, InputConfig, default_input
from graph_slam_ros.config.node import USUAL_INPUTS, InputsConfig
from graph_slam_ros.config.parameter import Parameter, numbers, section_parameters
from graph_slam_ros.config.pipeline import landmark_stages, narrow_then_wide
from graph_slam_ros.config.survey import Surveyed, surveyed
from graph_slam_ros.errors import ConfigError, nearest
from graph_slam_ros.formats.strict import lines
from graph_slam_ros.graph import Loss
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.lie import se3
from graph_slam_ros.solver.settings import LossKey, Settings
from graph_slam_ros.typing import Numbers

_STEP_TOLERANCE = 1e-5  # [m, rad]: the solve at the end has converged, far below what any sensor resolves
_COST_TOLERANCE = 1e-9  # and so it has when the cost changes by a smaller part than this
_ONE_ODOMETRY = "the first of inputs.names that publishes is used; a filter, e.g. robot_localization, fuses several"
_CALIBRATE = ("groups", "factor_sigma", "clock_sigma_s", "yaw_sigma_rad", "mount_sigma_m", "range_offset_sigma_m")
REMOVED = {
    "landmarks.follow_s": "observations without identity are compared with all landmarks around",
    "landmarks.size_sigma_m": "sizes are not compared; give things of other sizes another class",
    "landmarks.range_offset_sigma_m": "graph_slam calibrate finds INPUT.range_offset_m",
    "landmarks.retire": "remove what is gone: ~/remove, or graph_slam map edit RUN with remove_landmark",
    "gyro.gate": "the gyro's turn replaces that of odometry",
    **{
        f"calibrate.{name}": "graph_slam calibrate BAG prints the settings that correct clocks, mounts and scales"
        for name in (*_CALIBRATE, "range_factor_sigma", "turn_bias_sigma", "drift")
    },
    "odometry.fusion": _ONE_ODOMETRY,
    "robust.odometry_gate": _ONE_ODOMETRY,
    **dict.fromkeys(
        ("initialpose.use", "initialpose.loosen_m", "initialpose.loosen_rad"), "a given pose begins a new segment"
    ),
    "INPUT.depth": "inputs.depth is that of all inputs",
    "INPUT.loss_scale": "landmarks.loss_scale and robust.loss_scale are those of all inputs",
    "health.memory_mib": "map.condense bounds the map; a limit of the process is the system's (systemd: MemoryMax)",
    "tf.second_authority": "another broadcaster of map -> odom is reported; tf.publish_tf=false stops this one",
    **dict.fromkeys(
        (
            *("odometry.doubt_m_s", "odometry.doubt_rad_s", "odometry.jump_sigma_m", "odometry.jump_sigma_rad"),
            *("landmarks.close_m", "landmarks.ambiguity_chi2", "landmarks.orientation_known_below_rad"),
            *("landmarks.max_per_message", "landmarks.determined_below", "landmarks.mirror_chi2"),
            *("landmarks.confirm_sightings", "landmarks.confirm_s"),
            *("landmarks.review_every_keyframes", "robust.out_below", "robust.retests"),
            *("solve.relinearize_above", "solve.relinearize_error", "solve.relinearize_every", "solve.tolerance"),
            *("solve.tolerance_sigmas", "solve.step_tolerance", "solve.cost_tolerance"),
            *("inputs.tf_buffer_s", "output.path_moved_m", "output.path_moved_rad", "output.graph_period_s"),
            *("output.landmarks_every_keyframes", "output.graph_max_edges", "output.pose_covariance_max"),
            *("odometry.doubt_odds", "gyro.bias_walk", "gyro.bias_correlation_s", "landmarks.give_up_s"),
            *("landmarks.gate_same", "landmarks.gate_other", "robust.rounds", "robust.review_every_keyframes"),
            *("tf.report_jump_rad", "time.jump_back_s", "journal.sync_s"),
        ),
        "its default is used always",
    ),
}
"""Parameters of earlier versions. Saved runs have them."""
REMOVED_VALUES = {
    ("INPUT.use", "edges"): (
        "none",
        "the pipeline has no edges of plugins; one's own edge type stays in the library and in g2o files, and a "
        "converter of one's own yields landmarks, fixes, closures or odometry",
    ),
    ("landmarks.association", "nearest"): ("joint", "joint keeps several hypotheses, and is better and as fast"),
}
"""Values of earlier versions: what saved runs have instead, and what a person is told."""


@dataclass(frozen=True, slots=True)
class Config:
    """All parameters, in sections. An object never changes; ``changed`` makes another.

    ``Config()`` has the defaults. ``Config.from_mapping({"keyframes.min_distance_m": 0.5})`` takes nested or dotted
    names; ``config.keyframes.min_distance_m`` reads one. An input has a section of its own name, see ``inputs.names``.
    ``graph_slam params`` lists all with default, unit and meaning.
    """

    world: pipeline.WorldConfig = pipeline.WorldConfig()
    frames: pipeline.FramesConfig = pipeline.FramesConfig()
    odometry: pipeline.OdometryConfig = pipeline.OdometryConfig()
    gyro: pipeline.GyroConfig = pipeline.GyroConfig()
    keyframes: pipeline.KeyframesConfig = pipeline.KeyframesConfig()
    landmarks: pipeline.LandmarksConfig = pipeline.LandmarksConfig()
    anchor: pipeline.AnchorConfig = pipeline.AnchorConfig()
    map: pipeline.MapConfig = pipeline.MapConfig()
    ordering: pipeline.OrderingConfig = pipeline.OrderingConfig()
    solve: pipeline.SolveConfig = pipeline.SolveConfig()
    robust: pipeline.RobustConfig = pipeline.RobustConfig()
    initialpose: outside.InitialPoseConfig = outside.InitialPoseConfig()
    tf: outside.TfConfig = outside.TfConfig()
    inputs: outside.InputsConfig = outside.InputsConfig()
    output: outside.OutputConfig = outside.OutputConfig()
    journal: outside.JournalConfig = outside.JournalConfig()
    time: outside.TimeConfig = outside.TimeConfig()
    health: outside.HealthConfig = outside.HealthConfig()
    node: outside.NodeConfig = outside.NodeConfig()
    sources: tuple[InputConfig, ...] = DEFAULT_INPUTS

    def __repr__(self) -> str:
        """The parameters that differ from their defaults."""
        return f"Config({', '.join(f'{name}={value!r}' for name, value in self.differing.items())})"

    def __post_init__(self) -> None:
        _ = self.start_pose, self.load_pose, self.survey, self.gyro_input  # a wrong one is refused here, not later

    @property
    def differing(self) -> dict[str, Any]:
        """The parameters that differ from their defaults, as ``from_mapping`` takes them."""
        usual = {p.name: p.default for p in parameters(one.name for one in self.sources)}
        return {name: value for name, value in flatten(self.as_mapping()) if value != usual[name]}

    @property
    def condenses(self) -> bool:
        """Return whether old visits are condensed, where that is wanted, and nothing forbids it."""
        return self.map.condense and not self.not_condensed

    @property
    def not_condensed(self) -> str:
        """Return the parameter with which nothing is condensed yet; empty if there is none."""
        for one in self.sources:  # they may begin at any keyframe
            if one.use == "closure":
                return f"{one.name}.use=closure"
        return ""

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> "Config":
        """Read nested or dotted names and their values. A parameter that is not named keeps its default.

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
            if why := REMOVED.get(_general(name, names)):
                raise ConfigError(f"parameter {name!r} was removed: {why}; leave it out")
            if name not in known:
                near = nearest(name, known)
                raise ConfigError(f"unknown parameter {name!r}; did you mean {near!r}?{_unlisted(name, names)}")
            section, key = name.split(".")
            if removed := REMOVED_VALUES.get((_general(name, names), str(value))):
                raise ConfigError(f"{name}={value} was removed: {removed[1]}")
            sections.setdefault(section, {})[key] = known[name].check(value)
        trees = {name: type(default)(**sections.get(name, {})) for name, default in _sections()}
        inputs = (dataclasses.replace(default_input(name), **sections.get(name, {})) for name in names)
        return cls(**trees, sources=tuple(inputs))

    @classmethod
    def of_saved_run(cls, values: Mapping[str, Any]) -> "Config":
        """Return the configuration of a saved run, without parameters that are gone. Raises as ``from_mapping``."""
        given = dict(flatten(values))
        names = _input_names(given.get("inputs.names", InputsConfig().names))
        general = {name: _general(name, names) for name in given}
        kept = {name: value for name, value in given.items() if general[name] not in REMOVED}
        instead = {name: REMOVED_VALUES.get((general[name], str(value)), (value,)) for name, value in kept.items()}
        return cls.from_mapping({name: value[0] for name, value in instead.items()})

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
        """``T_map_base`` of the first keyframe; None if odometry determines it."""
        return self._pose("anchor.pose", self.anchor.pose)

    @property
    def load_pose(self) -> Numbers | None:
        """``T_map_base`` of the robot when a map is loaded; None if it is unknown."""
        return self._pose("output.load_pose", self.output.load_pose)

    @property
    def gyro_input(self) -> str:
        """The name of the input that is used as gyro; empty where there is none."""
        names = [one.name for one in self.sources if one.use == "gyro"]
        if len(names) > 1:
            raise ConfigError(f"{names[1]}.use: {names[0]} is the gyro already: one input can be, the other use: none")
        return names[0] if names else ""

    def _pose(self, name: str, text: str) -> Numbers | None:
        counts = (3,) if self.world.dimensions == 2 else (3, 6)
        given = numbers(name, text, *counts)
        if not given or self.world.dimensions == 2:
            return given or None
        return se3.from_xyz_rpy(given if len(given) == 6 else (*given[:2], 0.0, 0.0, 0.0, given[2]))

    @property
    def survey(self) -> dict[str, Surveyed]:
        """Surveyed landmarks by id."""
        try:
            return surveyed(self.landmarks.surveyed, self.world.dimensions)
        except ConfigError as error:
            raise ConfigError(f"landmarks.surveyed: {error}") from None

    def _losses(self) -> dict[LossKey, Sequence[Loss]]:
        """The stages of the loss of each class of edges, and of each class and input with its own loss."""
        landmarks, robust = self.landmarks, self.robust
        others = narrow_then_wide(robust.loss, robust.loss_scale)
        out: dict[LossKey, Sequence[Loss]] = {"landmarks": landmark_stages(landmarks.loss, landmarks.loss_scale)}
        out |= dict.fromkeys(("fixes", "closures", "initialpose"), others)
        for one in self.sources:
            if one.loss != "auto":
                out["landmarks", one.name] = landmark_stages(one.loss, landmarks.loss_scale)
                stages = narrow_then_wide(one.loss, robust.loss_scale)
                out |= {(label, one.name): stages for label in ("fixes", "closures")}
        return out

    def solver_settings(self) -> Settings:
        """The settings of the solver, online and at the end."""
        return Settings(
            *(self.solve.method, self.solve.max_iterations, _STEP_TOLERANCE, _COST_TOLERANCE, self._losses()),
            relinearize_neglected=math.inf,  # contradictions would drive it away (docs/solver.md)
            relinearize_passes=5,  # with 1, two of nine simulated slips end a third farther off
            at_once=True,  # a replay need not read what the node reads, and when
        )


def with_survey(config: Config) -> Config:
    """The configuration with the rows of ``landmarks.surveyed_file``, if it has none. Raises GraphSlamError."""
    settings = config.landmarks
    if not settings.surveyed_file or settings.surveyed:
        return config
    file = Path(settings.surveyed_file).expanduser()
    text = "".join(line for _, line in lines(file))
    try:
        if not surveyed(text, config.world.dimensions):
            raise ConfigError("no landmark in it")
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from None
    return config.changed({"landmarks.surveyed": text})


def _sections() -> Iterator[tuple[str, Any]]:
    for section in dataclasses.fields(Config):
        if section.name != "sources":
            yield section.name, section.default


def _input_names(text: Any) -> list[str]:
    """Names that are separated by spaces. Raises ConfigError for what cannot be the name of a section of its own."""
    if not isinstance(text, str):
        example = " ".join(map(str, text)) if isinstance(text, list | tuple) and text else "odom landmarks"
        raise ConfigError(f"inputs.names: {text!r} is not one text; write the names with spaces: names: {example}")
    names, used = text.split(), {name for name, _ in _sections()} | {"tf_static"}
    for name in names:
        if not re.fullmatch(r"[a-zA-Z]\w*", name, re.ASCII):
            raise ConfigError(f"inputs.names: {name!r} is not a name (letters, digits, _); separate names by spaces")
        if name in used:
            raise ConfigError(f"inputs.names: {name!r} is reserved or given twice")
        used.add(name)
    return names


def _general(name: str, inputs: Iterable[str]) -> str:
    """The name of a parameter in the tables of what was removed: ``INPUT`` stands for the section of any input."""
    section, _, key = name.partition(".")
    return f"INPUT.{key}" if section in inputs else name


def _unlisted(name: str, names: list[str]) -> str:
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
    """Meaning, unit and choices of every parameter by name, as in a parameter file."""
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


_SHORT = inspect.Signature([inspect.Parameter("sections", inspect.Parameter.VAR_KEYWORD)])  # all defaults fill a screen
Config.__signature__ = Config.__init__.__signature__ = _SHORT  # type: ignore[attr-defined]
