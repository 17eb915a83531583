"""Parameters of the world and its frames: dimensions, frame names, the anchor, a map that is held fixed."""

from dataclasses import dataclass

from graph_slam_ros.config.parameter import setting
from graph_slam_ros.errors import ConfigError

_LEAST_SIGMA = 1e-6  # of an anchor: nothing is certain


@dataclass(frozen=True, slots=True)
class FramesConfig:
    """Names of frames, REP-105."""

    map: str = setting("map", "frame of the corrected path")
    odom: str = setting("odom", "frame of the odometry")
    base: str = setting("base_link", "frame of the robot")

    def __post_init__(self) -> None:
        names = {"map": self.map, "odom": self.odom, "base": self.base}
        for key, name in names.items():
            for other in names:
                if other != key and names[other] == name:
                    raise ConfigError(
                        f"frames.{key}: {name!r} is frames.{other}, too: each needs a name of its own; for messages of "
                        "odometry that name another frame, set frame of their input, for example odom.frame=odom"
                    )


@dataclass(frozen=True, slots=True)
class WorldConfig:
    """The world: the plane or space."""

    dimensions: int = setting(
        2, "2: the robot moves in a plane, measurements are projected onto it; 3: it moves in space", low=2, high=3
    )


@dataclass(frozen=True, slots=True)
class AnchorConfig:
    """The prior on the first keyframe, which fixes the gauge: map begins where odom begins, or at a given pose.

    If its sigmas are 0, the first fix or surveyed landmark replaces it, and the map is moved there.
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
    """Mapping, or localization in a fixed map; and a map whose size follows its area."""

    localize: bool = setting(
        False,
        "true: the map stays fixed and the robot is located in it; false: the map grows and is corrected",
        live=True,
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
