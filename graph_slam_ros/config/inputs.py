"""Parameters of one input: what is listened to, what it is used as, and what its messages leave unsaid."""

import math
from dataclasses import dataclass

from graph_slam_ros.config.parameter import numbers, setting
from graph_slam_ros.errors import ConfigError

HIGHEST_M = 1e5
"""Above the ellipsoid or below it: beyond is no place for a robot."""


@dataclass(frozen=True, slots=True)
class InputConfig:
    """The section of an input.

    Attributes
    ----------
    name : of the input and of its section
    """

    name: str
    topic: str = setting("", "where it comes from; in a recording without that topic, the only one of its type")
    type: str = setting("", "type of its messages, package/msg/Name")
    use: str = setting(
        "auto",
        "what it is used as; auto: what its type is for, the first thing where it is for several; none: not at all",
        choices=("auto", "odometry", "landmarks", "fix", "closure", "none"),
    )
    frame: str = setting("", "frame it is measured in, whatever its messages say; empty: as they say")
    mount: str = setting(
        "",
        "where that frame is on the robot if TF does not tell: x y z roll pitch yaw; empty: refused then, but for an"
        " antenna, which is taken to be at the base",
        "m, rad",
    )
    noise: str = setting(
        "message",
        "message: the messages' covariance, the sigmas where it is unknown; sigmas: always these",
        choices=("message", "sigmas"),
    )
    sigma_m: float = setting(
        0.0, "position noise; 0: landmarks.sigma_m of landmarks, others of unknown covariance are refused", "m", low=0.0
    )
    sigma_per_m: float = setting(0.0, "added to sigma_m for each metre of distance", "m/m", low=0.0)
    sigma_rad: float = setting(0.0, "noise of an orientation or bearing; 0: unknown", "rad", low=0.0, high=math.pi)
    correlation_s: float = setting(
        1.0,
        "how long an error of its fixes lasts (1/e): of what comes faster one is used each twice this long, or each"
        " keyframes.max_interval_s with a larger noise; 0: errors are independent, all are used",
        "s",
        low=0.0,
    )
    offset_s: float = setting(
        0.0,
        "added to the stamps of its messages: how far its clock is behind",
        "s",
        low=-3600.0,
        high=3600.0,
    )
    max_distance_m: float = setting(
        0.0,
        "landmarks and closures farther away are refused; 0: ten times as far as it has seen, 1 km at least and 100 km"
        " at most",
        "m",
        low=0.0,
    )
    id: str = setting("", "identity of the landmark in messages that carry none")
    id_prefix: str = setting("", "put before every identity, where two inputs have the same for different landmarks")
    frame_prefix: str = setting("", "of transforms as landmarks: what the names of their frames begin with")
    hamming_max: int = setting(255, "tags with more corrected bits are left out", "bits", low=0, high=255)
    decision_margin_min: float = setting(
        0.0, "tags that were told from others by less are left out", "grey levels", low=0.0
    )
    datum: str = setting(
        "", "latitude longitude altitude of the map's origin, in degrees and metres; empty: the first fix", "deg, m"
    )

    def __post_init__(self) -> None:
        self.numbers("mount", 6)
        limits = ("latitude", 90.0, "deg"), ("longitude", 360.0, "deg"), ("altitude", HIGHEST_M, "m")
        for (name, most, unit), number in zip(limits, self.numbers("datum", 3), strict=False):
            if abs(number) > most:
                raise ConfigError(f"{self.name}.datum: {name} {number:g} is not in [-{most:g}, {most:g}] {unit}")

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        """Numbers of a text; none if it is empty. Raises ConfigError for anything else than ``count`` of them."""
        return numbers(f"{self.name}.{key}", getattr(self, key), count)


DEFAULT_INPUTS = (
    InputConfig("odom", topic="odom", type="nav_msgs/msg/Odometry"),
    InputConfig("detections", topic="landmarks", type="vision_msgs/msg/Detection3DArray"),
)


def default_input(name: str) -> InputConfig:
    """What is known of an input by its name alone."""
    return next((one for one in DEFAULT_INPUTS if one.name == name), InputConfig(name, topic=name))
