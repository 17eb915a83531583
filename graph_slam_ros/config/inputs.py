"""Parameters of one input: its topic, its use, and values for what its messages do not contain."""

import math
from dataclasses import dataclass

from graph_slam_ros.config.parameter import numbers, setting
from graph_slam_ros.config.pipeline import LOSSES
from graph_slam_ros.errors import ConfigError

HIGHEST_M = 1e5  # above the ellipsoid or below it: beyond is no place for a robot
USES = ("auto", "odometry", "gyro", "landmarks", "fix", "closure", "none")
ASSUMED = "assumed"  # the mount of a sensor whose place nobody has given


@dataclass(frozen=True, slots=True)
class InputConfig:
    """The section of an input, which has its name."""

    name: str
    topic: str = setting(
        "", "topic of the input; a recording without that topic uses its only topic of the input's type"
    )
    type: str = setting("", "message type of the input, package/msg/Name")
    use: str = setting(
        "auto", "use of the input; auto: the first that its type allows; none: it is ignored", choices=USES
    )
    frame: str = setting("", "frame of the measurements, instead of the one in the messages; empty: as in the messages")
    mount: str = setting(
        "",
        "pose of the sensor frame on the robot, used where TF has none: x y z roll pitch yaw; assumed: at the base, an "
        "optical frame looking ahead, and the run ends as incomplete; empty: messages are refused then, except that an "
        "antenna is assumed at the base",
        "m, rad",
    )
    noise: str = setting(
        "message", "message: the messages' covariance, or where unknown sigmas; sigmas", choices=("message", "sigmas")
    )
    sigma_m: float = setting(
        0.0, "position noise; 0: landmarks.sigma_m for landmarks, other messages of unknown covariance are refused", "m"
    )
    sigma_per_m: float = setting(0.0, "position noise that is added to sigma_m for each metre of distance", "m/m")
    sigma_rad: float = setting(0.0, "noise of an orientation or bearing of the input; 0: unknown", "rad", high=math.pi)
    sigma_factor: float = setting(
        1.0, "of an odometry: factor of the sigmas of its motion between keyframes", "times", low=1e-3, high=1e3
    )
    correlation_s: float = setting(
        1.0,
        "correlation time of the errors of fixes: one fix is used each twice this long, or each "
        "keyframes.max_interval_s with more noise; 0: errors are independent, all are used",
        "s",
    )
    offset_s: float = setting(
        0.0, "time added to the stamps of the input: how far its clock is behind", "s", low=-4e9, high=4e9
    )
    mount_correction: str = setting(
        "",
        "correction of the sensor's pose on the robot, by TF or mount: x y z roll pitch yaw, a shift and a turn about "
        "the sensor's origin in the axes of the base; graph_slam calibrate prints it; empty: none",
        "m, rad",
    )
    range_factor: float = setting(
        1.0, "factor of the input's ranges and positions, before range_offset_m is added", "times", low=0.1, high=10.0
    )
    range_offset_m: float = setting(0.0, "length added to ranges of the input", "m", low=-1000.0, high=1000.0)
    max_distance_m: float = setting(0.0, "landmarks and closures farther away than this are refused; 0: 100 km", "m")
    id: str = setting("", "landmark identity for messages that carry none")
    id_prefix: str = setting(
        "", "text put before every identity of the input, if two inputs use the same identities for different landmarks"
    )
    frame_prefix: str = setting("", "beginning of the frame names of landmarks that are published as transforms")
    hamming_max: int = setting(255, "tags with more corrected bits than this are ignored", "bits", low=0, high=255)
    decision_margin_min: float = setting(
        0.0, "tags with a smaller decision margin than this are ignored", "grey levels"
    )
    datum: str = setting("", "latitude, longitude and altitude of the map's origin; empty: the first fix", "deg, m")
    loss: str = setting(
        "auto", "robust loss; auto: landmarks.loss, or robust.loss; odometry has none", choices=("auto", *LOSSES)
    )
    reliability: str = setting(
        "auto",
        "QoS reliability that the input's subscription asks for; auto: as inputs.reliable says; reliable: a "
        "best-effort publisher does not connect; best_effort: every publisher connects, messages may be lost",
        choices=("auto", "reliable", "best_effort"),
    )
    durability: str = setting(
        "volatile",
        "QoS durability that the input's subscription asks for; transient_local: also the last messages of a "
        "latched publisher, a volatile publisher then does not connect",
        choices=("volatile", "transient_local"),
    )

    def __post_init__(self) -> None:
        self.numbers("mount", 6)
        self.numbers("mount_correction", 6)
        limits = ("latitude", 90.0, "deg"), ("longitude", 360.0, "deg"), ("altitude", HIGHEST_M, "m")
        for (name, most, unit), number in zip(limits, self.numbers("datum", 3), strict=False):
            if abs(number) > most:
                raise ConfigError(f"{self.name}.datum: {name} {number:g} is not in [-{most:g}, {most:g}] {unit}")

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        """Numbers of a text; none if it is empty. Raises ConfigError unless there are ``count`` of them."""
        if key == "mount" and self.mount == ASSUMED:
            return (0.0,) * count
        return numbers(f"{self.name}.{key}", getattr(self, key), count)


DEFAULT_INPUTS = (
    InputConfig("odom", topic="odom", type="nav_msgs/msg/Odometry"),
    InputConfig("detections", topic="landmarks", type="vision_msgs/msg/Detection3DArray"),
)


def default_input(name: str) -> InputConfig:
    """The default settings of the input of a name."""
    return next((one for one in DEFAULT_INPUTS if one.name == name), InputConfig(name, topic=name))
