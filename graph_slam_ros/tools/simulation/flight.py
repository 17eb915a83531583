"""A hall in which a drone flies laps at changing heights, banks in its turns, and reads tags on walls and pillars."""

import numpy as np
from scipy.spatial.transform import Rotation

from graph_slam_ros.lie import se3
from graph_slam_ros.slam import Sighting
from graph_slam_ros.tools.simulation.options import option, random
from graph_slam_ros.tools.simulation.recording import CORRELATION_TIME, Recording, VelocityNoise, drive
from graph_slam_ros.tools.simulation.sensing import KINDS, TagCamera
from graph_slam_ros.typing import Array, Numbers

TICK_NS = 20_000_000  # odometry at 50 Hz
OBSERVE_EVERY = 10  # camera at 5 Hz
SPEED_M_S = 3.0  # on average around the lap
RAMP_S = 4.0  # from hovering to full speed, and back
GRAVITY_M_S2 = 9.81
HEIGHT_M, CLIMB_M = 2.5, 1.2  # in the middle, and how far above and below it
WAVES_PER_LAP = 1.5  # ups and downs: a lap's heights are not those of the lap before
MARGIN_M = 3.0  # from the path's ends to the walls
TAG_SPACING_M = 3.0
TAG_HEIGHTS_M = (1.2, 3.8)
PILLAR_M = 0.6  # its width
ROOF_M = 4.5
DOWN_RAD = np.deg2rad(8.0)  # the camera looks down a little
CAMERA = TagCamera(
    T_base_sensor=(0.12, 0.0, -0.04, 0.0, float(np.sin(0.5 * DOWN_RAD)), 0.0, float(np.cos(0.5 * DOWN_RAD))),
    sigmas=(0.04, 0.01, 0.01, *np.deg2rad((0.4, 2.0, 2.0)).tolist()),
    sigma_range_m=0.04,
    sigma_bearing_rad=float(np.deg2rad(0.3)),
    max_range_m=8.0,
    field_of_view_rad=float(np.deg2rad(100.0)),
    max_slant_rad=float(np.deg2rad(65.0)),
)


def simulate(
    seed: int,
    laps: int = option(3, "how often around", "", 1, 1000),
    length_m: float = option(22.0, "length of the hall", "m", 12, 1000),
    width_m: float = option(16.0, "width of the hall", "m", 12, 1000),
    sensor: str = option("pose", "what the sensor measures of a tag", choices=("pose", *KINDS)),
    beacons: int = option(0, "points under the roof whose position is seen besides, in range and in view", "", 0, 1000),
    sigma_forward_m_s: float = option(0.05, "error of the measured speed ahead", "m/s", 1e-6, 1),
    sigma_sideways_m_s: float = option(0.03, "error of the measured speed to the left", "m/s", 1e-6, 1),
    sigma_climb_m_s: float = option(0.04, "error of the measured speed upwards", "m/s", 1e-6, 1),
    sigma_tilt_rad_s: float = option(0.004, "error of the measured rates of roll and of pitch", "rad/s", 1e-6, 1),
    sigma_turn_rad_s: float = option(0.02, "error of the measured rate of yaw", "rad/s", 1e-6, 1),
    correlation_time_s: float = CORRELATION_TIME,
) -> Recording:
    """Hover, fly the laps and a bit of the next one, and hover again.

    The laps are on an ellipse, at 3 m/s and 2.5 m height on average; odometry comes at 50 Hz, tags are read at 5 Hz.
    """
    rng = random(seed)
    tags, points_by_name = _tags(length_m, width_m), _beacons(beacons, length_m, width_m)
    names, poses = list(tags), np.array(list(tags.values()))
    points = np.array(list(points_by_name.values())).reshape(-1, 3)

    def observe(T_world_base: Numbers) -> list[Sighting]:
        seen = CAMERA.observe(rng, T_world_base, names, poses, sensor)
        return seen + CAMERA.observe_points(rng, T_world_base, list(points_by_name), points)

    path = _path(laps, length_m, width_m)
    steps = se3.local(tuple(path[1:].T), tuple(path[:-1].T))
    of_speed = (sigma_forward_m_s, sigma_sideways_m_s, sigma_climb_m_s)
    noise = VelocityNoise((*of_speed, sigma_tilt_rad_s, sigma_tilt_rad_s, sigma_turn_rad_s), correlation_time_s)
    twists = np.stack(steps, axis=1) / (TICK_NS * 1e-9)
    return drive(rng, tuple(path[0].tolist()), twists, TICK_NS, noise, observe, OBSERVE_EVERY, tags | points_by_name)


