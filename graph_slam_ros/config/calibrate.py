"""Parameters of the calibration of odometry and sensors with the map."""

from dataclasses import dataclass

from graph_slam_ros.config.parameter import setting
from graph_slam_ros.errors import ConfigError

DEFAULT_GROUPS = ("factors", "clock", "yaw")
_ALONE = ("association", "none")
GROUPS = (*DEFAULT_GROUPS, "mount", "range_offset", "range_factor", "turn_bias")
_RULER_M = 0.05  # a prior on the mount that tells it from an offset of the ranges


@dataclass(frozen=True, slots=True)
class CalibrateConfig:
    """Calibration of odometry and sensors, estimated with the map."""

    groups: str = setting(
        "association",
        "what is estimated and corrected: none, association (the factors of odometry that landmarks.association=joint "
        "finds; nothing with another association), auto (factors of odometry, clock and yaw of sensors; of an input "
        "with ranges alone their offset and factor, while odometry keeps its scale), or a list of factors, clock, yaw, "
        "mount, range_offset, range_factor, turn_bias",
    )
    factor_sigma: float = setting(0.2, "prior of odometry's distance and turn factors", "times", low=1e-4, high=1.0)
    clock_sigma_s: float = setting(0.5, "prior of a sensor's clock against odometry", "s", low=1e-4, high=10.0)
    yaw_sigma_rad: float = setting(0.5, "prior of the orientation of a sensor", "rad", low=1e-4, high=3.0)
    mount_sigma_m: float = setting(
        0.02, "prior of the position of a sensor: how well it was measured with a ruler", "m", low=1e-4, high=10.0
    )
    range_offset_sigma_m: float = setting(0.5, "prior of the offset of an input's ranges", "m", low=1e-4, high=100.0)
    range_factor_sigma: float = setting(0.2, "prior of the factor of an input's ranges", "times", low=1e-4, high=1.0)
    turn_bias_sigma: float = setting(0.05, "prior of odometry's constant turn rate error", "rad/s", low=1e-5, high=1.0)
    drift: float = setting(
        0.0,
        "change of the parameters in an hour, in parts of the sigma of their prior (a random walk over windows of 200 "
        "keyframes); 0: they are constant",
        "parts/sqrt(h)",
        low=0.0,
        high=1000.0,
    )

    def __post_init__(self) -> None:
        unknown = [word for word in self.groups.split() if word not in (*GROUPS, "auto", *_ALONE)]
        if unknown:
            raise ConfigError(
                f"calibrate.groups: {unknown[0]!r} is not none, association, auto or one of {', '.join(GROUPS)}"
            )
        words = self.groups.split()
        for word in _ALONE:
            if word in words and len(words) > 1:
                raise ConfigError(f"calibrate.groups: {self.groups!r} is {word} and some")
        asked = self.asked
        if "mount" in asked and "range_offset" in asked and self.mount_sigma_m > _RULER_M:
            raise ConfigError(
                "calibrate.groups: mount and range_offset are one for a sensor that looks ahead: "
                f"measure the mount, calibrate.mount_sigma_m at most {_RULER_M:g}, or leave one out"
            )

    @property
    def asked(self) -> tuple[str, ...]:
        """Names of the groups that somebody asked for."""
        words = self.groups.split()
        wanted = {*words, *(DEFAULT_GROUPS if "auto" in words else ())}
        return tuple(group for group in GROUPS if group in wanted)

    @property
    def is_on(self) -> bool:
        """Return whether somebody asked for any."""
        return bool(self.asked)

    @property
    def chooses(self) -> bool:
        """Return whether groups are chosen by what the inputs measure, in addition to the named ones."""
        return "auto" in self.groups.split()

    def prior(self, name: str) -> float:
        """Sigma of the prior of a quantity, by its name."""
        if name in ("distance", "turn"):
            return self.factor_sigma
        if name in ("roll", "pitch", "yaw"):
            return self.yaw_sigma_rad
        if name in ("x", "y", "z"):
            return self.mount_sigma_m
        return {
            "clock": self.clock_sigma_s,
            "range_offset": self.range_offset_sigma_m,
            "range_factor": self.range_factor_sigma,
            "turn_bias": self.turn_bias_sigma,
        }[name]
