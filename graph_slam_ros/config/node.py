"""Parameters of the node outside the pipeline: transforms, topics, files, time, health."""

import re
from dataclasses import dataclass

from graph_slam_ros.config.inputs import DEFAULT_INPUTS
from graph_slam_ros.config.parameter import setting
from graph_slam_ros.errors import ConfigError

USUAL_INPUTS = tuple(one.name for one in DEFAULT_INPUTS)
_FILE_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,99}")


def check_run_name(what: str, name: str) -> None:
    """Refuse a value that is neither empty nor the plain name of a run folder, above all a path.

    Raises
    ------
    ConfigError
        It begins with ``what``.
    """
    if name and not _FILE_NAME.fullmatch(name):
        raise ConfigError(f"{what}: {name!r} is not the name of a run (letters, digits, . _ -)")


@dataclass(frozen=True, slots=True)
class NodeConfig:
    """The node as a process."""

    autostart: bool = setting(True, "true: the node configures and activates itself; false: a lifecycle manager does")


@dataclass(frozen=True, slots=True)
class TfConfig:
    """The transform map -> odom."""

    publish_tf: bool = setting(True, "whether map -> odom is broadcast", live=True)
    transform_publish_period: float = setting(
        0.05, "period of the broadcast of map -> odom; at most one broadcast per odometry stamp", "s", low=1e-3
    )
    stamp: str = setting(
        "odometry",
        "stamp of map -> odom: odometry: that of the newest odometry; now: the clock, as long as odometry comes",
        choices=("odometry", "now"),
        live=True,
    )
    transform_tolerance: float = setting(
        0.1, "time by which map -> odom is dated ahead of tf.stamp", "s", high=10.0, live=True
    )
    max_speed_m_s: float = setting(
        0.0, "map -> odom moves no faster than this after a correction; 0: at once", "m/s", live=True
    )
    max_turn_rad_s: float = setting(
        0.0, "map -> odom turns no faster than this after a correction; 0: at once", "rad/s", live=True
    )
    report_jump_m: float = setting(
        0.5, "a correction that moves map -> odom by more, or by 0.2 rad, is reported with its edges", "m", live=True
    )


@dataclass(frozen=True, slots=True)
class InputsConfig:
    """The inputs and their subscriptions."""

    names: str = setting(" ".join(USUAL_INPUTS), "names of the inputs; each has a section of its name")
    reliable: bool = setting(
        False, "true: subscriptions ask for reliable delivery, unless INPUT.reliability says otherwise"
    )
    depth: int = setting(1000, "messages that the middleware holds for a subscription", "messages", low=1, high=100_000)
    queue: int = setting(
        20_000, "messages that are queued for the solver; more are refused", "messages", low=1, high=1_000_000
    )
    tf: bool = setting(
        True, "whether the node subscribes to /tf, for sensors on moving joints; it always does to /tf_static"
    )
    tf_wait_s: float = setting(
        0.2, "an observation without a transform of /tf is refused when odometry is this much newer", "s"
    )


@dataclass(frozen=True, slots=True)
class InitialPoseConfig:
    """A pose that a person gives on ``initialpose``."""

    sigma_m: float = setting(
        0.5, "position noise of a pose from initialpose whose covariance is unknown", "m", low=1e-6
    )
    sigma_rad: float = setting(
        0.26, "heading noise of a pose from initialpose whose covariance is unknown", "rad", low=1e-6
    )


@dataclass(frozen=True, slots=True)
class OutputConfig:
    """Published topics and written files."""

    folder: str = setting(
        "{node}_run",
        "run folder written by ~/save and at shutdown; {node} stands for namespace and name of the "
        "node, as in robot1_graph_slam; empty: nothing is written at shutdown",
    )
    keep_earlier: int = setting(
        5, "earlier runs that are kept, as folder-1, folder-2, ...; 0: they are replaced", "runs", low=0, high=10_000
    )
    load: str = setting(
        "", "name of the run that ~/load loads, next to output.folder; empty: the newest earlier run", live=True
    )
    load_at_start: bool = setting(False, "true: the run of output.load is loaded when the node is configured")
    load_pose: str = setting(
        "",
        "pose of the robot in a loaded map: x y yaw or, in space, x y z roll pitch yaw, as uncertain "
        "as initialpose.sigma_m and initialpose.sigma_rad; empty: unknown until a landmark is recognised",
        live=True,
    )
    save_as: str = setting(
        "", "name of a new run, next to output.folder, that ~/save also writes the map to; empty: none", live=True
    )
    path_period_s: float = setting(0.2, "shortest period of ~/path and ~/path_updates", "s", live=True)
    path_max_poses: int = setting(
        10_000, "most poses of ~/path; a longer path is thinned out", "poses", low=2, high=10_000_000, live=True
    )

    def __post_init__(self) -> None:
        check_run_name("output.load", self.load)
        check_run_name("output.save_as", self.save_as)


@dataclass(frozen=True, slots=True)
class JournalConfig:
    """The journal of a run, which survives the process."""

    resume: bool = setting(
        True, "true: a node whose last run did not end resumes its map when configured, as ~/load would"
    )


@dataclass(frozen=True, slots=True)
class TimeConfig:
    """Jumps of the clock."""

    on_jump: str = setting(
        "segment",
        "reaction to a clock that jumps back: segment: a new segment of the path begins; reset: the "
        "run is saved and begins anew; stop: measurements are refused until ~/reset",
        choices=("segment", "reset", "stop"),
        live=True,
    )
    future_s: float = setting(
        1.0, "messages further ahead of the clock are refused, but those of a recording; 0: none are", "s"
    )


@dataclass(frozen=True, slots=True)
class HealthConfig:
    """The limits above which ``/diagnostics`` calls the node degraded."""

    odometry_silent_s: float = setting(1.0, "degraded: no odometry for longer than this", "s", live=True)
    landmarks_silent_s: float = setting(
        60.0, "degraded: no landmark observed for longer than this, after the first; 0: never", "s", live=True
    )
    lag_s: float = setting(1.0, "degraded: the solver is behind by more than this", "s", live=True)
    stuck_s: float = setting(10.0, "degraded: one solve has taken longer than this", "s", live=True)
    chi2_per_dof: float = setting(
        10.0, "degraded: measurements contradict each other by more", "chi2 per degree of freedom", live=True
    )