def _path(laps: int, length_m: float, width_m: float) -> Array:
    """Poses (n, 7) at ticks: x points ahead, and z along the thrust that carries and turns the drone."""
    a, b = 0.5 * length_m - MARGIN_M, 0.5 * width_m - MARGIN_M
    dt_s = TICK_NS * 1e-9
    rate = SPEED_M_S / np.sqrt(0.5 * (a**2 + b**2))  # of the angle on the ellipse, rad/s
    ticks = int(((laps + 0.1) * 2.0 * np.pi / rate + RAMP_S) / dt_s)
    t = dt_s * np.arange(-2, ticks + 3)  # two more at each end, for the differences
    ramp = np.clip(np.minimum(t, dt_s * ticks - t) / RAMP_S, 0.0, 1.0)
    angle = np.cumsum(rate * ramp**2 * (3.0 - 2.0 * ramp)) * dt_s
    position = np.column_stack(
        [a * np.cos(angle), b * np.sin(angle), HEIGHT_M + CLIMB_M * np.sin(WAVES_PER_LAP * angle)]
    )
    up = np.gradient(np.gradient(position, dt_s, axis=0), dt_s, axis=0) + np.array([0.0, 0.0, GRAVITY_M_S2])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    left = np.cross(up, np.column_stack([-a * np.sin(angle), b * np.cos(angle), np.zeros(len(t))]))
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    axes = np.stack([np.cross(left, up), left, up], axis=2)
    return np.hstack([position, Rotation.from_matrix(axes).as_quat()])[2:-2]


def _tags(length_m: float, width_m: float) -> dict[str, Numbers]:
    """Poses by name: on the four walls and on the four sides of two pillars; x points out of the wall, z up."""
    x, y = 0.5 * length_m, 0.5 * width_m
    out: dict[str, Numbers] = {}
    for wall, (at, half, heading) in enumerate([(x, y, np.pi), (y, x, -0.5 * np.pi), (x, y, 0.0), (y, x, 0.5 * np.pi)]):
        along = np.arange(-half + 0.5 * TAG_SPACING_M, half, TAG_SPACING_M).tolist()
        for k, offset in enumerate(along):
            for level, z in enumerate(TAG_HEIGHTS_M):
                out[f"wall{wall}/{k}/{level}"] = _tag(-at, -offset, z, heading)
    for pillar, center in enumerate((-0.2 * length_m, 0.2 * length_m)):
        for side, heading in enumerate((0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)):
            for level, z in enumerate(TAG_HEIGHTS_M):
                out[f"pillar{pillar}/{side}/{level}"] = _tag(0.5 * PILLAR_M, 0.0, z, heading, center)
    return out


def _tag(ahead: float, left: float, z: float, heading: float, center: float = 0.0) -> Numbers:
    """The pose of a tag, relative to a point on the middle line, from which it is seen along its own heading."""
    c, s = float(np.cos(heading)), float(np.sin(heading))
    half = 0.5 * heading
    x, y = center + c * ahead - s * left, s * ahead + c * left
    return x, y, z, 0.0, 0.0, float(np.sin(half)), float(np.cos(half))


def _beacons(count: int, length_m: float, width_m: float) -> dict[str, Numbers]:
    """Beacons on an ellipse under the roof, a little inside the path."""
    out: dict[str, Numbers] = {}
    for k in range(count):
        angle = 2.0 * np.pi * k / count
        x, y = 0.35 * length_m * np.cos(angle), 0.35 * width_m * np.sin(angle)
        out[f"beacon{k}"] = (float(x), float(y), ROOF_M)
    return out
