"""Parameters of what surrounds the pipeline in a running node: transforms, topics, files, time, health."""

import re
from dataclasses import dataclass

from graph_slam_ros.config.inputs import DEFAULT_INPUTS
from graph_slam_ros.config.parameter import setting
from graph_slam_ros.errors import ConfigError

USUAL_INPUTS = tuple(one.name for one in DEFAULT_INPUTS)
_FILE_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,99}")


def check_run_name(what: str, name: str) -> None:
    """Refuse what is not empty and not the plain name of a run folder, a path above all.

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

    autostart: bool = setting(True, "configure and activate at once; false: a lifecycle manager does that")


@dataclass(frozen=True, slots=True)
class TfConfig:
    """The transform map -> odom."""

    publish_tf: bool = setting(True, "whether to broadcast map -> odom", live=True)
    transform_publish_period: float = setting(
        0.05, "broadcast this often, at most once per odometry stamp", "s", low=1e-3
    )
    stamp: str = setting(
        "odometry",
        "odometry: dated by the newest odometry, and silent when that stops; now: by the clock, silent likewise",
        choices=("odometry", "now"),
        live=True,
    )
    transform_tolerance: float = setting(
        0.1, "how far ahead of that the transform is dated", "s", low=0.0, high=10.0, live=True
    )
    max_speed_m_s: float = setting(
        0.0, "corrections are followed no faster than this; 0: at once", "m/s", low=0.0, live=True
    )
    max_turn_rad_s: float = setting(0.0, "nor turned faster than this; 0: at once", "rad/s", low=0.0, live=True)
    report_jump_m: float = setting(
        0.5, "a correction larger than this is reported with the edges that caused it", "m", low=0.0, live=True
    )
    report_jump_rad: float = setting(0.2, "or turned by more than this", "rad", low=0.0, live=True)
    second_authority: str = setting(
        "report",
        "when somebody else broadcasts map -> odom: report, or also yield and broadcast no more",
        choices=("report", "yield"),
        live=True,
    )


@dataclass(frozen=True, slots=True)
class InputsConfig:
    """What is listened to."""

    names: str = setting(" ".join(USUAL_INPUTS), "the inputs, each with a section of its name")
    reliable: bool = setting(False, "ask for reliable delivery (a best-effort publisher then does not connect)")
    depth: int = setting(1000, "messages the middleware may hold for a subscription", "messages", low=1, high=100_000)
    queue: int = setting(
        20_000, "messages that may wait for the solver; more are refused and counted", "messages", low=1, high=1_000_000
    )
    tf: bool = setting(True, "whether /tf is listened to, for sensors on moving joints; /tf_static always is")
    tf_buffer_s: float = setting(10.0, "how long transforms of /tf are kept", "s", low=0.1)
    tf_wait_s: float = setting(
        0.2,
        "how much newer odometry may get before what is seen in a frame that /tf does not tell of is refused",
        "s",
        low=0.0,
    )


@dataclass(frozen=True, slots=True)
class InitialPoseConfig:
    """A pose that somebody gives on ``initialpose``."""

    use: str = setting(
        "segment",
        "segment: a new segment of the path begins there; prior: the last odometry counts less and the pose is weighed"
        " with it",
        choices=("segment", "prior"),
    )
    sigma_m: float = setting(0.5, "its position where the message's covariance is unknown", "m", low=1e-6)
    sigma_rad: float = setting(0.26, "and its heading", "rad", low=1e-6)
    loosen_m: float = setting(1.0, "of a prior: what is added to the last odometry, in position", "m", low=0.0)
    loosen_rad: float = setting(0.5, "and in rotation", "rad", low=0.0)


@dataclass(frozen=True, slots=True)
class OutputConfig:
    """What the node publishes and leaves behind."""

    folder: str = setting(
        "{node}_run",
        "run folder written by ~/save and at shutdown; {node} stands for namespace and name of the node,"
        " as in robot1_graph_slam; empty: none at shutdown",
    )
    keep_earlier: int = setting(
        5, "earlier runs that are kept, as folder-1, folder-2, ...; 0: replaced", "runs", low=0, high=10_000
    )
    load: str = setting(
        "", "run that ~/load goes on from, a name beside the folder; empty: the newest earlier", live=True
    )
    load_at_start: bool = setting(False, "do so when configured")
    load_pose: str = setting(
        "",
        "where the robot is in the map when it is loaded: x y yaw or, in space, x y z roll pitch yaw; as uncertain as"
        " initialpose.* say; empty: unknown, until something is recognised",
        live=True,
    )
    save_as: str = setting(
        "",
        "~/save also writes the map as a run of this name beside the folder, for output.load; nothing is replaced;"
        " empty: no",
        live=True,
    )
    path_period_s: float = setting(0.2, "publish ~/path and ~/path_updates at most this often", "s", low=0.0, live=True)
    path_max_poses: int = setting(
        10_000, "poses of ~/path; a longer one is thinned out", "poses", low=2, high=10_000_000, live=True
    )
    path_moved_m: float = setting(0.02, "~/path_updates tells of keyframes that moved by more", "m", low=0.0)
    path_moved_rad: float = setting(0.02, "or turned by more", "rad", low=0.0)
    landmarks_every_keyframes: int = setting(
        20,
        "publish ~/landmarks after this many keyframes, and after each solve of everything, to subscribers",
        "keyframes",
        low=1,
        high=1_000_000,
        live=True,
    )
    graph_period_s: float = setting(2.0, "publish ~/graph at most this often", "s", low=0.0, live=True)
    graph_max_edges: int = setting(
        5_000, "edges of ~/graph; of more, the worst fitting are shown first", "edges", low=1, high=1_000_000, live=True
    )
    pose_covariance_max: float = setting(
        0.25,
        "variance of z, roll and pitch in the poses of a planar robot, which are taken for zero: half a metre and"
        " half a radian, about where odometry is counted as out_of_plane; 1e6: unknown (RViz draws a kilometre)",
        "m^2, rad^2",
        low=0.0,
    )

    def __post_init__(self) -> None:
        check_run_name("output.load", self.load)
        check_run_name("output.save_as", self.save_as)


@dataclass(frozen=True, slots=True)
class JournalConfig:
    """What of a run outlives whatever ends it."""

    resume: bool = setting(
        True, "when configured, go on in the map of the last run where that was not ended, as if it were loaded"
    )
    sync_s: float = setting(
        1.0,
        "have the disk take the journal so often at most: what a power cut may lose; the end of the process loses"
        " nothing that was published",
        "s",
        low=0.05,
        high=3600.0,
    )


@dataclass(frozen=True, slots=True)
class TimeConfig:
    """What the clock may do."""

    on_jump: str = setting(
        "segment",
        "when the clock jumps back: segment: go on with a new segment of the path; reset: save and begin anew;"
        " stop: take nothing more until reset",
        choices=("segment", "reset", "stop"),
        live=True,
    )
    jump_back_s: float = setting(0.2, "that is a jump back; less is messages out of order", "s", low=1e-3)
    future_s: float = setting(
        1.0, "messages further ahead of the clock, but of one that is played, are refused; 0: none", "s", low=0.0
    )


@dataclass(frozen=True, slots=True)
class HealthConfig:
    """When ``/diagnostics`` calls the node degraded."""

    odometry_silent_s: float = setting(1.0, "no odometry for longer", "s", low=0.0, live=True)
    landmarks_silent_s: float = setting(
        60.0, "nothing seen for longer, once something was; 0: no matter", "s", low=0.0, live=True
    )
    lag_s: float = setting(1.0, "the solver is behind by more", "s", low=0.0, live=True)
    stuck_s: float = setting(10.0, "the solver has been at one thing for longer", "s", low=0.0, live=True)
    memory_mib: float = setting(
        0.0,
        "the process has more memory: loop closures are refused and no second look is begun; 0: no matter",
        "MiB",
        low=0.0,
        live=True,
    )
    chi2_per_dof: float = setting(
        10.0, "the measurements contradict each other by more", "per degree of freedom", low=0.0, live=True
    )
